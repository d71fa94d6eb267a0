"""User tools: the command line `cli` and its subcommands, grouped into packages by subject."""
