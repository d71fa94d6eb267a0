"""Define the interface between servo backends and the loop, and create the selected backend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.backends import backend
from softfinger.daemon.clock import Clock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Goal, Reading

__all__ = ["Servos"]

FloatArray = NDArray[np.float64]
Status = Literal["pass", "note", "fixed", "warn", "FAIL"]


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a check of one device or of the machine, and how to fix it.

    ``FAIL`` keeps the daemon from working and ``warn`` degrades it. The other statuses need no
    action.
    """

    status: Status
    subject: str  # such as ``servo 1 (left)``
    text: str  # what was found, and what was expected
    fix: str = ""  # a command or an action, empty if no action is needed

    def __str__(self) -> str:
        text = f"{self.subject}: {self.text}"
        return f"{text}: {self.fix}" if self.fix else text


class Servos(Protocol):
    """Joints of the hand, in one of three operating modes (``servos.mode``).

    In each mode ``goal.q`` is the goal angle of a joint:

    - *current-based position* (5): the servo's own position loop, with the motor current limited to
      ± ``goal.current``.
    - *current* (0): the daemon computes the position loop once per tick from the newest reading,
      with ``servos.stiffness`` and ``servos.damping`` and limited to ± ``goal.current``. Without
      readings the current stays constant until the servo's bus watchdog stops it.
    - *position* (3): the servo's own position loop without a current limit. ``goal.current`` is
      ignored, and torque on holds the joint at once. This mode suits moving but not grasping.

    ``connect`` checks the servos and never stiffens or moves the hand. ``read`` and ``write`` are
    called once per tick. A failed exchange is reported by ``valid`` and the counters, and raises an
    error only if the port itself is lost.
    """

    def connect(self) -> None:
        """Open the port and check all servos. Raises ServoError with a list of all problems."""

    def read(self, reading: Reading) -> None:
        """Update ``reading`` in place.

        After a failed exchange ``valid`` is False and all other fields except ``seq`` keep their
        values, so ``reading.t`` is the time of the last good reading. Temperature and voltage may
        be up to one second old.
        """

    def torque_on(self) -> None:
        """Set the goal to the present angle, switch torque on and verify it.

        Raises ServoError if this fails or cannot be verified; torque may be on in that case.
        """

    def torque_off(self, reading: Reading) -> bool:
        """Request torque off once and read as `read` does; return True if all servos confirm it.

        It waits no longer than `read`, so the loop can repeat it at every tick until it returns
        True. Raises ServoError if the port is gone.
        """

    def write(self, goal: Goal) -> None:
        """Send the goal angle and the current limit of each joint."""

    def counters(self) -> dict[str, int]:
        """Return the number of failed exchanges since connect by kind: ``timeouts``, ``crc``, …"""

    def close(self) -> None:
        """Switch torque off as far as the bus allows, and close the port. Never raises."""


class JointPlant(Protocol):
    """Simulated joints with their motors, used by the simulated and the emulated servos.

    Index 0 is the left finger's joint. Positive closes.
    """

    q: FloatArray  # true joint angles [rad] at the time of the last `advance`
    dq: FloatArray  # true joint velocities [rad/s]
    current: FloatArray  # true motor currents [A]

    def measured_current(self, joint: int) -> float:
        """Return the motor current [A] of a joint as its servo measures it."""

    def advance(self, t: float) -> None:
        """Advance to time t [s]; do nothing if t has passed."""

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """Command a joint's servo from now on.

        ``mode`` is 5 (current-based position), 3 (position) or 0 (current). In modes 5 and 3
        ``goal_current`` limits the magnitude of the current; mode 3 uses the model's own limit. In
        mode 0 it is the signed current.
        """

    def tune(self, joint: int, stiffness: float, damping: float, duty: float) -> None:
        """Set a servo's position gains and PWM limit from now on.

        Parameters
        ----------
        stiffness : stiffness of the position loop relative to the factory value
        damping : damping added to the factory value, per unit of that stiffness [s]
        duty : largest fraction of the supply voltage that the motor may receive
        """


def make_servos(settings: Settings, clock: Clock, hand: object) -> Servos | None:
    """Create the servo backend of the settings, unconnected; None in a scene without servos.

    ``hand`` is the simulated hand, for backends that need it. Raises the errors of the backend's
    constructor.
    """
    found = backend("servos", settings.servos.backend)
    if settings.servos.backend == "none":
        return None
    scene = (settings, hand) if found.hand else (settings,)
    servos: Servos = found.load()(*scene, clock, *found.options(settings.plugins.tables))
    return servos
