"""Example programs: each stands alone, on the public client and the mathematics, to be copied."""
