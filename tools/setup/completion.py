"""Run ``softfinger completion SHELL``: print a shell completion script for softfinger.

The script contains all arguments, so the shell completes words without starting a process.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

_EPILOG = """\
To install the script:
  softfinger completion bash > ~/.local/share/bash-completion/completions/softfinger
  softfinger completion zsh > ~/.zfunc/_softfinger     # with fpath+=~/.zfunc before compinit
  softfinger completion fish > ~/.config/fish/completions/softfinger.fish"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("shell", choices=("bash", "zsh", "fish"))


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    import shtab

    from softfinger.tools.cli import SUBCOMMANDS, make_parser

    parser, _ = make_parser(SUBCOMMANDS)
    for action in _actions(parser):
        if action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, arguments.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Yield all actions of a parser and its subcommands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                yield from _actions(each)
