"""Emulated hardware on pseudo-terminals: a hand in a process, or only servos in a thread."""

from __future__ import annotations

import json
import math
import select
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.control_table import COUNTS_PER_TURN, VELOCITY_UNIT, by_name
from softfinger.daemon.servos.joint import JointScale
from softfinger.daemon.simulation.emulator.folder import carry_out, find_ports
from softfinger.daemon.simulation.emulator.pty_bus import PtyServoBus
from softfinger.daemon.simulation.faults import ALL, SERVOS, FaultError, parse_faults
from softfinger.daemon.simulation.servo_model.servo import EmulatedServo, prepared
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from softfinger.tools.processes.emulate import emulator_process

FloatArray = NDArray[np.float64]

_SERVOS_MAX = 8
_LOOK = 0.005  # interval between checks for changes made by another thread [s]
_STALL = 0.5  # maximum stall of this process that still counts as servo time [s]


class EmulatedHand:
    """Emulated hand in a `softfinger emulate` process that this context starts and ends.

    The first start on a machine compiles kernels, which takes minutes.

    Parameters
    ----------
    profile : name or file of a profile; None for the default hand
    changes : settings to change, in the form of ``--set``
    options : other options of `softfinger emulate`: ``model="XL330-M288"``, ``ids="1,7"``,
        ``baud=57600``, ``factory=True``

    Attributes
    ----------
    folder : folder of the ports, to be passed as ``--dir`` to `softfinger run --config hil`
    ports : paths of the serial ports ``servos``, ``tactile-left`` and ``tactile-right``

    Raises
    ------
    NoEmulator
        If the emulator has ended. The emulator prints its error message to standard error.
    """

    def __init__(
        self, profile: Path | str | None = None, changes: Sequence[str] = (), **options: object
    ) -> None:
        words = [f"--set={change}" for change in changes]
        words += [] if profile is None else [f"--config={profile}"]
        words += [f"--{name}" if on is True else f"--{name}={on}" for name, on in options.items()]
        with ExitStack() as running:
            self.folder = Path(running.enter_context(TemporaryDirectory(prefix="softfinger-")))
            running.enter_context(emulator_process(f"--dir={self.folder}", *words))
            self._running = running.pop_all()
        self.ports = {name: str(path) for name, path in find_ports(self.folder).items()}

    def send(self, words: str) -> str:
        """Send requests or faults in the same way as `softfinger emulate --send`; return the reply.

        For example, ``"place"`` puts the object back. ``"press depth=3mm"`` presses a plate onto
        the tips and waits until the plate has arrived. Raises Refused if a word is unknown.
        """
        return carry_out(self.folder, words)

    def fault(self, *words: str) -> None:
        """Start faults such as ``"left:silent"`` or ``"drop=0.01@2"``; ``"well"`` ends all faults.

        `softfinger help emulate` lists all faults. Raises Refused if a word is unknown.
        """
        self.send(" ".join(words))

    def report(self, forget: bool = False) -> dict[str, Any]:
        """Return the traffic on the servo bus and the true state of the hand.

        `softfinger help emulate` lists the fields. If ``forget`` is True, the recorded traffic is
        cleared afterwards.
        """
        report: dict[str, Any] = json.loads(self.send("report forget" if forget else "report"))
        return report

    def close(self) -> None:
        """End the process and remove its ports."""
        self._running.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class FreeJoints:
    """``count`` independent joints for servos without a hand, initially at rest at angle 0.

    This class implements :class:`JointPlant`. Each joint has inertia, viscous friction and Coulomb
    friction. The servo's position loop commands the current, which responds with a first-order lag.
    A fixed step makes runs deterministic. The constants approximate an XM430-W350 with a bare horn.
    """

    STEP = 0.0005  # s
    INERTIA = 0.002  # rotor inertia reflected to the gearbox output [kg·m²]
    VISCOUS = 0.05  # N·m·s/rad
    COULOMB = 0.02  # N·m
    TORQUE_CONSTANT = 1.78  # N·m/A
    CURRENT_LAG = 0.001  # s
    STIFFNESS = 8.0  # A/rad
    DAMPING = 0.10  # A·s/rad
    STALL = 3.21  # stall current at full supply voltage [A]

    def __init__(self, count: int = 2, start: float = 0.0) -> None:
        self._start = start
        self._done = 0  # number of steps since the start
        self.q: NDArray[np.float64] = np.zeros(
            count
        )  # joint angles [rad]; callers may change the angles
        self.dq: NDArray[np.float64] = np.zeros(count)  # rad/s
        self.current: NDArray[np.float64] = np.zeros(count)  # A
        # Torque-on flag, signed current, angle, and current limit of each joint.
        self._goals = [(False, 0.0, 0.0, 0.0)] * count
        # Stiffness, damping and duty of each joint; see `tune`.
        self._tuned = [(1.0, 0.0, 1.0)] * count

    def measured_current(self, joint: int) -> float:
        """Return the measured current; see :meth:`JointPlant.measured_current`."""
        return self.current.item(joint)

    def advance(self, t: float) -> None:
        """Advance to time t [s]."""
        count = int((t - self._start) / self.STEP + 1e-9) - self._done
        if count > 0:
            self._done += count
            for joint in range(len(self.q)):
                self._advance(joint, count)

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """Set a servo's mode and goals; see :meth:`JointPlant.drive`."""
        if mode == 0:
            self._goals[joint] = torque_on, goal_current, 0.0, 0.0
        else:
            self._goals[joint] = torque_on, 0.0, goal_q, abs(goal_current)

    def tune(self, joint: int, stiffness: float, damping: float, duty: float) -> None:
        """Set a servo's gains and PWM limit; see :meth:`JointPlant.tune`."""
        self._tuned[joint] = stiffness, damping, duty

    def _advance(self, joint: int, count: int) -> None:
        q, dq, current = (float(each[joint]) for each in (self.q, self.dq, self.current))
        torque_on, fixed, goal, bound = self._goals[joint]
        stiffness, damping, duty = self._tuned[joint]
        step, inertia, most = self.STEP, self.INERTIA, self.STALL * duty
        stiffness, damping = self.STIFFNESS * stiffness, self.DAMPING + self.STIFFNESS * damping
        slow = self.COULOMB * step / inertia
        for _ in range(count):
            wanted = min(max(stiffness * (goal - q) - damping * dq, -bound), bound) + fixed
            wanted = min(max(wanted, -most), most)
            change = (wanted - current) * step / self.CURRENT_LAG
            current = current + change if torque_on else 0.0
            dq += self.TORQUE_CONSTANT * current * step / inertia
            dq /= 1.0 + self.VISCOUS * step / inertia
            dq -= min(max(dq, -slow), slow)
            q += dq * step
        self.q[joint], self.dq[joint], self.current[joint] = q, dq, current


