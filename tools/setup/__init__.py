"""What is done before a hand runs: `doctor`, `scan`, `keys`, `limits`, `install-service`."""
