"""Run ``softfinger monitor``: show a live page of the hand in the terminal.

This module parses the arguments, handles keys and signals, and redraws the page. If the output is
not a terminal, the monitor prints plain lines. `stream_state` collects the data and `monitor_page`
draws the page.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any, Self

import zmq

from softfinger.daemon.client.connection import subscribe
from softfinger.daemon.control.modes import GRIPPING_MODES
from softfinger.daemon.errors import SoftfingerError
from softfinger.tools.arguments import (
    WAIT_MAX,
    add_stream,
    client_keys,
    no_stream,
    to_stderr,
)
from softfinger.tools.stop_condition import StopCondition, available_signals
from softfinger.tools.terminal.monitor_page import MonitorPage
from softfinger.tools.terminal.status import describe
from softfinger.tools.terminal.stream_state import (
    DRAIN_COUNT_MAX,
    Commander,
    StreamState,
    printable,
)
from softfinger.tools.terminal.terminal import KeyDecoder, Terminal, TerminalGone

STEP_ANGLE = math.radians(5.0)  # object rotation per arrow-key press [rad]
# Each pair contains the upper limit of a force range [N] and the force step in this range [N].
_STEPS = ((1.0, 0.1), (5.0, 0.5), (math.inf, 1.0))
# Time for which a new force or angle replaces the value in the stream [s].
_ACCUMULATION_TIME = 1.0
_CONFIRMATION_TIME = 3.0  # time limit for the second press of d, which confirms disarming [s]
_COMMAND_KEYS = {"a": "arm", "r": "release", " ": "stop", "c": "clear", "d": "disarm", "w": "demo"}


class HandKeys:
    """Convert key presses to commands."""

    def __init__(self, feed: StreamState, commander: Commander) -> None:
        self._feed = feed
        self._commander = commander
        self._target: float | None = None  # object angle [rad]
        self._turned = -math.inf  # time of the last turn
        self._chosen = math.nan  # grasp force [N]
        self._pressed = -math.inf  # time of the last force change made on this page
        self._asked = -math.inf  # time of the first press of d during a grip

    def press(self, key: str, now: float) -> None:
        """Send the command assigned to a key; ignore unassigned keys."""
        if key in ("left", "right"):
            self._rotate(STEP_ANGLE if key == "right" else -STEP_ANGLE, now)
        elif key in "+=-_":
            self._change_force(1.0 if key in "+=" else -1.0, now)
        elif key == "g":
            self._grasp(now)
        elif key == "d" and self._gripping and now - self._asked > _CONFIRMATION_TIME:
            self._asked = now
            self._commander.refuse(now, "disarm: the object would fall; press d again to disarm")
        elif key in _COMMAND_KEYS:
            self._target = None
            self._commander.send(now, _COMMAND_KEYS[key], _COMMAND_KEYS[key])

    def force(self, now: float) -> float:
        """Return the current grip's requested force, or the force for the next grasp [N].

        Returns NaN if the force is unknown.
        """
        feed = self._feed
        if not self._gripping or self._adding(now):
            return feed.force_default if math.isnan(self._chosen) else self._chosen
        # The grip command may have been sent before this page was opened.
        candidates = (feed.commanded, feed.state.goal_force, self._chosen)
        return next((force for force in candidates if not math.isnan(force)), math.nan)

    @property
    def _gripping(self) -> bool:
        return self._feed.mode in GRIPPING_MODES

    def _adding(self, now: float) -> bool:
        """Return True while the stream may still contain the force from before a key press."""
        reply = self._commander.reply
        refused = reply is not None and not reply.ok and reply.at >= self._pressed
        return now - self._pressed < _ACCUMULATION_TIME and not refused

    def _change_force(self, sign: float, now: float) -> None:
        """Change the force by one step; if there is a grip, apply the new force at once."""
        present = self.force(now)
        if not math.isfinite(present):
            self._commander.refuse(now, "grasp: the hand's settings have not arrived yet")
            return
        step = next(step for limit, step in _STEPS if present + 0.01 * sign <= limit)
        target = round(step * (round(present / step) + sign), 3)
        self._chosen = min(max(target, step), self._feed.force_limit)
        self._pressed = now
        if self._gripping:
            self._grasp(now)

    def _grasp(self, now: float) -> None:
        self._target = None
        if math.isnan(self._chosen):
            self._commander.send(now, "grasp", "grasp")
        else:
            label = f"grasp with {self._chosen:.3g} N"
            self._commander.send(now, label, "grasp", force=self._chosen)

    def _rotate(self, step: float, now: float) -> None:
        """Rotate by one step from the goal angle, so that repeated key presses add up."""
        reply, state = self._commander.reply, self._feed.state
        pose = state.object
        refused = reply is not None and not reply.ok
        if self._target is None or refused or self._feed.mode not in ("rotating", "holding"):
            self._target = pose.angle if pose.valid and math.isfinite(pose.angle) else None
            if self._target is None:
                self._commander.refuse(now, "rotate: the object's angle is unknown")
                return
        elif now - self._turned > _ACCUMULATION_TIME and math.isfinite(state.goal_angle):
            self._target = state.goal_angle  # Another client may have changed the goal.
        self._target += step
        self._turned = now
        label = f"rotate to {math.degrees(self._target):.1f}°"
        self._commander.send(now, label, "rotate", angle=self._target)


REDRAW_INTERVAL = 0.1  # minimum time between redraws [s]
PLAIN_READ_INTERVAL = 0.1  # time between stream reads in plain mode [s]
PLAIN_LINE_INTERVAL = 1.0  # time between plain lines [s]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Show the hand on a live terminal page with keys to arm, grasp, rotate, release, stop and\n"
        "change the force. If the output is not a terminal, print a plain line every second."
    )
    add_stream(parser, client=True)
    parser.add_argument(
        "--plain", action="store_true", help="print plain lines instead of the page"
    )


def run(args: argparse.Namespace) -> int:
    """Run until q is pressed, a signal arrives, the duration has elapsed or the daemon exits.

    Returns 1 if no stream was received. Raises SoftfingerError.
    """
    state, commands = args.address
    if args.lifeline is not None:
        _lower_priority()
    keys = client_keys(args.keys)
    context: zmq.Context[Any] = zmq.Context(io_threads=1)
    feed = StreamState()
    try:
        if keys is not None:
            keys.guard(context)
        socket = subscribe(context, state, *feed.topics, queue=DRAIN_COUNT_MAX)
        commander = Commander(commands, args.client, keys)
        with _MonitorStop(args) as ending, contextlib.closing(commander):
            if _is_page(args):
                page = MonitorPage(feed, state, guarded=keys is not None)
                _run_page(page, socket, commander, ending)
            else:
                _run_plain(state, feed, socket, ending)
    except zmq.ZMQError as error:
        raise SoftfingerError(f"{state}, {commands}: {error}") from None
    finally:
        context.destroy(linger=0)
    if ending.why:
        to_stderr("monitor")(ending.why)
    return 1 if ending.why and feed.age(0.0) == math.inf else 0


def _lower_priority() -> None:
    """Reset the real-time priority that this process inherited from the daemon."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        os.nice(5)


