"""What people use: the command line and its subcommands, one module each."""
