"""The `softfinger` of a documentation's shell blocks: the real one, beside what a test has started.

What goes on until somebody ends it is parsed, with its profile, and not run; an emulated hand is
started as a process of its own, in the place of the one before it.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
from pathlib import Path
from unittest import mock

from softfinger.tools.arguments import profile
from softfinger.tools.cli import main, make_parser

REAL_HOME = "DOCUMENTED_HOME"  # the shell's own is the page's folder, for `~`
_ENDLESS = {"run", "monitor", "view", "replay", "envelope", "bench"}
_ENDS = {"--record", "--recompute"}  # with these they are run


def parse(words: list[str]) -> None:
    """Ends the process, or raises SettingsError, for words that the command doesn't take."""
    arguments = make_parser({words[0]})[0].parse_args(words)
    if hasattr(arguments, "set"):
        profile(arguments)


def emulate(words: list[str]) -> None:
    """Start it when the one before it has ended, and wait until it is ready."""
    number, log = Path("emulator.pid"), Path("emulator.log")
    if number.exists():
        with contextlib.suppress(ProcessLookupError):
            before = os.pidfd_open(int(number.read_text()))
            signal.pidfd_send_signal(before, signal.SIGTERM)
            select.select([before], [], [])
    with log.open("w") as output:
        process = subprocess.Popen([sys.executable, "-m", "softfinger", *words], stdout=output)
    number.write_text(str(process.pid))
    while "ready" not in log.read_text():
        if process.poll() is not None:
            sys.exit(process.returncode or 1)
        select.select([], [], [], 0.02)


def patiently() -> contextlib.ExitStack:
    """The doctor of a busy machine, on which others have the sockets."""
    from softfinger.daemon.diagnosis import devices, machine
    from softfinger.daemon.servos import provisioning
    from softfinger.tools.setup import doctor

    stack = contextlib.ExitStack()
    whole = devices.check_servos
    for module, name, value in (
        (doctor, "check_addresses", lambda _: []),
        (doctor, "check_servos", lambda settings: whole(settings, 0.5, 0.5)),
        (machine, "_WAKE_UPS", 5),
        (provisioning, "PING_TIMEOUT", 0.2),
    ):
        stack.enter_context(mock.patch.object(module, name, value))
    return stack


def run(words: list[str]) -> int:
    os.environ["HOME"] = os.environ[REAL_HOME]
    name = words[0]
    if name in _ENDLESS and not _ENDS & {*words}:
        parse(words)
        return 0
    if name == "emulate" and "--send" not in words:
        emulate(words)
        return 0
    if name == "emulate" and words[-1].startswith("press ") and "speed" not in words[-1]:
        words[-1] += " speed=100mm/s"
    if name == "run":  # for a recording; the usual addresses are taken
        for socket in ("stream", "commands"):
            words += ["--set", f"{socket}.address=ipc://{Path.cwd()}/{socket}"]
        words += ["--duration", "1"]
    with patiently() if name == "doctor" else contextlib.nullcontext():
        return main(words)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
