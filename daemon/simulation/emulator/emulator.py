"""Emulate a hand in real time, with servos and tactile boards on pseudo-terminals.

On a busy machine, the emulator and the daemon wait for each other (see `EmulatorClock`). If the
daemon's ``loop.clock`` is ``real``, neither process waits for the other.

The event loop runs in a single thread and waits for incoming bytes or the next event. Each pass of
the loop first serves the servos and then computes at most one physics step or one tactile frame.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import selectors
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from softfinger.daemon.clock import Deadline
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.profile.settings import Settings, TactileSettings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.simulation.emulator.folder import ControlPort, LinkFolder, find_ports
from softfinger.daemon.simulation.emulator.plate import Plate, parse_presses
from softfinger.daemon.simulation.emulator.pty_bus import PtyServoBus
from softfinger.daemon.simulation.emulator.tactile_board import ENCODERS, TactileBoard, encoder_for
from softfinger.daemon.simulation.faults import (
    ALL,
    SERVOS,
    WELL,
    FaultError,
    FaultEvent,
    parse_faults,
)
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from softfinger.daemon.simulation.simulated_tactile import SimulatedTactile
from softfinger.daemon.types import FINGERS

_STEP = 0.002  # maximum interval between physics updates [s]
_REQUESTS = ("report", "forget", "place")  # words that are requests rather than faults
# Joint goals [rad]. A goal of 6 rad lies beyond the joint stops.
_TURN_GOALS = {"closed": 6.0, "open": -6.0, "zero": 0.0}
_TURN_CURRENT = 0.3  # motor current that simulates a person turning a joint [A]
_TURN_TIME = 1.0  # s
_STALL_TIME = 0.05  # maximum time that one call adds to the hand's clock [s]
# Maximum lead of the hand's clock over the daemon's clock [s].
_AHEAD_TIME = 0.002
_POLL_INTERVAL = 0.0005  # interval between checks for a new deadline [s]
# Default board, as in config/hil.toml.
DEFAULT_BOARD = {
    "backend": "flexitac",
    "rows": 32,
    "cols": 32,
    "pitch": 0.0018125,
    "pascal_per_count": 500.0,
    "full_count": 255,
}


class EmulatorClock:
    """Clock that measures real time but excludes interruptions of the emulator process.

    If the clock continued during an interruption, the emulator would have to simulate the missed
    time before its next reply. A daemon that can pause its clock on a busy machine sets deadlines
    for the emulator. While torque is on, the emulator clock and the daemon clock advance by the
    same amount from one deadline to the next. The emulator clock leads the daemon clock by at most
    `_AHEAD_TIME`.
    """

    pauses_when_late = False
    wall = staticmethod(time.time)

    def __init__(self, deadline: Deadline) -> None:
        self.servos: PtyServoBus | None = None
        self.held = False  # True if the deadline limited the last returned time
        self._deadline = deadline
        self._seen = 0.0
        self._bound = math.inf  # time at which the clock pauses; a new deadline resumes it
        self._origin = self._last = time.monotonic()

    def now(self) -> float:
        """Return the hand's time [s], which increases by at most `_STALL_TIME` per call."""
        now = time.monotonic()
        self._origin += max(now - self._last - _STALL_TIME, 0.0)
        self._last = now
        t = now - self._origin
        if (deadline := self._deadline.t) != self._seen:
            step = max(deadline - self._seen, 0.0)
            self._bound = min(self._bound + step, min(t, self._bound) + step + _AHEAD_TIME)
            self._seen = deadline
        self.held = False
        if t > self._bound and self.servos is not None:
            if not self.servos.driven():
                self._bound = math.inf  # Torque is off, or the daemon has exited.
            elif t > (bound := max(self._bound, self.servos.answering_until)):
                self.held = True
                self._origin += t - bound
                t = bound
        return t

    def sleep_until(self, t: float) -> float:
        """Sleep until the hand's time is ``t``, and return the wake-up delay [s]."""
        while (delay := t - self.now()) > 0.0:
            time.sleep(min(delay, 0.5 * _STALL_TIME))
        return -delay


