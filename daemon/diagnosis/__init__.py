"""What `softfinger doctor` looks at: one module an area, each a few functions that return findings.

Nothing here changes, stiffens or moves anything, but for `repair`, which `--fix` asks for.
"""
