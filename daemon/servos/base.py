"""Define the interface between the servo backends and the loop, and create the selected backend."""

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
    """Result of one check of a device or of the machine, with a fix if needed.

    ``FAIL`` means that the daemon cannot run, and ``warn`` means that the daemon runs with
    restrictions. Findings with any other status require no action.
    """

    status: Status
    subject: str  # for example ``servo 1 (left)``
    text: str  # found value and expected value
    fix: str = ""  # command or action, empty if none is needed

    def __str__(self) -> str:
        text = f"{self.subject}: {self.text}"
        return f"{text}: {self.fix}" if self.fix else text


class Servos(Protocol):
    """Joints of the hand in one of three operating modes (``servos.mode``).

    In each mode, ``goal.q`` is the goal angle of a joint:

    - *current-based position* (5): the servo controls its position and limits the motor current to
      ± ``goal.current``.
    - *current* (0): the daemon controls the position once per tick, using the newest reading. The
      control law uses the gains ``servos.stiffness`` and ``servos.damping``, and limits the current
      to ± ``goal.current``. Without readings, the current stays constant until the servo's bus
      watchdog stops the servo.
    - *position* (3): the servo controls its position without a current limit, and ignores
      ``goal.current``. The servo holds the joint as soon as torque is on. Position mode is suitable
      for moving but not for grasping.

    ``connect`` checks the servos, but never switches torque on. ``read`` and ``write`` are called
    once per tick. A failed exchange sets ``valid`` to False and increments a counter. `read` and
    `write` raise an error only if the port is lost or a watchdog has stopped a servo.
    """

    def connect(self) -> None:
        """Open the port and check all servos. Raises ServoError, which lists all problems."""

    def read(self, reading: Reading) -> None:
        """Update ``reading`` in place.

        A failed exchange changes only ``valid`` and ``seq``. ``reading.t`` therefore remains the
        time of the last valid reading. Temperature and voltage may be up to one second old.
        """

    def torque_on(self) -> None:
        """Set the goal to the current angle, switch torque on and verify that torque is on.

        Raises ServoError if torque cannot be switched on or verified. Torque may then be on.
        """

    def torque_off(self, reading: Reading) -> bool:
        """Request torque off and read the servos; return True if all servos confirm torque off.

        The call takes no longer than `read`, so the loop can repeat the call on every tick. Raises
        ServoError if the port is lost.
        """

    def write(self, goal: Goal) -> None:
        """Send each joint's goal angle and current limit."""

    def counters(self) -> dict[str, int]:
        """Return the number of failed exchanges since the start, by type such as ``timeouts``."""

    def close(self) -> None:
        """Try to switch torque off and close the port. Never raises."""


class JointPlant(Protocol):
    """Simulated joints and motors for simulated and emulated servos.

    Index 0 is the left finger's joint. Positive velocities and currents close the finger.
    """

    q: FloatArray  # true joint angles [rad] at the time of the last `advance`
    dq: FloatArray  # true joint velocities [rad/s]
    current: FloatArray  # true motor currents [A]

    def measured_current(self, joint: int) -> float:
        """Return a joint's motor current [A] as measured by its servo."""

    def advance(self, t: float) -> None:
        """Advance the simulation to time ``t`` [s]. A time in the past has no effect."""

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """Set the command for a servo. The command stays active until the next call.

        ``mode`` is 5 (current-based position), 3 (position) or 0 (current). In mode 5,
        ``goal_current`` limits the magnitude of the current. In mode 3, the current limit of the
        servo model applies instead. In mode 0, ``goal_current`` is the signed current.
        """

    def tune(self, joint: int, stiffness: float, damping: float, duty: float) -> None:
        """Set a servo's position gains and PWM limit, which apply until the next call.

        Parameters
        ----------
        stiffness
            Stiffness of the position loop relative to the factory value.
        damping
            Additional damping per unit of ``stiffness`` [s].
        duty
            Maximum fraction of the supply voltage applied to the motor.
        """


def make_servos(settings: Settings, clock: Clock, hand: object) -> Servos | None:
    """Create the configured servo backend without connecting it.

    Returns None if the scene has no servos.

    ``hand`` is the simulated hand. Only backends that use the simulated hand receive ``hand``.
    Raises the same errors as the backend's constructor.
    """
    found = backend("servos", settings.servos.backend)
    if settings.servos.backend == "none":
        return None
    scene = (settings, hand) if found.hand else (settings,)
    servos: Servos = found.load()(*scene, clock, *found.options(settings.plugins.tables))
    return servos
