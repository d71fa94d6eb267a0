"""Run ``softfinger replay FILE.mcap``: publish a recording, or recompute its states."""

from __future__ import annotations

import argparse
import math
import time
from collections import deque
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softfinger.daemon.errors import AddressError, RecordingError, SettingsError
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.supervisor import Gateway
from softfinger.daemon.profile.settings import StreamSettings
from softfinger.daemon.profile.validation import address_problem
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import GATEWAY_TOPICS, pack, publish
from softfinger.tools.arguments import add_range, number, range_text, to_stderr
from softfinger.tools.stop_condition import StopCondition

if TYPE_CHECKING:
    from softfinger.tools.recordings.reader import Recording

_EPILOG = """\
Without --recompute, the messages are published unchanged on the stream's socket, at their original
pace or --speed times as fast. To subscribers, the replay looks like a daemon.

With --recompute, the recorded readings, frames and commands are processed by this version's
estimator, tables, control and limits, and every state is compared with the recorded state. The
recording must contain all topics: use `record --topics all`, or `run --record`, which starts at the
first tick. If the recording starts at the first tick, the same code and settings give bit-identical
results.
Exit status: 0 published, or all states identical; 1 the file can't be read; 3 states differ."""

_SUBSCRIBER_WAIT = 10.0  # maximum waiting time for the first subscriber [s]
# Decrease of the recorded time from which a new clock is assumed [s]. A frame has the time of its
# scan and is therefore slightly older than the message before it.
_CLOCK_STEP_MIN = 1.0
_EXIT_DIFFERENT = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("file", type=Path, metavar="FILE.mcap")
    parser.add_argument(
        "--address", default=StreamSettings().address, help="address on which to publish"
    )
    parser.add_argument(
        "--keys",
        type=Path,
        metavar="FOLDER",
        help="publish only to clients that have keys in this folder, created by `softfinger "
        "keys`, like a daemon with access.keys",
    )
    parser.add_argument(
        "--speed",
        type=number("a factor above 0", 0.0),
        default=1.0,
        metavar="X",
        help="publish X times as fast (default 1)",
    )
    add_range(parser)
    parser.add_argument(
        "--no-wait", action="store_true", help="start immediately, without waiting for a subscriber"
    )
    parser.add_argument(
        "--recompute", action="store_true", help="recompute the states with this version"
    )
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="with --recompute: use these settings instead of the recorded ones",
    )


def run(arguments: argparse.Namespace) -> int:
    """Publish the recording, or recompute its states and compare them with the recorded states.

    Raises RecordingError, SettingsError, TactileError or OSError.
    """
    from softfinger.tools.recordings.reader import Recording

    if arguments.recompute and (range_text(arguments) or arguments.speed != 1.0):
        raise SettingsError(
            "replay: --recompute processes the whole recording; remove --from, --to and --speed"
        )
    if arguments.config is not None and not arguments.recompute:
        raise SettingsError("replay: --config requires --recompute")
    recording = Recording(arguments.file, to_stderr("replay"))
    if arguments.recompute:
        return _recompute(arguments, recording)
    _publish(arguments, recording)
    return 0


def _publish(arguments: argparse.Namespace, recording: Recording) -> None:
    sent = 0
    with StopCondition() as ending, Wire(arguments.address, arguments.keys) as wire:
        if not arguments.no_wait:
            to_stderr("replay")(
                f"waiting up to {_SUBSCRIBER_WAIT:g} s for a subscriber at {arguments.address}"
            )
            waited = time.monotonic() + _SUBSCRIBER_WAIT
            while (
                not ending.is_requested and time.monotonic() < waited and not wire.subscribed(0.1)
            ):
                pass
        began, first, newest = time.monotonic(), 0.0, math.inf
        selected = recording.messages(start=arguments.start, end=arguments.end)
        for topic, message in chain(_earlier_settings(recording, arguments.start), selected):
            if message.get("again") is not True:  # Repeated messages are older than the recording.
                # The system's Unix time may have been changed during the recording.
                t = recording.time(message)
                if not math.isfinite(t):
                    continue  # Ignore invalid messages.
                # The daemon's clock restarts with the machine.
                if t < newest - _CLOCK_STEP_MIN:
                    began, first = time.monotonic(), t
                newest = t
                due = began + (t - first) / arguments.speed
                while not ending.is_requested and (left := due - time.monotonic()) > 0.0:
                    wire.subscribed(min(left, 0.1))
            if ending.is_requested:
                break
            wire.send(topic, message)
            sent += 1
    print(f"{sent} of {recording.total} messages published")


