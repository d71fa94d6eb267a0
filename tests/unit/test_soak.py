"""Test that short sequences meet all requirements, and that the soak test detects violations."""

import math
import sys
from collections.abc import Iterator

import pytest

from softfinger.daemon.types import Goal, Reading
from tests.soak import virtual
from tests.soak.virtual import Account, Soak, sequence


@pytest.fixture
def soak() -> Iterator[Soak]:
    made = Soak(seed=3)
    yield made
    made.close()


def holding(soak: Soak) -> Soak:
    soak._may_be_disturbed = lambda: False
    while soak.daemon.loop.state.mode != "holding":
        soak.run(1)
        assert soak.count < 5000
    soak._next_command = math.inf
    return soak


@pytest.mark.parametrize(
    ("sequences", "unjudged"),
    [(3, 12), pytest.param(6, 9, marks=pytest.mark.extended)],
)
def test_sequences_hold_without_violations(sequences, unjudged):
    account = Account()
    for seed in range(sequences):
        sequence(seed, 4000, account)
    assert account.failures == []
    assert account.held >= virtual.HELD * account.sequences
    assert len(account.never) < unjudged
    assert account.judged[virtual.HONEST["holding"]] > 300
    assert f"{4000 * sequences} ticks" in "\n".join(account.lines())


def test_a_sequence_is_reproducible():
    first, again = Account(), Account()
    sequence(5, 1500, first)
    sequence(5, 1500, again)
    assert first == again


@pytest.mark.parametrize(
    ("q", "current"),
    [
        ((1.2, 0.0), (0.0, 0.0)),
        ((0.0, 0.0), (-0.1, 0.0)),
        ((0.0, 0.0), (0.0, 1.1)),
        ((0.0, math.nan), (0.0, 0.0)),
    ],
)
def test_a_goal_beyond_its_limits_is_detected(soak, q, current):
    servos = soak.servos
    servos.torque_on()
    servos.armed = True
    servos.last_good = soak.daemon.clock.now()
    with pytest.raises(AssertionError, match="goals within"):
        servos.write(Goal(valid=True, q=list(q), current=list(current)))
    assert servos.torque_off(Reading())


def test_torque_after_a_stop_is_detected(soak):
    holding(soak)
    control = soak.daemon.loop._control
    before = control.state
    soak.daemon.loop.command({"command": "stop"})
    control.state = before  # Simulate a missed stop.
    soak._carried_out({"command": "stop"}, "holding")
    with pytest.raises(AssertionError, match="after a stop while holding: a motor is driven"):
        soak.run(3)
    with pytest.raises(AssertionError, match="a goal was sent"):
        soak.servos.write(Goal(valid=True))


@pytest.mark.parametrize(
    ("broken", "status"), [(virtual.CALM, 0), (virtual.OFF, 1), (virtual.STAYS, 1)]
)
def test_a_long_sequence_fails_if_torque_stays_on(monkeypatch, broken, status):
    def run(_: int, ticks: int, account: Account) -> None:
        account.sequences, account.held, account.ticks = 1, 1, ticks
        account.judged.update(virtual.ASSERTIONS)
        account.broken[broken] += 1

    monkeypatch.setattr(virtual, "long_sequence", run)
    monkeypatch.setattr(sys, "argv", ["virtual", "--ticks", str(virtual.LONG)])
    assert virtual.main() == status


def test_old_readings_and_frames_are_detected(soak):
    holding(soak)
    soak.sensors[0].last_sent -= 0.2
    with pytest.raises(AssertionError, match="old frame"):
        soak._judge_ages("holding")
    soak.servos.last_good -= 0.1
    with pytest.raises(AssertionError, match="old reading"):
        soak._judge_ages("holding")


def test_an_unjustified_force_is_detected(soak):
    holding(soak)
    t, asked = soak._asked[-1]
    soak._asked[-1] = t, 0.5 * asked
    with pytest.raises(AssertionError, match="nothing calls for more"):
        soak.run(300)


def test_reported_channels_are_compared_with_the_actual_faults(soak):
    holding(soak)
    soak.run(600)
    soak._false.add("left_sensor")
    soak._hear("warning", "consistency.left_sensor", "")
    with pytest.raises(AssertionError, match="while holding, no fault: right_sensor named"):
        soak._hear("warning", "consistency.right_sensor", "")
    soak.hand.object_pose[1] += 0.02  # The edge of the object is now at the tips.
    soak.hand.refresh()
    soak._judge_sensor_faults("holding")
    soak._hear("warning", "consistency.right_sensor", "")
