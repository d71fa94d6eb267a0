"""``softfinger run``: the daemon's process. Settings, signals and exit status, and no more."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from daemon.settings import Settings, SettingsError, load

_STARTED = time.monotonic()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``run``."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings in TOML")
    parser.add_argument(
        "--dir", type=Path, metavar="DIR", help="what {dir} in the ports stands for"
    )
    parser.add_argument("--duration", type=_seconds, metavar="S", help="end after S seconds")
    parser.add_argument(
        "--monitor", action="store_true", help="show the live page here; q ends both"
    )


def _seconds(text: str) -> float:
    value = float(text)
    if not value > 0.0:
        raise argparse.ArgumentTypeError(f"expected a time above 0 s, found {text}")
    return value


def run(arguments: argparse.Namespace) -> int:
    """Run until a signal, ``--duration`` or a fault that ends it; see the module's docstring."""
    try:
        settings = load(arguments.config, arguments.dir)
    except SettingsError as error:
        print(error, file=sys.stderr)
        return 2
    # What follows imports numpy, numba and zmq: wrong settings are told without waiting for them.
    from daemon.realtime import hold_collector, settle

    hold_collector()
    from daemon.assembly import Daemon
    from daemon.servos.base import ServoError
    from daemon.sockets import AddressError
    from daemon.tactile.base import TactileError

    log = _Log()
    log.line("info", "start", f"softfinger: {_scene(settings)}; new kernels take half a minute to compile")
    try:
        daemon = Daemon(settings, on_event=log.line, table_cache=cache_folder())
    except (SettingsError, AddressError, ServoError, TactileError) as error:
        print(f"softfinger: {error}", file=sys.stderr)
        return 1
    with daemon:
        settle()
        _on_signals(daemon.loop)
        log.line("info", "start", _ready(settings, daemon))
        log.quiet = arguments.monitor  # from here on the page owns the terminal
        with _page(settings, daemon.loop) if arguments.monitor else nullcontext():
            daemon.loop.run(arguments.duration)
    state = daemon.loop.state
    if state.fault:
        print(f"softfinger: ended with a fault: {state.fault}", file=sys.stderr)
        return 1
    return 0


def _page(settings: Settings, loop: Any) -> AbstractContextManager[Any]:
    from tools.beside import start_beside

    return start_beside(settings.stream.address, settings.commands.address, on_end=loop.end)


def _scene(settings: Settings) -> str:
    fingers = " and ".join(settings.scene.fingers)
    return (
        f"{fingers}; servos {settings.servos.backend}, tactile {settings.tactile.backend}, "
        f"{settings.loop.rate:g} Hz"
    )


def _ready(settings: Settings, daemon: Any) -> str:
    return (
        f"ready after {time.monotonic() - _STARTED:.2f} s; "
        f"state on {settings.stream.address}, commands on {settings.commands.address}; "
        f"contact table within {daemon.table.max_error:.1e}"
    )


def _on_signals(loop: Any) -> None:
    def end(_number: int, _frame: Any) -> None:
        loop.end()

    def stop(_number: int, _frame: Any) -> None:
        loop.stop()

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGUSR1, stop)


def cache_folder() -> Path:
    """Where built contact tables are kept between runs."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "softfinger"


class _Log:
    """Events as lines on standard error, unless ``quiet``."""

    def __init__(self) -> None:
        self.quiet = False

    def line(self, level: str, kind: str, text: str) -> None:
        """Print one event."""
        if not self.quiet:
            print(f"{level:7} {kind:8} {text}", file=sys.stderr, flush=True)
