"""User tools: the command line in `cli`, and its subcommands in one package per topic."""
