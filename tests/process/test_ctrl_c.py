"""Ctrl-C while a subcommand is still being imported: the end, and no traceback."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

# Presses Ctrl-C at the import of a module.
_AT = """
import builtins, os, signal, sys
from softfinger.tools import cli
really = builtins.__import__
def patched(name, *rest, **more):
    if name == sys.argv[1]:
        os.kill(os.getpid(), signal.SIGINT)
    return really(name, *rest, **more)
builtins.__import__ = patched
sys.exit(cli.main(sys.argv[2:]))
"""


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("argparse", ["limits"]),
        ("pydantic", ["run"]),
        ("softfinger.tools.terminal.feed", ["monitor"]),
    ],
)
def test_it_ends_the_process_as_any_other(module: str, words: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _AT, module, *words], capture_output=True, text=True, timeout=300
    )
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


def test_later_it_is_a_keyboard_interrupt_again() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _AT, "softfinger.daemon.safety.limits", "limits"],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (done.returncode, done.stderr) == (130, "")
