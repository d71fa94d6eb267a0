"""Before a hand runs: `doctor`, `scan`, `keys`, `limits`, `envelope`, `install-service`."""
