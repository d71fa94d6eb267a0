"""Interface of every servo backend to the loop, and the backend that the settings name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.backends import backend
from softfinger.daemon.clock import Clock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Goal, Reading

FloatArray = NDArray[np.float64]
Status = Literal["pass", "note", "fixed", "warn", "FAIL"]


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a check of one device or of the machine, and how to fix it.

    ``FAIL`` keeps the daemon from working, ``warn`` makes it work worse, the others are well.
    """

    status: Status
    subject: str  # as ``servo 1 (left)``
    text: str  # what was found, and what was expected
    fix: str = ""  # a command or an action; empty when nothing is to be done

    def __str__(self) -> str:
        text = f"{self.subject}: {self.text}"
        return f"{text}: {self.fix}" if self.fix else text


class Servos(Protocol):
    """Joints of the hand, in one of three operating modes (``servos.mode``).

    In each of them ``goal.q`` is the goal angle of a joint:

    - *current-based position* (5): the servo's own position loop, with the motor's current within
      ± ``goal.current``.
    - *current* (0): the same meaning, but the loop runs here, once a tick, on the newest reading:
      ``servos.stiffness`` and ``servos.damping`` within ± ``goal.current``. Without readings the
      current stays what it was, until the servo's bus watchdog ends it.
    - *position* (3): the servo's own loop with all the current it has. ``goal.current`` is
      ignored, and torque on holds at once; it suits moving and no grasp.

    ``connect`` checks and never stiffens or moves the hand. ``read`` and ``write`` are called
    once a tick; a failed exchange shows in ``valid`` and in the counters and raises nothing,
    unless the port itself is gone.
    """

    def connect(self) -> None:
        """Open and check everything. Raises ServoError with the whole list of what is wrong."""

    def read(self, reading: Reading) -> None:
        """Fill ``reading`` in place.

        After a failed exchange ``valid`` is False and everything but ``seq`` stays, so that
        ``reading.t`` is the time of the last good one.
        Temperature and voltage need not be fresher than a second.
        """

    def torque_on(self) -> None:
        """Switch torque on and verify it; the goal is set to the present angle first.

        Raises ServoError when it could not be done or not be verified: it may be on then.
        """

    def torque_off(self, reading: Reading) -> bool:
        """Ask once for torque off and read, as `read` does; True once all servos confirm it.

        It waits no longer than `read`, so that the loop can ask at every tick until it is True.
        Raises ServoError when the port is gone.
        """

    def write(self, goal: Goal) -> None:
        """Send the goal angle and the current bound of each joint."""

    def counters(self) -> dict[str, int]:
        """Return exchanges that went wrong since connect, by kind: ``timeouts``, ``crc``, …"""

    def close(self) -> None:
        """Switch torque off as far as the bus allows, then close. Never raises."""


class JointPlant(Protocol):
    """Simulated joints with their motors, behind the simulated and the emulated servos.

    Index 0 is the left finger's joint; positive closes.
    """

    q: FloatArray  # true joint angles [rad] at the time last advanced to
    dq: FloatArray  # true joint velocities [rad/s]
    current: FloatArray  # true motor currents [A]

    def measured_current(self, joint: int) -> float:
        """Return the motor current [A] of a joint as its servo measures it."""

    def advance(self, t: float) -> None:
        """Advance to time t [s]; a time that is past does nothing."""

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """Command a joint's servo from now on.

        ``mode`` is 5 (current-based position: ``goal_current`` bounds the magnitude), 3 (position:
        likewise, with the model's own limit) or 0 (current: ``goal_current`` is signed).
        """

    def tune(self, joint: int, stiffness: float, damping: float, duty: float) -> None:
        """Set a servo's position gains and PWM from now on.

        ``stiffness`` of its position loop is relative to the factory's, ``damping`` [s] of that
        stiffness comes on top of the factory's, and ``duty`` is the share of the supply's voltage
        that its motor may get.
        """


def make_servos(settings: Settings, clock: Clock, hand: object) -> Servos | None:
    """Make the settings' servo backend, not yet connected; None in a scene without servos.

    ``hand``: the simulated hand, for backends that need it. Raises as the backend does.
    """
    found = backend("servos", settings.servos.backend)
    if settings.servos.backend == "none":
        return None
    scene = (settings, hand) if found.hand else (settings,)
    servos: Servos = found.load()(*scene, clock, *found.options(settings.plugins.tables))
    return servos
