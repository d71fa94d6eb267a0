"""Execute the `softfinger` commands of the documentation in the test process.

If a command would run until it is interrupted, only the command's arguments and profile are
checked. Each emulated hand runs in a separate process and replaces the previous emulated hand.
"""

import contextlib
import io
import json
import math
import os
import re
import shlex
import socket
import subprocess
import sys
from pathlib import Path
from unittest import mock

from softfinger import Hand, HandState, SoftfingerError
from softfinger.daemon.errors import SettingsError
from softfinger.tools.arguments import profile
from softfinger.tools.cli import main, make_parser
from softfinger.tools.terminal.status import describe
from tests.harness.daemon_process import SOFTFINGER, Running, started

_BUSY = "DOCUMENTED_BUSY"  # environment variable that makes `softfinger` run as a separate process
_ENDLESS = {"run", "monitor", "view", "replay", "envelope", "bench"}
# With one of these options, a command exits on its own, so the tests run the command.
_ENDS = {"--record", "--recompute"}
_SHOWN = re.compile(r"# (?P<mode>\w+)(?: (?P<force>[\d.]+) N)?(?:.*?(?P<angle>-?[\d.]+)°)?")
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
    """Parse arguments and load the profile; exit or raise SettingsError if either is invalid."""
    arguments = make_parser({words[0]})[0].parse_args(words)
    if hasattr(arguments, "set"):
        profile(arguments)


class Softfinger:
    """Replacement for the ``softfinger`` program, in ``folder``; `serve` executes one call."""

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
        self._daemon: Running | None = None

    def serve(self) -> None:
        client = self.socket.accept()[0]
        with client, client.makefile("rw") as stream:
            words = json.loads(stream.readline())
            status, told, error = self._answer(words)
            print(json.dumps((status, told, error)), file=stream, flush=True)

    def _answer(self, words: list[str]) -> tuple[int, str, str]:
        told, error = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(told), contextlib.redirect_stderr(error):
            try:
                status = self._carry_out(words)
            except SystemExit as ended:  # argparse raises this exception.
                status = int(ended.code or 0)
            except SettingsError as wrong:
                status = 2
                print(wrong, file=sys.stderr)
        return status, told.getvalue(), error.getvalue()

    def _carry_out(self, words: list[str]) -> int:
        name = words[0]
        if name == "run" and self._emulator is not None and not _ENDS & {*words}:
            return self._run(words)
        if name in _ENDLESS and not _ENDS & {*words}:
            parse(words)
            return 0
        if name == "status" and words[1:]:
            return _await(words[1])
        if name == "emulate" and "--send" not in words:
            return self._emulate(words)
        if name == "run":  # Replace the default addresses.
            for each in ("stream", "commands"):
                words += ["--set", f"{each}.address=ipc://{Path.cwd()}/{each}"]
            return subprocess.run([*SOFTFINGER, *words, "--duration", "1"], check=False).returncode
        with (
            mock.patch.object(os, "nice"),
            mock.patch.dict(os.environ, {_BUSY: "1"}),
            # The default addresses are not available to a test. 100 wake-ups take too long.
            mock.patch("softfinger.tools.setup.doctor.check_addresses", return_value=[]),
            mock.patch("softfinger.daemon.diagnosis.machine._WAKE_UP_COUNT", 5),
        ):
            return main(words)

    def _run(self, words: list[str]) -> int:
        """Run the daemon of an emulated hand, which receives all later commands."""
        self._end_daemon()
        stream, commands = (f"ipc://{Path.cwd()}/{each}" for each in ("stream", "commands"))
        own = ("--set", f"stream.address={stream}", "--set", f"commands.address={commands}")
        self._daemon = Running(*words[1:], *own, "--set", "servos.open_timeout=60")
        self._usual = os.environ["SOFTFINGER_ADDRESS"]
        os.environ["SOFTFINGER_ADDRESS"] = f"{stream},{commands}"
        return 0

    def _end_daemon(self) -> None:
        if self._daemon is not None:
            self._daemon.kill()
            self._daemon = None
            os.environ["SOFTFINGER_ADDRESS"] = self._usual

    def _emulate(self, words: list[str]) -> int:
        self.end()
        self._emulator = started(*words, stderr=None)
        return 0 if self._emulator.stdout.readline() == "ready\n" else 1

    def end(self) -> None:
        """Stop the emulated hand and its daemon."""
        self._end_daemon()
        if self._emulator is not None:
            self._emulator.terminate()
            self._emulator.communicate(timeout=300)
            self._emulator = None


def _await(shown: str) -> int:
    """Wait until `status` reports the mode, force and angle shown on the page."""
    wanted = _SHOWN.match(shown)
    assert wanted is not None, shown
    force, angle = (float(wanted[each] or "nan") for each in ("force", "angle"))

    def as_shown(state: HandState) -> bool:
        felt = 0.5 * (state.left.force + state.right.force)
        turned = math.degrees(state.object.angle)
        return (
            state.mode == wanted["mode"]
            and not abs(felt - force) > 0.1 * force
            and not abs(turned - angle) > 1.0
        )

    with Hand(timeout=120.0) as hand:
        try:
            hand.wait_for(as_shown, 120.0)
        except SoftfingerError as error:
            now = describe(hand.state())
            print(f"status: the page shows {shown[2:]!r}: {error}; the hand: {now}")
            return 1
    return 0
