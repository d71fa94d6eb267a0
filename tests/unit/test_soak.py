"""A short soak: what must hold at every tick holds, and the soak would see it if it did not."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from softfinger.daemon.types import Goal, Reading
from tests.soak.virtual import Soak


@pytest.fixture(scope="module")
def soak() -> Iterator[Soak]:
    made = Soak(seed=3)
    yield made
    made.close()


def test_random_commands_and_faults_break_nothing(soak: Soak) -> None:
    account = soak.run(12_000)
    assert account.ticks == 12_000
    assert account.written > 2_000
    assert len(account.modes) >= 7
    assert sum(account.injected.values()) > 6
    assert len(account.faults) >= 2
    assert account.growth < 0.02
    assert "12000 ticks" in account.lines()[0]


@pytest.mark.parametrize(
    ("q", "current", "told"),
    [
        ((1.2, 0.0), (0.0, 0.0), "goal angle"),
        ((0.0, 0.0), (-0.1, 0.0), "goal current"),
        ((0.0, 0.0), (0.0, 1.1), "rose"),
        ((0.0, math.nan), (0.0, 0.0), "goal angle"),
    ],
)
def test_a_goal_beyond_its_limits_ends_it(
    soak: Soak, q: tuple[float, float], current: tuple[float, float], told: str
) -> None:
    servos = soak.servos
    servos.fault = ""
    servos.torque_on()
    servos.last_good = soak.daemon.clock.now()
    with pytest.raises(AssertionError, match=told):
        servos.write(Goal(valid=True, q=list(q), current=list(current)))
    assert servos.torque_off(Reading())


def test_an_old_reading_or_frame_ends_it(soak: Soak) -> None:
    servos, state = soak.servos, soak.daemon.loop.state
    servos.torque_on()
    servos.last_good = soak.daemon.clock.now() - 0.1
    with pytest.raises(AssertionError, match="reading"):
        servos.write(Goal(valid=True))
    servos.last_good = state.t
    soak.sensors[0].last_sent = state.t - 0.2
    with pytest.raises(AssertionError, match="frame"):
        soak._judge_torque(state, "holding", 1)
    soak._judge_torque(state, "disarmed", 1)  # as late as the next tick
    with pytest.raises(AssertionError, match="a motor is driven"):
        soak._judge_torque(state, "disarmed", 3)
    assert servos.torque_off(Reading())
