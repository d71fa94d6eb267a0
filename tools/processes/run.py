"""Run ``softfinger run``: load the settings, handle signals and return the exit status."""

from __future__ import annotations

import argparse
import gc
import math
import signal
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from softfinger.daemon.errors import SettingsError, SoftfingerError
from softfinger.daemon.loop.realtime import Service
from softfinger.daemon.profile.settings import Settings, TaskSettings
from softfinger.daemon.types import State
from softfinger.tools.arguments import add_duration, add_profile, add_split, profile
from softfinger.tools.processes.child_processes import (
    MonitorProcess,
    RecorderError,
    RecorderProcess,
)
from softfinger.tools.processes.event_log import EventLog
from softfinger.tools.stop_condition import Interrupted, Signals

_STARTED = time.monotonic()
_DETAIL = "realtime"  # event kind that is logged only with --verbose


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_profile(parser)
    add_duration(parser)
    parser.add_argument(
        "--monitor",
        action="store_true",
        help="show the live page in this terminal; q ends the page and the daemon",
    )
    parser.add_argument(
        "--log", choices=("plain", "json"), default="plain", help="log format: plain lines, or JSON"
    )
    parser.add_argument(
        "--log-file",
        type=Path,
        metavar="FILE",
        help="append the log to FILE instead of writing it to stderr",
    )
    parser.add_argument("--verbose", action="store_true", help="also log the real-time features")
    parser.add_argument(
        "--no-task", action="store_true", help="stay disarmed even if the profile defines a task"
    )
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FILE.mcap",
        help="record all topics from the first tick on (extra 'record')",
    )
    add_split(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run until a signal arrives or ``--duration`` has elapsed. Return 1 after a failure.

    Raises SettingsError if the settings or the log file are unusable.
    """
    settings = profile(arguments)
    if arguments.no_task:
        settings = settings.model_copy(update={"task": TaskSettings()})
    signals = Signals()
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # Ignore SIGUSR1 until the loop runs.
    try:
        log = EventLog(arguments.log, arguments.log_file)
    except OSError as error:
        raise SettingsError(f"run: --log-file {arguments.log_file}: {error.strerror}") from None
    log.take_over_logging()
    try:
        return _serve(settings, arguments, signals, log)
    except Interrupted:
        log.line("info", "end", "exited during startup; torque was never on")
        return 0
    finally:
        log.close()


def _serve(
    settings: Settings, arguments: argparse.Namespace, signals: Signals, log: EventLog
) -> int:
    # The following imports are slow (numpy, numba, zmq), so settings errors are reported first.
    from softfinger.daemon.loop.realtime import RealTime

    gc.disable()  # Garbage collection during imports would take a tenth of the start-up time.
    from softfinger.daemon.loop.build import Daemon
    from softfinger.tools.processes.compile import build_kernels

    log.line("info", "start", f"softfinger: {_scene(settings)}", rate_hz=settings.loop.rate)
    build_kernels(settings, log.line, bar=arguments.log == "plain" and not arguments.log_file)
    daemon = None

    def on_event(level: str, kind: str, text: str) -> None:
        if arguments.verbose or level != "info" or kind != _DETAIL:
            log.line(level, kind, text, **({} if daemon is None else _numbers(daemon.loop.state)))

    try:
        daemon = Daemon(settings, on_event=on_event)
    except (SoftfingerError, ValueError) as error:
        log.line("error", "", f"softfinger: {error}")
        # systemd does not restart the service after exit status 2.
        return 2 if isinstance(error, SettingsError) else 1
    with daemon, _service(daemon.loop), RealTime(settings) as measures:
        loop = daemon.loop
        signals.hand_over(loop.end)
        signal.signal(signal.SIGUSR1, lambda *_: loop.stop())
        for event in measures.events():
            loop.emit(*event)
        seconds = time.monotonic() - _STARTED
        within = max(model.table.max_error for model in daemon.models)
        ready = (
            f"ready after {seconds:.2f} s; state on {settings.stream.address}, commands on "
            f"{settings.commands.address}; next, in another terminal: softfinger send arm"
        )
        log.line("info", "start", ready, start_s=seconds, table_error=within)
        recording: Any = None
        if arguments.record is not None:
            try:
                recording = _record(arguments, settings, daemon)
            except RecorderError as error:
                log.line("error", "", f"softfinger: {error}")
                return 1
        page: AbstractContextManager[Any] = nullcontext()
        log.quiet = arguments.monitor  # From this point on, the page uses the terminal.
        if arguments.monitor:
            addresses = settings.stream.address, settings.commands.address
            page = MonitorProcess(*addresses, loop.end, settings.access.keys)
        with page:
            loop.run(arguments.duration)
        log.quiet = False
    if recording is not None:
        for line in recording.close().splitlines():
            log.line("info", "", line)
        if recording.failed:
            log.line("error", "", f"softfinger: the recording {arguments.record} is incomplete")
    state, statistics = daemon.loop.state, daemon.loop.statistics
    if statistics.ticks:
        counts = {"ticks": statistics.ticks, "overruns": state.timing.overruns}
        spreads = {f"{name}_s": each._asdict() for name, each in statistics.spreads().items()}
        text = ", ".join(f"{count} {name}" for name, count in counts.items())
        log.line("info", "end", text, **counts, **spreads)
        if arguments.log == "plain":
            log.line("info", "", "\n".join(statistics.table()))
    if state.fault:
        log.line("error", "", f"softfinger: exited with a fault: {state.fault}")
    if state.torque:
        log.line("error", "", "softfinger: torque could not be switched off and may still be on")
    unrecorded = recording is not None and recording.failed
    return 1 if state.fault or state.torque or unrecorded else 0


@contextmanager
def _service(loop: Any) -> Iterator[None]:
    """If requested, notify systemd on startup, on each tick and on shutdown."""
    service = Service.of_environment()
    if service is None:
        yield
        return
    loop.heartbeat = service.alive
    try:
        yield
    finally:
        service.close()


def _record(arguments: argparse.Namespace, settings: Settings, daemon: Any) -> Any:
    """Start a recorder and wait until it has subscribed. Raises RecorderError."""
    from softfinger.daemon.wire import schema
    from softfinger.daemon.wire.publisher import bit

    def subscribed() -> bool:
        daemon.gateway.link.look()
        return bool(daemon.gateway.link.wanted & bit(schema.INPUT))

    def ended(why: str) -> None:
        daemon.loop.report("error", "record", why)

    words = [str(arguments.record), "--topics", "all", "--address", settings.stream.address]
    for name in ("split_size", "split_time"):
        if (value := getattr(arguments, name)) is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    return RecorderProcess(words, subscribed, ended, settings.access.keys)


def _scene(settings: Settings) -> str:
    fingers = " and ".join(settings.scene.fingers)
    return (
        f"{fingers}; servos {settings.servos.backend}, tactile {settings.tactile.backend}, "
        f"{settings.loop.rate:g} Hz"
    )


def _numbers(state: State) -> dict[str, Any]:
    """Return the numbers to log with an event; ``seq`` is the state's number in a recording."""
    numbers = {"force": [each.force for each in state.contacts], "q": state.reading.q}
    real = {
        name: [float(each) if math.isfinite(each) else None for each in pair]  # JSON has no NaN.
        for name, pair in numbers.items()
    }
    return {"seq": state.seq, "mode": state.mode, **real}
