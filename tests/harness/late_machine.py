"""A machine whose time moves by its own work and sleeps alone, and that wakes up late when told."""

from softfinger.daemon.clock import VirtualClock


class LateMachine(VirtualClock):
    """In the place of the real clock. ``late_by`` [s]: of the next wake-ups, one after another."""

    waits = False

    def __init__(self, start: float = 0.0) -> None:
        super().__init__(start)
        self.late_by: list[float] = []

    def work(self, seconds: float) -> None:
        """Something keeps the machine at work."""
        self._now += seconds

    def sleep_until(self, t: float) -> float:
        late = self.late_by.pop(0) if self.late_by else 0.0
        super().sleep_until(t + late)
        return late
