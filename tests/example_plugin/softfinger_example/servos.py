"""Servos whose joints follow their goals immediately while torque is on."""

from softfinger.daemon.clock import Clock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Goal, Reading


class FollowingServos:
    """Servos that have no bus or motors, and report the last goal as the measured angle."""

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._clock = clock
        self._q = list(settings.hand.open_angle)
        self._on = False

    def connect(self) -> None:
        """Do nothing, because there is no bus."""

    def read(self, reading: Reading) -> None:
        """Return the current angles, with zero velocity."""
        reading.seq += 1
        reading.t = self._clock.now()
        reading.q[:] = self._q
        reading.valid = True

    def torque_on(self) -> None:
        """Turn torque on, so that joints move to their goals."""
        self._on = True

    def torque_off(self, reading: Reading) -> bool:
        """Turn torque off, so that joints ignore their goals."""
        self._on = False
        self.read(reading)
        return True

    def write(self, goal: Goal) -> None:
        """Move to the goal immediately if torque is on."""
        if self._on:
            self._q = list(goal.q)

    def counters(self) -> dict[str, int]:
        """Return no errors."""
        return {}

    def close(self) -> None:
        """Do nothing, because there is no port to close."""
        self._on = False
