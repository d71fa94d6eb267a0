"""Define the interface between servo backends and the loop; create the selected backend."""

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
    """Result of checking one device or the machine, and how to fix any problem.

    ``FAIL`` means that the daemon cannot run, and ``warn`` means that the daemon runs with
    restrictions. Findings with any other status require no action.
    """

    status: Status
    subject: str  # for example ``servo 1 (left)``
    text: str  # description of the actual value and of the expected value
    fix: str = ""  # command or action, empty if none is needed

    def __str__(self) -> str:
        text = f"{self.subject}: {self.text}"
        return f"{text}: {self.fix}" if self.fix else text


class Servos(Protocol):
    """Joints of the hand in one of three operating modes (``servos.mode``).

    In each mode, ``goal.q`` is the goal angle of a joint:

    - *current-based position* (5): the servo's own position loop with the motor current limited to
      ± ``goal.current``.
    - *current* (0): the daemon computes the position loop once per tick from the newest reading,
      with ``servos.stiffness`` and ``servos.damping``, limited to ± ``goal.current``. Without
      readings, the current stays constant until the servo's bus watchdog stops the servo.
    - *position* (3): the servo's own position loop without a current limit. ``goal.current`` is
      ignored, and switching torque on holds the joint immediately. Position mode is suitable for
      moving but not for grasping.

    ``connect`` checks the servos and never switches torque on or moves the hand. ``read`` and
    ``write`` are called once per tick. A failed exchange is reported by ``valid`` and the counters.
    `read` and `write` raise an error only if the port itself is lost.
    """

    def connect(self) -> None:
        """Open the port and check all servos. Raises ServoError, which lists all problems."""

    def read(self, reading: Reading) -> None:
        """Update ``reading`` in place.

        After a failed exchange, ``valid`` is False and all other fields except ``seq`` keep their
        values, so ``reading.t`` is the time of the last valid reading. Temperature and voltage may
        be up to one second old.
        """

    def torque_on(self) -> None:
        """Set the goal to the current angle, switch torque on and verify it.

        Raises ServoError if switching on fails or cannot be verified; torque may then be on.
        """

    def torque_off(self, reading: Reading) -> bool:
        """Request torque off once, then read like `read`; return True once all servos confirm.

        This method takes no longer than `read`, so the loop can call it on every tick until it
        returns True. Raises ServoError if the port is lost.
        """

    def write(self, goal: Goal) -> None:
        """Send each joint's goal angle and current limit."""

    def counters(self) -> dict[str, int]:
        """Count the failed exchanges since `connect` by type: ``timeouts``, ``crc``, …"""

    def close(self) -> None:
        """Try to switch torque off and close the port. Never raises."""


class JointPlant(Protocol):
    """Simulated joints and motors, as used by simulated and emulated servos.

    Index 0 is the left finger's joint. Positive values close the finger.
    """

    q: FloatArray  # true joint angles [rad] at the time of the last `advance`
    dq: FloatArray  # true joint velocities [rad/s]
    current: FloatArray  # true motor currents [A]

    def measured_current(self, joint: int) -> float:
        """Return a joint's motor current [A] as measured by its servo."""

    def advance(self, t: float) -> None:
        """Advance to time t [s]; do nothing if t is in the past."""

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """Set a servo's command; the command stays active until the next call.

        ``mode`` is 5 (current-based position), 3 (position) or 0 (current). In mode 5,
        ``goal_current`` limits the magnitude of the current. Mode 3 applies the servo model's own
        limit instead. In mode 0, ``goal_current`` is the signed current.
        """

    def tune(self, joint: int, stiffness: float, damping: float, duty: float) -> None:
        """Set a servo's position gains and PWM limit until the next call.

        Parameters
        ----------
        stiffness : stiffness of the position loop relative to the factory value damping : damping
        in addition to the factory value, per unit of ``stiffness`` [s] duty : maximum fraction of
        the supply voltage applied to the motor
        """


def make_servos(settings: Settings, clock: Clock, hand: object) -> Servos | None:
    """Create the configured servo backend without connecting it.

    Returns None if the scene has no servos.

    ``hand`` is the simulated hand, for backends that use it. Raises the same errors as the
    backend's constructor.
    """
    found = backend("servos", settings.servos.backend)
    if settings.servos.backend == "none":
        return None
    scene = (settings, hand) if found.hand else (settings,)
    servos: Servos = found.load()(*scene, clock, *found.options(settings.plugins.tables))
    return servos