def _is_page(args: argparse.Namespace) -> bool:
    dumb = sys.platform == "win32" or os.environ.get("TERM", "dumb") == "dumb"
    if args.plain or dumb or not sys.stdout.isatty():
        return False
    return (sys.stdout.encoding or "").lower().replace("-", "") == "utf8"


class _MonitorStop(StopCondition):
    """The monitor's stop condition, which also handles suspension and ``--no-wait``."""

    signals = available_signals("SIGINT", "SIGTERM", "SIGHUP")

    def __init__(self, args: argparse.Namespace) -> None:
        super().__init__(args.duration, args.lifeline)
        self.begin()
        self.why = ""  # message to print once the terminal is restored
        self.suspend = False
        self.terminal: Terminal | None = None
        self._no_wait: bool = args.no_wait
        self._keys: Path | None = args.keys
        # True if the daemon started this process, which then shares the daemon's process group.
        self.beside = args.lifeline is not None
        self._wait_until = time.monotonic() + WAIT_MAX

    def __enter__(self) -> Self:
        super().__enter__()
        self._before[signal.SIGWINCH] = signal.signal(signal.SIGWINCH, self.wake)
        self._before[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, self._pause)
        return self

    def end(self, *_: object) -> None:
        super().end()
        if self.terminal is not None and self.terminal.writing:
            raise TerminalGone("a signal arrived while the terminal was blocked")

    def _pause(self, *_: object) -> None:
        self.suspend = True
        self.wake()

    def watch(self, feed: StreamState, address: str, now: float) -> None:
        """End the monitor if there is no stream and ``--no-wait`` was given."""
        if not self._no_wait or self.is_met:
            return
        status = feed.status(now)
        if status == "lost":
            self.why = "the stream has ended"
        elif status == "waiting" and now > self._wait_until:
            self.why = no_stream(address, self._keys)
        if self.why:
            self.end()


