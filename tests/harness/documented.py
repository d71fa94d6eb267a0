"""The `softfinger` of a documentation's shell blocks, carried out in the test's own process.

What goes on until somebody ends it is parsed, with its profile, and not run; an emulated hand is
started as a process of its own, in the place of the one before it.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shlex
import socket
import subprocess
import sys
from pathlib import Path
from unittest import mock

from softfinger.daemon.errors import SettingsError
from softfinger.tools.arguments import profile
from softfinger.tools.cli import main, make_parser
from tests.harness.daemon_process import SOFTFINGER

_BUSY = "DOCUMENTED_BUSY"  # set for what a command starts: that runs on its own
_ENDLESS = {"run", "monitor", "view", "replay", "envelope", "bench"}
_ENDS = {"--record", "--recompute"}  # with these they are run
_CLIENT = """\
import json, socket, sys
with socket.socket(socket.AF_UNIX) as server:
    server.connect(sys.argv[1])
    with server.makefile("rw") as stream:
        print(json.dumps(sys.argv[2:]), file=stream, flush=True)
        status, told, error = json.loads(stream.readline())
sys.stdout.write(told)
sys.stderr.write(error)
sys.exit(status)
"""


def parse(words: list[str]) -> None:
    """Ends the process, or raises SettingsError, for words that the command doesn't take."""
    arguments = make_parser({words[0]})[0].parse_args(words)
    if hasattr(arguments, "set"):
        profile(arguments)


class Softfinger:
    """The command as a program in ``folder``; `serve` carries out one call of it."""

    def __init__(self, folder: Path) -> None:
        client, command = folder / "client.py", folder / "softfinger"
        client.write_text(_CLIENT)
        python, address = shlex.quote(sys.executable), folder / "socket"
        command.write_text(
            f'#!/bin/sh\n[ -n "${_BUSY}" ] && exec {shlex.join(SOFTFINGER)} "$@"\n'
            f'exec {python} -I -S {client} {address} "$@"\n'
        )
        command.chmod(0o755)
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.bind(str(address))
        self.socket.listen()
        self._emulator: subprocess.Popen[str] | None = None

    def serve(self) -> None:
        client = self.socket.accept()[0]
        with client, client.makefile("rw") as stream:
            words = json.loads(stream.readline())
            status, told, error = self._answer(words)
            while "send it again" in told:  # a busy machine held the daemon up
                status, told, error = self._answer(words)
            print(json.dumps((status, told, error)), file=stream, flush=True)

    def _answer(self, words: list[str]) -> tuple[int, str, str]:
        told, error = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(told), contextlib.redirect_stderr(error):
            try:
                status = self._carry_out(words)
            except SystemExit as ended:  # argparse's
                status = int(ended.code or 0)
            except SettingsError as wrong:
                status = 2
                print(wrong, file=sys.stderr)
        return status, told.getvalue(), error.getvalue()

    def _carry_out(self, words: list[str]) -> int:
        name = words[0]
        if name in _ENDLESS and not _ENDS & {*words}:
            parse(words)
            return 0
        if name == "emulate" and "--send" not in words:
            return self._emulate(words)
        if name == "run":  # for a recording; the usual addresses are taken
            for each in ("stream", "commands"):
                words += ["--set", f"{each}.address=ipc://{Path.cwd()}/{each}"]
            return subprocess.run([*SOFTFINGER, *words, "--duration", "1"], check=False).returncode
        with mock.patch.object(os, "nice"), mock.patch.dict(os.environ, {_BUSY: "1"}):
            if name != "doctor":
                return main(words)
            with _patient_doctor():
                return main(words)

    def _emulate(self, words: list[str]) -> int:
        self.end()
        self._emulator = subprocess.Popen([*SOFTFINGER, *words], stdout=subprocess.PIPE, text=True)
        assert self._emulator.stdout is not None
        return 0 if self._emulator.stdout.readline() == "ready\n" else 1

    def end(self) -> None:
        """End the emulated hand."""
        if self._emulator is not None:
            self._emulator.terminate()
            self._emulator.communicate(timeout=60.0)
            self._emulator = None


def _patient_doctor() -> contextlib.ExitStack:
    """On a busy machine, on which others have the sockets."""
    from softfinger.daemon.diagnosis import devices, machine
    from softfinger.tools.setup import doctor

    stack = contextlib.ExitStack()
    whole = devices.check_servos
    for module, name, value in (
        (doctor, "check_addresses", lambda _: []),
        (doctor, "check_servos", lambda settings: whole(settings, 0.5)),
        (machine, "_WAKE_UPS", 5),
    ):
        stack.enter_context(mock.patch.object(module, name, value))
    return stack
