"""The emulated hand: physics behind servos and tactile boards on ptys, in real time.

On a busy machine its time stands still for its daemon as the daemon's does for it, unless that
one's ``loop.clock`` is ``real``: see `EmulatorClock`.

One thread, one event loop: it waits for bytes on the servos' pty or for the next thing that is
due, answers the servos first, and does at most one slower thing (a step of the physics, a frame)
before it looks for bytes again. Where requests come at even intervals, slower things wait until the
next one is answered.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import selectors
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softfinger.daemon.clock import Deadline
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.profile.factory import make_material, make_table
from softfinger.daemon.profile.settings import Settings, TactileSettings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.simulation.emulator.folder import ControlPort, FolderError, LinkFolder
from softfinger.daemon.simulation.emulator.plate import Plate, PlateError, parse_presses
from softfinger.daemon.simulation.emulator.pty_bus import PtyServoBus
from softfinger.daemon.simulation.emulator.tactile_board import ENCODERS, TactileBoard, encoder_for
from softfinger.daemon.simulation.faults import (
    MEASUREMENT_FAULTS,
    OBJECT,
    SERVOS,
    FaultError,
    FaultEvent,
    LineFaults,
    parse_faults,
)
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.simulation.sensor.simulated_tactile import SimulatedTactile
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from softfinger.daemon.types import FINGERS

_STEP = 0.002  # s, longest that the physics lags behind
_REQUESTS = ("report", "forget", "place")  # words to the control socket that are no fault
_TURNS = {"closed": 6.0, "open": -6.0, "zero": 0.0}  # rad; a joint's stops come before 6
_TURNING = 0.3  # A of the servo's motor, as strong as the hand that turns a joint is
_TURN_TIME = 1.0  # s
_STALL = 0.05  # s; a longer interruption is left out of the hand's time
_AHEAD = 0.002  # s that the hand's time may be ahead of its daemon's, which waits for the replies
_HELD = 0.0005  # s from one look for a new deadline to the next
# The board where a profile names none: that of config/hil.toml.
DEFAULT_BOARD = {
    "backend": "flexitac",
    "rows": 32,
    "cols": 32,
    "pitch": 0.0018125,
    "pascal_per_count": 500.0,
    "full_count": 255,
}


class EmulatorError(SoftfingerError):
    """The emulated hand can't be set up. The message says why, and how to fix it."""


class EmulatorClock:
    """Time of the emulated hand: real time from 0, less the interruptions of its process.

    Without that a process that was stopped for a minute would have to compute that minute, and
    would answer no client meanwhile. A daemon whose own time waits for a late machine sets
    deadlines: from one to the next this time goes on by as much as the daemon's, give or take
    `_AHEAD`, while ``servos`` have their torque on and are the daemon's.
    """

    waits = False

    def __init__(self, deadline: Deadline) -> None:
        self.servos: PtyServoBus | None = None
        self.held = False  # the last time was kept back
        self._deadline = deadline
        self._seen = 0.0
        self._bound = math.inf  # where time waits for the next deadline
        self._origin = self._last = time.monotonic()

    def now(self) -> float:
        """Return the hand's time [s]. What passed since the last call counts up to a limit."""
        now = time.monotonic()
        self._origin += max(now - self._last - _STALL, 0.0)
        self._last = now
        t = now - self._origin
        if (deadline := self._deadline.t) != self._seen:
            step = max(deadline - self._seen, 0.0)
            self._bound = min(self._bound + step, min(t, self._bound) + step + _AHEAD)
            self._seen = deadline
        self.held = False
        if t > self._bound and self.servos is not None:
            if not self.servos.driven():
                self._bound = math.inf  # nothing moves, or that daemon is gone
            elif t > (bound := max(self._bound, self.servos.answering_until)):
                self.held = True
                self._origin += t - bound
                t = bound
        return t

    def wall(self) -> float:
        """Return Unix time [s]."""
        return time.time()

    def sleep_until(self, t: float) -> float:
        """Return at the hand's time ``t``: how late it woke up [s]."""
        while (delay := t - self.now()) > 0.0:
            time.sleep(min(delay, 0.5 * _STALL))
        return -delay


