"""The interface of every servo backend, and its errors."""

from __future__ import annotations

from typing import Protocol

from softfinger.daemon.types import Goal, Reading


class Servos(Protocol):
    """Joints of the hand, in one of three operating modes (``servos.mode``).

    In each of them ``goal.q`` is the angle a joint is drawn to:

    - *current-based position* (5): the servo's own loop, with the motor's current within
      ± ``goal.current``.
    - *current* (0): the same meaning, but the loop runs here, once a tick, on the newest reading:
      ``servos.stiffness`` and ``servos.damping`` within ± ``goal.current``. Without readings the
      current stays what it was, until the servo's bus watchdog ends it.
    - *position* (3): the servo's own loop with all the current it has. ``goal.current`` is not
      looked at, and torque on holds at once; it suits moving and no grasp.

    ``connect`` checks and never stiffens or moves the hand. ``read`` and ``write`` are called
    once a tick; a failed exchange is told by ``valid`` and the counters, not by an exception,
    unless the port itself is gone.
    """

    def connect(self) -> None:
        """Open and check everything. Raises ServoError with the whole list of what is wrong."""

    def read(self, reading: Reading) -> None:
        """Fill ``reading`` in place.

        After a failed exchange ``valid`` is False and all else but ``seq`` keeps, so that
        ``reading.t`` is the time of the last good one.
        Temperature and voltage need not be fresher than a second.
        """

    def torque_on(self) -> None:
        """Torque on, verified; the goal is set to the present angle first.

        Raises ServoError when it could not be done or not be verified: it may be on then.
        """

    def torque_off(self, reading: Reading) -> bool:
        """Ask once for torque off and read, as `read` does; whether the servos say that it is off.

        It waits no longer than `read`, so that the loop can ask at every tick until it is True.
        Raises ServoError when the port is gone.
        """

    def write(self, goal: Goal) -> None:
        """Send the goal angle and the current bound of each joint."""

    def counters(self) -> dict[str, int]:
        """Exchanges that went wrong since connect, by kind: ``timeouts``, ``crc``, …"""

    def close(self) -> None:
        """Torque off as far as the bus allows, then close. Never raises."""
