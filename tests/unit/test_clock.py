"""Real and virtual time."""

from __future__ import annotations

import time

from daemon.clock import RealClock, VirtualClock


def test_virtual_time_moves_only_by_waiting_and_never_back() -> None:
    clock = VirtualClock(3.0)
    assert clock.now() == clock.wall() == 3.0
    clock.sleep_until(4.5)
    assert clock.now() == clock.wall() == 4.5
    clock.sleep_until(1.0)
    assert clock.now() == 4.5


def test_real_time_waits_until_the_deadline_and_not_for_a_past_one() -> None:
    clock = RealClock()
    deadline = clock.now() + 0.01
    clock.sleep_until(deadline)
    assert clock.now() >= deadline
    clock.sleep_until(deadline - 1.0)
    assert abs(clock.wall() - time.time()) < 1.0
