"""`bench tick` in short: a hand that holds over ptys, its servos emulated by another process."""

from softfinger.tools.benchmarks import tick
from softfinger.tools.benchmarks.measuring import Report
from tests.conftest import until
from tests.harness.daemon_process import PATIENCE


def test_ticks_over_ptys_and_their_exchanges_take_turns():
    patient = [f"{key}={value}" for key, value in PATIENCE.items()]
    reports: list[Report] = []

    def measured() -> bool:
        """It fails where the hand does not hold in time, as on a machine that is busy."""
        reports.append(tick.in_the_loop(2, 2_000_000, patient))
        return not reports[-1].failed

    until(measured, 400.0)
    assert [row["n"] for row in reports[-1].rows] == [40] * 3
    assert all(row["median"] > 0.0 for row in reports[-1].rows)