def _run_page(
    page: MonitorPage, socket: zmq.Socket[Any], commander: Commander, ending: _MonitorStop
) -> None:
    keyboard = sys.stdin.fileno() if sys.stdin is not None and sys.stdin.isatty() else None
    page.keys = keyboard is not None
    terminal = Terminal(sys.stdout.fileno(), keyboard, suspendable=not ending.beside)
    page.coloured = terminal.coloured
    ending.terminal = terminal
    try:
        while not ending.is_met:
            with terminal:
                _page_loop(page, terminal, keyboard, socket, commander, ending)
            # Ctrl-Z suspends this process, and the shell takes over the terminal.
            if ending.suspend and not ending.is_met:
                ending.suspend = False
                os.kill(os.getpid(), signal.SIGSTOP)
    except TerminalGone:
        pass  # The terminal was closed.


def _page_loop(
    page: MonitorPage,
    terminal: Terminal,
    keyboard: int | None,
    socket: zmq.Socket[Any],
    commander: Commander,
    ending: _MonitorStop,
) -> None:
    keys = KeyDecoder()
    hand = HandKeys(page.feed, commander)
    due = time.monotonic()
    while not (ending.is_met or ending.suspend):
        keyboards = [] if keyboard is None else [keyboard]
        for each in ending.wait_readable(due - time.monotonic(), *keyboards):
            typed = _read(each)
            if not typed:
                keyboard = None  # Standard input was closed; continue without a keyboard.
            for key in keys.decode(typed):
                if key == "q":
                    return ending.end()
                if key == "?":
                    page.explains = not page.explains
                hand.press(key, time.monotonic())
        now = time.monotonic()
        if now < due:
            continue
        keys.settle()
        page.feed.drain(socket, now)
        ending.watch(page.feed, page.address, now)
        page.force = hand.force(now)
        width, height = terminal.size()
        terminal.draw(page.lines(width, height, now, commander.reply))
        due = max(due + REDRAW_INTERVAL, time.monotonic() + 0.5 * REDRAW_INTERVAL)


def _read(keyboard: int) -> bytes:
    try:
        return os.read(keyboard, 1024)
    except OSError:
        return b""


def _run_plain(
    address: str, feed: StreamState, socket: zmq.Socket[Any], ending: _MonitorStop
) -> None:
    shown_status, due = "live", 0.0
    while not ending.is_met:
        ending.wait(PLAIN_READ_INTERVAL)
        now, clock = time.monotonic(), time.strftime("%H:%M:%S")
        feed.drain(socket, now)
        ending.watch(feed, address, now)
        status = feed.status(now)
        if status != shown_status:
            shown_status = status
            print(f"{clock} stream {status}: {address}", flush=True)
        for event in feed.news():
            print(f"{event.clock()} {event.level} {event.kind}: {event.text}", flush=True)
        if status in ("live", "stale") and now >= due:
            due = now + PLAIN_LINE_INTERVAL
            print(f"{clock} {printable(describe(feed.state))}", flush=True)
