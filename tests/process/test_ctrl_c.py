"""Ctrl-C while a subcommand is still being imported: the end, and no traceback."""

from __future__ import annotations

import signal

import pytest

from tests.harness.daemon_process import python

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
    ("module", "words", "status"),
    [
        ("argparse", ["limits"], -signal.SIGINT),
        ("pydantic", ["run"], -signal.SIGINT),
        ("softfinger.tools.terminal.feed", ["monitor"], -signal.SIGINT),
        ("softfinger.daemon.safety.limits", ["limits"], 130),  # a keyboard interrupt again
    ],
)
def test_it_ends_the_process_as_any_other(module, words, status):
    done = python("-c", _AT, module, *words)
    assert (done.returncode, done.stderr) == (status, "")