@dataclass(frozen=True, slots=True)
class EmulatedServos:
    """Emulation options of the servos, beside the settings."""

    baud: int = 0  # 0: they answer at once and at any rate
    factory: bool = False  # as they leave the factory but for their IDs and rate
    ids: tuple[int, ...] | None = None  # others than the settings', even one for both


class Emulator:
    """An emulated hand on ptys, linked in ``folder``; :meth:`run` keeps it alive.

    The scene of ``settings`` says what there is: a finger that is absent has no board, and servos
    or tactile backends of ``none`` have no port.
    """

    def __init__(
        self,
        settings: Settings,
        folder: Path,
        *,
        servos: EmulatedServos | None = None,
        faults: Iterable[str] = (),
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Build it; nothing answers before :meth:`run`.

        ``faults``: see :func:`parse_faults`. ``tell`` takes the log's lines: faults that begin, and
        where a plate has come to rest. No signal handler may raise meanwhile: what has been made
        would stay behind.
        Raises EmulatorError, and SettingsError when the settings' material is no stress-strain law.
        """
        self._closers: list[Callable[[], None]] = []
        self._wake = os.pipe()
        self._closers.append(self._close_wake)
        self._stopping = False
        # poll and epoll would wait for whole milliseconds.
        self._selector = selectors.SelectSelector()
        self._selector.register(self._wake[0], selectors.EVENT_READ)
        self._servos: PtyServoBus | None = None
        self._boards: dict[str, TactileBoard] = {}
        self._sources: dict[str, SimulatedTactile] = {}
        self._plates: dict[str, Plate] = {}
        self._turned = 0.0  # when a person's hand has turned a joint
        self._tell = tell
        self._advance_due = 0.0
        try:
            servos = servos or EmulatedServos()
            self._ids = settings.servos.ids if servos.ids is None else servos.ids
            self._events = parse_faults(faults, self._ids)
            self._links = LinkFolder(folder)
            self._closers.append(self._links.close)
            self._control = ControlPort(folder, self._answer, self._selector)
            self._closers.append(self._control.close)
            settings = with_board(settings)
            self._simulation = settings.simulation
            deadline = Deadline(self._links.path / Deadline.NAME, os.O_CREAT)
            self._closers.append((self._links.path / Deadline.NAME).unlink)
            self.clock = EmulatorClock(deadline)
            table = make_table(settings, make_material(settings.material))
            self.hand = SimulatedHand(settings, 0.0, table)
            if settings.servos.backend != "none":
                self._add_servos(settings, servos)
            if settings.tactile.backend != "none":
                for finger in sorted(FINGERS.index(name) for name in settings.scene.fingers):
                    self._add_board(settings, finger)
        except (FolderError, FaultError) as error:
            self.close()
            raise EmulatorError(str(error)) from None
        except BaseException:
            self.close()
            raise

    def _add_servos(self, settings: Settings, line: EmulatedServos) -> None:
        try:
            bus = ServoBus.from_settings(
                settings, self.hand, ids=self._ids, baud=line.baud, factory=line.factory
            )
        except ValueError as error:
            raise EmulatorError(str(error)) from None
        servos = PtyServoBus(bus, baud=line.baud, clock=self.clock.now)
        self._closers.append(servos.unplug)
        self._links.link("servos", servos.path)
        self._servos = self.clock.servos = servos
        self._selector.register(servos, selectors.EVENT_READ)

    def _add_board(self, settings: Settings, finger: int) -> None:
        source = SimulatedTactile(settings, self.hand, self.clock, finger)
        source.open()
        tactile, simulation = settings.tactile, settings.simulation
        board = TactileBoard(
            source,
            encoder_for(tactile.backend, tactile.full_count),
            tactile.rate,
            simulation.tactile_delay,
            seed=simulation.seed + finger,
        )
        self._sources[FINGERS[finger]] = source
        self._boards[FINGERS[finger]] = board
        self._selector.register(board, selectors.EVENT_READ, board.hear)
        self._closers.append(board.close)
        self._links.link(f"tactile-{FINGERS[finger]}", board.path)

    def run(self, on_ready: Callable[[], None] = lambda: None) -> None:
        """Answer until :meth:`end`. ``on_ready`` is called once everything answers."""
        ready = False
        while not self._stopping:
            self._turn()
            if not ready and all(source.latest() is not None for source in self._sources.values()):
                ready = True
                on_ready()

    def end(self) -> None:
        """End :meth:`run`; may be called from a signal handler or another thread."""
        self._stopping = True
        with contextlib.suppress(OSError):
            os.write(self._wake[1], b"x")

    def close(self) -> None:
        """Take the ports and their links away. Never raises."""
        while self._closers:
            with contextlib.suppress(OSError):
                self._closers.pop()()

    def _close_wake(self) -> None:
        for end in self._wake:
            os.close(end)

    # --- the event loop --------------------------------------------------------------------------

    def _turn(self) -> None:
        """Wait for bytes or for what is due, and do it: servos first, one slow thing at most."""
        servos, boards = self._servos, self._boards.values()
        due = min([self._advance_due, *[board.next_event() for board in boards]])
        start = self.clock.now()
        if servos is not None:
            due = min(due, servos.next_event())
        # A time that stands still comes to nothing that is due: no haste then.
        wait = max(due - start, _HELD if self.clock.held else 0.0)
        ready = [key for key, _ in self._selector.select(wait)]
        t = self.clock.now()
        asked = servos in [key.fileobj for key in ready]
        if servos is not None and (asked or servos.next_event() <= t):
            servos.service(t)
        for key in ready:
            if key.data is not None:
                key.data()
        late = [board for board in boards if board.next_event() <= t]
        if late:
            self._advance(t)
            late[0].service(t)
        elif self._advance_due <= t:
            self._advance(t)

    def _advance(self, t: float) -> None:
        while self._events and self._events[0].after <= t:
            self._apply(self._events.pop(0), t)
        if self._servos is not None:
            self._servos.bus.advance(t)
        else:
            self.hand.advance(t)
        self._advance_due = t + _STEP
        for finger, plate in list(self._plates.items()):
            if press := plate.reached(t):
                self._tell(f"plate: {finger} {press}")
                if press.is_clear:
                    self._take_away(finger)

    # --- requests and faults ---------------------------------------------------------------------

    def request(self, text: str) -> str:
        """Take words of the control socket: ``ok``, or ``error: `` and why none of them counts.

        A time behind a word counts from now. With ``report`` among them the answer is
        :meth:`report` as JSON; ``forget`` begins the record again; ``place`` puts the object back
        where it was at the start, at rest and with no load on it, and takes plates away.
        ``press …`` is for :meth:`press`, ``turn …`` for :meth:`turn`.
        """
        words = text.split()
        if words[:1] == ["turn"]:
            return self.turn(words[1:])
        if words[:1] == ["press"]:
            return self.press(text.partition("press")[2])
        try:
            faults = [word for word in words if word not in _REQUESTS]
            fresh = parse_faults(faults, self._ids)
        except FaultError as error:
            return f"error: {error}"
        now = self.clock.now()
        reply = json.dumps(self.report(now)) if "report" in words else "ok"
        if "forget" in words and self._servos is not None:
            self._servos.bus.forget(now)
        if "place" in words:
            self.hand.place_object()
            for finger in list(self._plates):
                self._take_away(finger)
        self._events += [event._replace(after=now + event.after) for event in fresh]
        self._events.sort(key=lambda event: event.after)
        self._advance_due = now  # so that what starts now does
        return reply

    def press(self, text: str) -> str:
        """Let plates do the presses of ``text``; without any, tell how far the last ones are.

        ``error: `` and why not, or JSON: ``wait``, the time until the last press is reached [s], 0
        then.
        """
        now = self.clock.now()
        if text.strip():
            try:
                presses = parse_presses(text, self.hand.table, self._simulation.modulus_scale)
            except PlateError as error:
                return f"error: {error}"
            if missing := presses.keys() - self._sources.keys():
                return f"error: press: no sensor under the {missing.pop()} tip"
            for finger, sequence in presses.items():
                plate = self._plates.setdefault(finger, Plate())
                plate.go(sequence, now)
                self._sources[finger].stage = plate
        ends = [plate.arrives - now for plate in self._plates.values()]
        return json.dumps({"wait": max(0.0, *ends) if ends else 0.0})

    def _take_away(self, finger: str) -> None:
        """Take a tip's plate away: its sensor feels the object again."""
        del self._plates[finger]
        self._sources[finger].stage = None

    def turn(self, words: Sequence[str]) -> str:
        """Let a person's hand turn joints: ``left=closed``, to its stop; ``open``; ``zero``.

        It holds them until the servos are written to. ``error: `` and why not, or JSON as of
        :meth:`press`; without words how long the last way takes yet.
        """
        now = self.clock.now()
        turns = [word.partition("=") for word in words]
        for finger, _, pose in turns:
            if finger not in FINGERS or pose not in _TURNS or self._servos is None:
                return f"error: turn: expected left or right={'|'.join(_TURNS)}, and servos"
            if self._servos.bus.servos[FINGERS.index(finger)].torque_on:
                return f"error: turn: torque of the {finger} servo is on"
        for finger, _, pose in turns:
            joint = FINGERS.index(finger)
            self.hand.drive(joint, reg.CURRENT_BASED_POSITION_MODE, True, _TURNS[pose], _TURNING)
            self._turned = now + _TURN_TIME
        return json.dumps({"wait": max(0.0, self._turned - now)})

    def _answer(self, text: str) -> str:
        """:meth:`request`, with what starts now in force before the reply goes out."""
        reply = self.request(text)
        self._advance(self.clock.now())
        return reply

    def report(self, t: float) -> dict[str, Any]:
        """Report the traffic on the servos' wire and the hand's true state; times are the hand's
        [s].

        ``monotonic`` is time.monotonic() at ``t``, to compare with times of other processes.
        """
        servos = self._servos.bus.report(t) if self._servos is not None else []
        held = {"pose": self.hand.object_pose.tolist()}
        hand = {"servos": servos, "object": held, "force": self.hand.force.tolist()}
        return {"t": t, "monotonic": time.monotonic(), **hand}

    def _apply(self, event: FaultEvent, t: float) -> None:
        after, part, kind, value, over = event
        self._tell(f"fault: {event}")
        if part == OBJECT:
            self.hand.load(**{kind: value})
            return
        if kind in MEASUREMENT_FAULTS:
            self.hand.measurement_faults[FINGERS.index(part)].begin(kind, value, after, over)
            return
        if kind == "well" and part in FINGERS:
            self.hand.measurement_faults[FINGERS.index(part)].clear()
        device = self._servos if part == SERVOS else self._boards.get(part)
        if device is None:
            return
        name = part if part == SERVOS else f"tactile-{part}"
        if kind == "unplug":
            self._links.unlink(name)
            if device.plugged:
                self._selector.unregister(device)
            device.unplug()
        elif kind == "plug":
            if not device.plugged:
                device.plug()
                hear = device.hear if isinstance(device, TactileBoard) else None
                self._selector.register(device, selectors.EVENT_READ, hear)
                self._links.link(name, device.path)
        elif isinstance(device, TactileBoard):
            if kind == "well":
                device.faults.clear()
            else:
                device.faults[kind] = value
        elif kind == "well":
            device.bus.faults.rates = LineFaults()
        else:
            device.bus.fault(kind, value, t)


def with_board(settings: Settings) -> Settings:
    """Return ``settings`` with the default board where its tactile backend has no framing."""
    if settings.tactile.backend in (*ENCODERS, "none"):
        return settings
    tactile = TactileSettings.model_validate({**settings.tactile.model_dump(), **DEFAULT_BOARD})
    return settings.model_copy(update={"tactile": tactile})