def free_servos(
    model: str = "XM430-W350",
    ids: Sequence[int] = (1, 2),
    *,
    baud: int = 0,
    counts: Sequence[int] = (),
    firmware: int | None = None,
    for_daemon: bool = False,
    t: float = 0.0,
    **options: Any,
) -> ServoBus:
    """Create factory-new servos on free joints at time ``t`` [s]; ``counts`` are their positions.

    If ``for_daemon`` is True, the servos have the return delay and the mode that `softfinger run`
    expects.
    """
    plant, chosen = FreeJoints(len(ids), t), by_name(model)
    radian = 2.0 * math.pi / COUNTS_PER_TURN
    eeprom = prepared(chosen, reg.CURRENT_BASED_POSITION_MODE) if for_daemon else {}
    if baud:
        eeprom |= {reg.BAUD_RATE: chosen.baud_rates.index(baud)}
    for joint, count in enumerate(counts):
        plant.q[joint] = count * radian
    scale = JointScale(1, 0, radian, VELOCITY_UNIT, chosen.current_unit)
    servos = [
        EmulatedServo(chosen, plant, k, scale, eeprom | {reg.ID: each}, firmware=firmware, t=t)
        for k, each in enumerate(ids)
    ]
    return ServoBus(servos, plant, **options)


class EmulatedBus:
    """One to eight emulated Dynamixel servos on a serial port, without a hand.

    The servos are factory-new, start in the middle of their range and rotate without a load. A
    thread runs the servos in real time until the context ends.

    Parameters
    ----------
    model, ids : model and IDs of the servos
    baud : if 0, the servos reply immediately at any baud rate; otherwise they reply only at this
        baud rate, with its transmission time
    bus : your own servos, used instead of new ones, for example on another plant

    Attributes
    ----------
    bus : the servos; use `call` to access them while the thread runs
    """

    def __init__(
        self,
        model: str = "XM430-W350",
        ids: Sequence[int] = (1, 2),
        *,
        baud: int = 0,
        bus: ServoBus | None = None,
    ) -> None:
        if not 1 <= len(ids) <= _SERVOS_MAX:
            raise ValueError(f"ids: found {len(ids)} servos, expected 1 to {_SERVOS_MAX}")
        middle = [COUNTS_PER_TURN // 2] * len(ids)
        self.bus = bus or free_servos(model, ids, baud=baud, counts=middle)
        self._seen, self._origin = time.monotonic(), time.monotonic() - max(self.bus.now, 0.0)
        self._terminal = PtyServoBus(self.bus, baud=baud, clock=self.now)
        self._between_packets = threading.Lock()
        self._running = True
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def port(self) -> str:
        """Path of the serial port, which changes when the port is plugged in again."""
        return self._terminal.path

    def call(self, job: Callable[[], Any]) -> Any:
        """Run ``job`` between two packets on the bus, and return the result of ``job``."""
        with self._between_packets:
            return job()

    def fault(self, *words: str) -> None:
        """Start faults such as ``"silent=2"`` or ``"drop=0.1"``; ``"well"`` ends all faults.

        Raises FaultError for unknown words, and for faults that require a hand or have a start
        time.
        """
        events = parse_faults(words, tuple(servo.id for servo in self.bus.servos))
        for event in events:
            if event.part not in (SERVOS, ALL) or event.after:
                raise FaultError(f"{event}: expected a servo fault that starts immediately")
        with self._between_packets:
            for event in events:
                self._terminal.apply_fault(event.kind, event.value, self.now())

    def report(self) -> list[dict[str, Any]]:
        """Return the state and the bus traffic of each servo, as in `EmulatedHand.report`."""
        report: list[dict[str, Any]] = self.call(lambda: self.bus.report(self.now()))
        return report

    def close(self) -> None:
        """End the thread and remove the port."""
        self._running = False
        self._thread.join()
        self._terminal.unplug()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve(self) -> None:
        while self._running:
            wait = min(max(0.0, self._terminal.next_event() - self.now()), _LOOK)
            ports = [self._terminal] if self._terminal.plugged else []
            with suppress(OSError, ValueError):  # Another thread may have unplugged the port.
                select.select(ports, [], [], wait)
            with self._between_packets:
                self._terminal.service(self.now())

    def now(self) -> float:
        """Return the servos' time [s], which is real time minus long stalls of this process."""
        seen, self._seen = self._seen, time.monotonic()
        self._origin += max(self._seen - seen - _STALL, 0.0)
        return self._seen - self._origin