class Emulator:
    """Emulated hand; ``folder`` contains links to its ports, which :meth:`run` serves.

    A finger that is not in the scene has no tactile board. The ``none`` backends have no ports.
    """

    def __init__(
        self,
        settings: Settings,
        folder: Path,
        *,
        baud: int = 0,
        factory: bool = False,
        ids: tuple[int, ...] | None = None,
        faults: Iterable[str] = (),
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Create the hand. The hand does not respond until :meth:`run` is called.

        An exception that a signal handler raises during this call can leave files behind.

        Parameters
        ----------
        settings, folder, faults
            Hand settings, folder for the links, and faults (see :func:`parse_faults`).
        baud, factory, ids
            See :meth:`ServoBus.from_settings`. If ``baud`` is 0, servos reply immediately at any
            baud rate.
        tell
            Function that receives a log line when a fault begins or a plate reaches its position.

        Raises
        ------
        FolderError, FaultError
            If the folder can't be used or a fault is invalid.
        SettingsError
            If the material is not a valid stress-strain law, or if the servo model does not support
            the baud rate.
        """
        self._closing = contextlib.ExitStack()
        self._wake = os.pipe()
        for end in self._wake:
            self._closing.callback(os.close, end)
        self._stopping = False
        # `poll` and `epoll` have a resolution of only 1 ms.
        self._selector = selectors.SelectSelector()
        self._selector.register(self._wake[0], selectors.EVENT_READ)
        self._servos: PtyServoBus | None = None
        self._boards: dict[str, TactileBoard] = {}
        self._plates: dict[str, Plate] = {}
        self._turned = 0.0  # time at which the last manual joint rotation ends
        self._tell = tell
        self._advance_due = 0.0
        try:
            self._ids = settings.servos.ids if ids is None else ids
            self._events = parse_faults(faults, self._ids)
            self._links = LinkFolder(folder)
            self._closing.callback(self._links.close)
            self._control = ControlPort(folder, self._answer, self._selector)
            self._closing.callback(self._control.close)
            settings = with_board(settings)
            self._simulation = settings.simulation
            deadline = Deadline(self._links.path / Deadline.NAME, os.O_CREAT)
            self._closing.callback((self._links.path / Deadline.NAME).unlink)
            self.clock = EmulatorClock(deadline)
            self.hand = SimulatedHand(settings)
            if settings.servos.backend != "none":
                self._add_servos(settings, baud, factory)
            if settings.tactile.backend != "none":
                for finger in settings.scene.indices:
                    self._add_board(settings, finger)
        except BaseException:
            self.close()
            raise

    def _add_servos(self, settings: Settings, baud: int, factory: bool) -> None:
        bus = ServoBus.from_settings(settings, self.hand, ids=self._ids, baud=baud, factory=factory)
        servos = PtyServoBus(bus, baud=baud, clock=self.clock.now)
        self._closing.callback(servos.unplug)
        self._links.link("servos", servos.path)
        self._servos = self.clock.servos = servos
        self._selector.register(servos, selectors.EVENT_READ)

    def _add_board(self, settings: Settings, finger: int) -> None:
        source = SimulatedTactile(settings, self.hand, self.clock, finger)
        source.open()
        tactile = settings.tactile
        board = TactileBoard(
            source,
            encoder_for(tactile.backend, tactile.full_count),
            seed=settings.simulation.seed + finger,
        )
        self._boards[FINGERS[finger]] = board
        self._selector.register(board, selectors.EVENT_READ, board.hear)
        self._closing.callback(board.unplug)
        self._links.link(f"tactile-{FINGERS[finger]}", board.path)

    def run(self, on_ready: Callable[[], None] = lambda: None) -> None:
        """Call ``on_ready``, and serve the ports until :meth:`end` is called."""
        on_ready()
        while not self._stopping:
            self._serve_once()

    @property
    def ports(self) -> dict[str, Path]:
        """Links to the ports: ``servos``, ``tactile-left``, ``tactile-right``."""
        return find_ports(self._links.path)

    def end(self) -> None:
        """End :meth:`run`. Signal handlers and other threads may call this method."""
        self._stopping = True
        with contextlib.suppress(OSError):
            os.write(self._wake[1], b"x")

    def close(self) -> None:
        """Remove the ports and their links. Never raises."""
        with contextlib.suppress(OSError):
            self._closing.close()

    # --- the event loop --------------------------------------------------------------------------

    def _serve_once(self) -> None:
        """Wait for bytes or the next event, and then run one pass of the event loop."""
        servos, boards = self._servos, self._boards.values()
        due = min([self._advance_due, *[board.next_event() for board in boards]])
        start = self.clock.now()
        if servos is not None:
            due = min(due, servos.next_event())
        # While the hand's clock is paused, no event becomes due, so wait briefly to avoid a busy
        # loop.
        wait = max(due - start, _POLL_INTERVAL if self.clock.held else 0.0)
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
            late[0].service()
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
        """Handle a message from the control socket and return ``ok``, JSON or an error.

        Each word of the message is either a fault or a request. Fault times are relative to the
        current time. These requests exist:

        - ``report``: reply with the result of :meth:`report` as JSON.
        - ``forget``: clear the bus record.
        - ``place``: reset the object's pose, velocity and load, and remove all plates.
        - ``press PRESSES`` (first word): see `plate.parse_presses`.
        - ``turn FINGER=POSE …`` (first word): turn joints as a person would. The poses are ``zero``
          and the two joint stops, ``closed`` and ``open``. The emulator holds the joints in these
          poses until a client writes to the servos.

        The reply to ``press`` and ``turn`` contains the time ``wait`` [s] until all plates or
        joints have arrived. ``press`` and ``turn`` alone only request this time. If any word is
        invalid, all words are ignored and the reply is ``error: `` and the reason.
        """
        kind, _, arguments = text.strip().partition(" ")
        now = self.clock.now()
        try:
            if kind == "turn":
                reply = json.dumps({"wait": self._turn(arguments.split(), now)})
            elif kind == "press":
                reply = json.dumps({"wait": self._press(arguments.strip(), now)})
            else:
                reply = self._start(text.split(), now)
        except SoftfingerError as error:
            return f"error: {error}"
        self._advance_due = now  # Faults without a start time begin immediately.
        return reply

    def _start(self, words: list[str], now: float) -> str:
        """Start faults, and handle the requests that are single words."""
        # A client may have changed the IDs.
        ids = self._ids
        if self._servos is not None:
            ids = tuple(servo.id for servo in self._servos.bus.servos)
        events = parse_faults([word for word in words if word not in _REQUESTS], ids)
        reply = json.dumps(self.report(now)) if "report" in words else "ok"
        if "forget" in words and self._servos is not None:
            self._servos.bus.forget(now)
        if "place" in words:
            self.hand.place_object()
            for finger in list(self._plates):
                self._take_away(finger)
        self._events += [event._replace(after=now + event.after) for event in events]
        self._events.sort(key=lambda event: event.after)
        return reply

    def _press(self, text: str, now: float) -> float:
        """Start the presses in ``text``; return the time until the last plate arrives [s]."""
        if text:
            presses = parse_presses(text, self.hand.table, self._simulation.modulus_scale)
            if missing := presses.keys() - self._boards.keys():
                raise FaultError(f"press: the scene has no sensor under the {missing.pop()} tip")
            for finger, sequence in presses.items():
                plate = self._plates.setdefault(finger, Plate())
                plate.go(sequence, now)
                self._boards[finger].source.stage = plate
        return max([0.0, *(plate.arrives - now for plate in self._plates.values())])

    def _take_away(self, finger: str) -> None:
        """Remove the plate from a tip, so that the tip's sensor measures the object again."""
        del self._plates[finger]
        self._boards[finger].source.stage = None

    def _turn(self, words: list[str], now: float) -> float:
        """Turn the joints, and return the time until all joints have arrived [s]."""
        turns = [word.partition("=") for word in words]
        for finger, _, pose in turns:
            if finger not in FINGERS or pose not in _TURN_GOALS or self._servos is None:
                raise FaultError(
                    "turn: expected left=POSE or right=POSE in a scene with servos; POSE is one of "
                    f"{', '.join(_TURN_GOALS)}"
                )
            if self._servos.bus.servos[FINGERS.index(finger)].torque_on:
                raise FaultError(
                    f"turn: torque of the {finger} servo is on; switch torque off first"
                )
        for finger, _, pose in turns:
            joint = FINGERS.index(finger)
            self.hand.drive(
                joint, reg.CURRENT_BASED_POSITION_MODE, True, _TURN_GOALS[pose], _TURN_CURRENT
            )
            self._turned = now + _TURN_TIME
        return max(0.0, self._turned - now)

    def _answer(self, text: str) -> str:
        """Handle a request, apply the faults that are already due, and return the reply."""
        reply = self.request(text)
        self._advance(self.clock.now())
        return reply

    def report(self, t: float) -> dict[str, Any]:
        """Return the servo bus traffic and the true state of the hand.

        Times [s] refer to the hand's clock. ``monotonic`` is the machine's monotonic time at ``t``.
        Other processes can compare ``monotonic`` with their own monotonic clocks.
        """
        servos = self._servos.bus.report(t) if self._servos is not None else []
        held = {"pose": self.hand.object_pose.tolist()}
        hand = {"servos": servos, "object": held, "force": self.hand.force.tolist()}
        return {"t": t, "monotonic": time.monotonic(), **hand}

    def _apply(self, event: FaultEvent, t: float) -> None:
        self._tell(str(event))
        if self.hand.apply_fault(event) and event.kind != WELL:
            return
        devices = {SERVOS: self._servos, **self._boards}
        for part in devices if event.part == ALL else (event.part,):
            device = devices.get(part)
            if device is None:
                continue
            name, was_plugged = part if part == SERVOS else f"tactile-{part}", device.plugged
            if was_plugged and event.kind == "unplug":
                self._selector.unregister(device)
                self._links.unlink(name)
            device.apply_fault(event.kind, event.value, t)
            if device.plugged and not was_plugged:
                hear = device.hear if isinstance(device, TactileBoard) else None
                self._selector.register(device, selectors.EVENT_READ, hear)
                self._links.link(name, device.path)


def with_board(settings: Settings) -> Settings:
    """Return the settings, with `DEFAULT_BOARD` if the configured board has no encoder."""
    if settings.tactile.backend in (*ENCODERS, "none"):
        return settings
    tactile = TactileSettings.model_validate({**settings.tactile.model_dump(), **DEFAULT_BOARD})
    return settings.model_copy(update={"tactile": tactile})
