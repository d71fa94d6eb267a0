"""Simulate a machine whose wake-ups are delayed on request."""

from softfinger.daemon.clock import VirtualClock


class LateMachine(VirtualClock):
    """Test clock that replaces the real clock. Only `work` and sleeps advance the time.

    ``late_by`` holds the delays of the next wake-ups [s].
    """

    pauses_when_late = False

    def __init__(self, start: float = 0.0) -> None:
        super().__init__(start)
        self.late_by: list[float] = []

    def work(self, seconds: float) -> None:
        """Advance the clock by the duration of some work."""
        self._now += seconds

    def sleep_until(self, t: float) -> float:
        late = self.late_by.pop(0) if self.late_by else 0.0
        super().sleep_until(t + late)
        return late
