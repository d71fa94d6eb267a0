"""Joints that follow their goals at once while torque is on."""

from softfinger.daemon.clock import Clock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Goal, Reading


class FollowingServos:
    """No bus, no motor: what was written is what is read."""

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._clock = clock
        self._q = list(settings.hand.open_angle)
        self._on = False

    def connect(self) -> None:
        """Nothing to connect."""

    def read(self, reading: Reading) -> None:
        """Angles as they are, at rest."""
        reading.seq += 1
        reading.t = self._clock.now()
        reading.q[:] = self._q
        reading.valid = True

    def torque_on(self) -> None:
        """Follow goals from now on."""
        self._on = True

    def torque_off(self, reading: Reading) -> bool:
        """Follow nothing any more."""
        self._on = False
        self.read(reading)
        return True

    def write(self, goal: Goal) -> None:
        """Be there."""
        if self._on:
            self._q = list(goal.q)

    def counters(self) -> dict[str, int]:
        """Nothing goes wrong."""
        return {}

    def close(self) -> None:
        """Let go."""
        self._on = False
