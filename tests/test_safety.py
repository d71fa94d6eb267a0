"""Bounds on goals and the causes of a fault, one by one."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from daemon.modes import Mode
from daemon.records import Contact, Goal, State
from daemon.safety import Safety
from daemon.settings import Settings

SETTINGS = Settings()


def safety(servos: bool = True, sensors: bool = True) -> Safety:
    return Safety(SETTINGS, servos, sensors)


def sound(mode: Mode = Mode.HOLDING) -> State:
    """A state with nothing wrong, at 5 s."""
    state = State(t=5.0, mode=mode)
    state.reading.t = 5.0
    state.reading.valid = True
    state.contacts = [
        Contact(
            seq=1, t=4.99, t_arrival=5.0, t_sound=5.0, valid=True, contact=True, d=0.004, theta=0.1
        )
        for _ in range(2)
    ]
    return state


def goal(q: tuple[float, float], current: tuple[float, float]) -> Goal:
    return Goal(valid=True, q=list(q), current=list(current))


def test_a_sound_state_has_no_cause() -> None:
    assert safety().cause(sound()) == ""


def test_goals_are_bounded_by_joint_and_current_limits() -> None:
    bounded = goal((9.0, -9.0), (5.0, -0.2))
    safety().bound(bounded)
    assert bounded.valid
    assert bounded.q == [SETTINGS.hand.q_max[0], SETTINGS.hand.q_min[1]]
    assert bounded.current == [SETTINGS.safety.current_max, 0.0]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_goal_that_is_no_number_becomes_invalid(bad: float) -> None:
    for each in (goal((bad, 0.0), (0.1, 0.1)), goal((0.0, 0.0), (0.1, bad))):
        safety().bound(each)
        assert not each.valid


def stale_reading(state: State) -> None:
    state.reading.t = 4.9


def alert(state: State) -> None:
    state.reading.alert = 0b10


def past_the_limit(state: State) -> None:
    state.reading.q[0] = SETTINGS.hand.q_max[0] + 0.2


def too_fast(state: State) -> None:
    state.reading.dq[1] = -7.0


def silent_frames(state: State) -> None:
    state.contacts[0].t_arrival = state.contacts[0].t_sound = 5.0 - 11.0 / SETTINGS.tactile.rate


def unsound_estimates(state: State) -> None:
    state.contacts[0].t_sound = 5.0 - 11.0 / SETTINGS.tactile.rate


def never_read(state: State) -> None:
    state.reading.t = -math.inf


def too_much_force(state: State) -> None:
    state.contacts[1].force = 31.0


def too_deep(state: State) -> None:
    state.contacts[1].d = 0.013


def near_the_rim(state: State) -> None:
    state.contacts[0].theta = -math.asin(0.8) + 0.04


def outside_the_model(state: State) -> None:
    state.contacts[0].inside = False


CAUSES: list[tuple[Callable[[State], None], str]] = [
    (stale_reading, "no good reading for 0.100 s"),
    (alert, "hardware error reported by right"),
    (past_the_limit, "left joint at 1.200 rad, outside its limits"),
    (too_fast, "right joint at -7.00 rad/s, too fast"),
    (silent_frames, "tactile: no frame for 0.110 s"),
    (unsound_estimates, "tactile: no sound estimate for 0.110 s"),
    (never_read, "servos: no good reading yet"),
    (too_much_force, "right tip at 31.0 N, above 30 N"),
    (too_deep, "right tip at 13.00 mm, above 12"),
    (near_the_rim, "left tip at -50.8°, past 50.3° at this depth"),
    (outside_the_model, "left tip at 5.7°, past"),
]


@pytest.mark.parametrize(
    ("spoil", "text"), CAUSES, ids=lambda value: getattr(value, "__name__", "")
)
def test_each_cause_is_found_and_named(spoil: Callable[[State], None], text: str) -> None:
    state = sound()
    spoil(state)
    assert text in safety().cause(state)


def test_what_the_scene_lacks_is_no_cause() -> None:
    state = sound()
    for spoil in (stale_reading, alert, past_the_limit, too_fast):
        spoil(state)
    assert safety(servos=False).cause(state) == ""
    state = sound()
    for spoil in (silent_frames, too_much_force, near_the_rim):
        spoil(state)
    assert safety(sensors=False).cause(state) == ""


def test_late_frames_hold_the_goals_before_they_are_a_fault() -> None:
    state = sound()
    state.contacts[0].t_sound = 5.0 - 4.0 / SETTINGS.tactile.rate
    assert safety().must_hold(state)
    assert safety().cause(state) == ""
    state.mode = Mode.ARMED
    assert not safety().must_hold(state)


def test_overruns_in_a_row_are_a_cause() -> None:
    judge = safety()
    judge.overruns_in_row = SETTINGS.safety.overruns_fault
    assert judge.cause(sound()) == "loop: 100 overruns in a row"
