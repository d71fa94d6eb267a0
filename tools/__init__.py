"""Tools for people: the command line `cli` and its subcommands, each in the room of its subject."""
