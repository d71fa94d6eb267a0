"""Provide the command line in `cli`, and the subcommands in one package per topic."""
