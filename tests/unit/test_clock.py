"""Real, virtual and a simulated hand's own time; what a late machine does to a hand in each."""

from __future__ import annotations

import time

import pytest

from softfinger.daemon.clock import HandClock, LoopClock, RealClock, VirtualClock, make_clock
from softfinger.daemon.profile.settings import Settings
from tests.harness.late_machine import LateMachine


def test_virtual_time_moves_only_by_waiting_and_never_back() -> None:
    clock = VirtualClock(3.0)
    assert clock.now() == clock.wall() == clock.host() == 3.0
    assert clock.sleep_until(4.5) == 0.0
    assert clock.now() == clock.wall() == clock.host() == 4.5
    clock.sleep_until(1.0)
    assert clock.now() == 4.5


def test_real_time_waits_until_the_deadline_and_not_for_a_past_one() -> None:
    clock = RealClock()
    deadline = clock.now() + 0.01
    assert clock.sleep_until(deadline) >= 0.0
    assert clock.now() >= deadline
    assert clock.sleep_until(deadline - 1.0) >= 1.0
    before = time.time()
    assert before <= clock.wall() <= time.time()


def test_a_hands_time_stands_between_sleeps_and_ends_them_at_their_deadline() -> None:
    machine = LateMachine(100.0)
    clock = HandClock(machine)
    machine.work(0.001)
    assert (clock.now(), clock.host()) == (100.0, 100.001)
    machine.late_by = [0.0015]
    assert clock.sleep_until(100.002) == pytest.approx(0.0015)
    assert clock.now() == 100.002
    assert clock.host() == pytest.approx(100.0035)
    clock.sleep_until(100.004)  # what is left of the period makes up for it
    assert (clock.now(), clock.host()) == (100.004, 100.004)
    assert clock.behind == 0.0


def test_a_hands_time_leaves_out_what_the_machine_missed() -> None:
    machine = LateMachine(100.0)
    clock = HandClock(machine)
    machine.late_by = [5.0]  # it was stopped
    assert clock.sleep_until(100.002) == pytest.approx(5.0)
    assert clock.sleep_until(100.004) == 0.0, "a deadline that was missed is now"
    assert clock.now() == 100.004
    assert clock.behind == pytest.approx(4.998)
    machine.work(1.0)
    clock.sleep_until(100.006)
    assert clock.behind == pytest.approx(5.996)
    clock.sleep_until(100.008)
    assert clock.host() == pytest.approx(100.008 + clock.behind)
    clock.sleep_until(50.0)
    assert clock.now() == 100.008, "never back"


@pytest.mark.parametrize(
    ("sections", "kind"),
    [
        ({}, HandClock),
        ({"loop": {"clock": "hand"}}, HandClock),
        ({"loop": {"clock": "real"}}, RealClock),
        ({"loop": {"clock": "virtual"}}, VirtualClock),
        ({"servos": {"backend": "none"}}, HandClock),
        ({"servos": {"backend": "dynamixel"}, "tactile": {"backend": "none"}}, RealClock),
        ({"servos": {"backend": "none"}, "tactile": {"backend": "flexitac"}}, RealClock),
    ],
)
def test_only_a_hand_without_metal_has_a_time_of_its_own(
    sections: dict[str, dict[str, str]], kind: type[LoopClock]
) -> None:
    assert type(make_clock(Settings.model_validate(sections))) is kind
