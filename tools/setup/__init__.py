"""Setup commands: `doctor`, `scan`, `keys`, `limits`, `config`, `envelope`, `install-service`."""