def _earlier_settings(recording: Recording, start: float) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Yield the newest settings before ``start`` [s], as a daemon repeats them to subscribers."""
    if math.isfinite(start):
        earlier = recording.messages([schema.SETTINGS], end=start - 1e-9)
        for topic, message in deque(earlier, maxlen=1):
            yield topic, message | {"again": True}


def _recompute(arguments: argparse.Namespace, recording: Recording) -> int:
    from softfinger.daemon.profile.load import load
    from softfinger.tools.recordings.recomputed import recompute, recorded_settings
    from softfinger.tools.sweep import Progress

    # Before loading the kernels, check that the recording contains settings.
    recorded, _ = recorded_settings(recording)
    from softfinger.tools.processes.compile import build_kernels, print_event

    settings = None if arguments.config is None else load(arguments.config)
    build_kernels(settings or recorded, print_event)
    with Progress("recompute", recording.size) as progress:
        result = recompute(recording, settings, progress)
    print(
        f"{arguments.file}: {result.ticks} ticks, compared {result.states} states with "
        f"{result.fields} fields each"
    )
    if not result.from_start:
        print(
            "the recording starts after the first tick, so the loop's initial state is unknown: "
            "some recomputed states (all, if the hand was armed) may differ from the recorded "
            "ones; to record every tick, use `run --record`"
        )
    for count, what in ((result.missing_ticks, "ticks"), (result.missing_frames, "frames")):
        if count:
            print(f"{count} {what} are missing from the recording")
    if not result.differences:
        print("all states are bit-identical")
        return 0
    print(
        f"{'field':24} {'differ':>8} {'first tick':>10}  recorded → recomputed; largest difference"
    )
    for name, each in result.differences.items():
        line = f"{name:24} {each.count:8} {each.first_tick:10}  {each.recorded} → {each.recomputed}"
        print(line + (f"; {each.worst:.3g} at tick {each.worst_tick}" if each.worst else ""))
    return _EXIT_DIFFERENT


# Maximum number of messages queued for a subscriber. Excess messages are lost.
_QUEUE_LENGTH = 10_000
_SEND_TIMEOUT = 1.0  # timeout for the gateway to accept a message [s]
_POLL_INTERVAL = 1e-3  # s


class Wire:
    """Context manager that publishes on ``address``; ``keys`` restrict access.

    Raises RecordingError if the address cannot be bound. An address that other machines can reach
    requires ``keys``.
    """

    def __init__(self, address: str, keys: Path | None = None) -> None:
        fault = address_problem(address, "" if keys is not None else "--keys")
        if fault:
            raise RecordingError(f"--address: {fault}")
        folder = "" if keys is None else str(keys)
        config = Config(
            address, "", GATEWAY_TOPICS, _QUEUE_LENGTH, keys=folder, stream_setting="--address"
        )
        self._gateway = Gateway(config)
        try:
            self._gateway.wait()
        except AddressError as error:
            self._gateway.close()
            raise RecordingError(str(error)) from None
        self._link = self._gateway.link

    def subscribed(self, seconds: float) -> bool:
        """Wait for ``seconds``; return True if there are subscribers."""
        time.sleep(seconds)
        self._link.look()
        return bool(self._link.wanted)

    def send(self, topic: bytes, message: dict[str, Any]) -> None:
        """Publish one message as soon as the gateway can accept it."""
        if topic not in schema.TOPICS:  # This topic belongs to another version of softfinger.
            return
        give_up = time.monotonic() + _SEND_TIMEOUT
        while not self._link.look() and time.monotonic() < give_up:
            time.sleep(_POLL_INTERVAL)
        publish(self._link, topic, pack(message))

    def __enter__(self) -> Wire:
        return self

    def __exit__(self, *_: object) -> None:
        self._gateway.close()
