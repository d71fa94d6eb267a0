"""Test the limits on goals, and test that only `Safety` sends goals to servos."""

import ast
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.safety import Safety
from softfinger.daemon.types import Goal, State
from tests.harness.safety import SETTINGS, goal, judged, levers, safety, sound
from tests.harness.safety import bounded as write_bounded

ROOT = Path(__file__).parents[2]


def test_a_normal_state_has_no_fault_and_no_warning():
    judge = safety(grasp=levers(0.08))
    state = sound()
    state.reading.current = [0.08 * 5.0 / SETTINGS.control.torque_constant] * 2
    assert judged(judge, state, 3.0) == ("", "")
    assert judge.warnings == []
    assert judge.cause(state) == ""


# --- goals ------------------------------------------------------------------------------------


def bounded(judge: Safety, state: State, wanted: Goal) -> Goal:
    state.goal = wanted
    state.seq += 1
    write_bounded(judge, state)
    return state.goal


def test_goals_are_bounded_by_joint_and_current_limits():
    judge, state = safety(), sound()
    for _ in range(1000):  # Within 1000 ticks, the goals reach both limits.
        found = bounded(judge, state, goal((9.0, -9.0), (5.0, -0.2)))
    assert found.valid
    assert found.q == [SETTINGS.hand.q_max[0], SETTINGS.hand.q_min[1]]
    assert found.current == [SETTINGS.safety.current_max, 0.0]
    assert set(judge.limited) == {"goal.angle", "goal.current", "goal.step", "goal.slew"}


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_non_finite_goal_is_a_fault_and_is_not_sent(bad):
    for each in (goal((bad, 0.0), (0.1, 0.1)), goal((0.0, 0.0), (0.1, bad))):
        judge, state = safety(), sound()
        assert not bounded(judge, state, each).valid
        found = judge.judge(state)
        assert found.name == "goal.number"


def test_a_distant_goal_is_approached_at_its_velocity_and_a_near_one_immediately():
    judge, state = safety(), sound()
    limits, dt = SETTINGS.safety, 1.0 / SETTINGS.loop.rate
    assert bounded(judge, state, goal((0.4, -0.4), (0.0, 0.0))).q == [0.4, -0.4]
    reached = [bounded(judge, state, goal((1.0, 0.0), (0.0, 0.0))).q[0] for _ in range(5)]
    step = limits.goal_speed * dt
    assert reached == pytest.approx([limits.goal_reach + (i + 1) * step for i in range(5)])


def test_goals_in_position_mode_do_not_jump():
    settings = Settings.model_validate({"servos": {"mode": "position"}})
    judge, state = safety(settings), sound()
    step = settings.safety.goal_speed / settings.loop.rate
    assert bounded(judge, state, goal((0.4, 0.0), (0.0, 0.0))).q[0] == pytest.approx(step)


def test_a_goal_current_increases_slowly_and_decreases_immediately():
    judge, state = safety(), sound()
    rise = SETTINGS.safety.current_rate / SETTINGS.loop.rate
    for k in (1, 2, 3):
        assert bounded(judge, state, goal((0, 0), (0.5, 0.0))).current[0] == pytest.approx(k * rise)
    assert bounded(judge, state, goal((0, 0), (0.05, 0.0))).current[0] == 0.05
    state.seq += 5  # Skipped ticks mean that torque was off.
    assert bounded(judge, state, goal((0, 0), (0.5, 0.0))).current[0] == pytest.approx(rise)


@given(st.lists(st.tuples(*[st.floats(width=32) for _ in range(6)]), min_size=1, max_size=20))
@hypothesis_settings(max_examples=200)
def test_goals_stay_within_limits_for_any_input(asked):
    judge, state, hand, limits = safety(), sound(), SETTINGS.hand, SETTINGS.safety
    last = [0.0, 0.0]
    for a, b, c, d, q1, q2 in asked:
        state.reading.q = [max(min(q, 1.0), -0.5) if math.isfinite(q) else 0.0 for q in (q1, q2)]
        found = bounded(judge, state, goal((a, b), (c, d)))
        if not found.valid:
            assert not all(map(math.isfinite, (a, b, c, d)))
            return
        for i in range(2):
            assert hand.q_min[i] <= found.q[i] <= hand.q_max[i]
            assert 0.0 <= found.current[i] <= limits.current_max
            assert found.current[i] <= last[i] + limits.current_rate / SETTINGS.loop.rate + 1e-12
        last = list(found.current)


def test_only_safety_writes_goals():
    callers = []
    for path in (ROOT / "daemon").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Attribute)
                and node.func.attr == "write"
                and isinstance(node.func.value, ast.Name | ast.Attribute)
                and "servos" in ast.unparse(node.func.value)
            ):
                callers.append(path.name)
    assert callers == ["safety.py"]
