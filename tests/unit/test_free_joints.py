"""The free joints against a plain twin, and the profile that servos follow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.simulation.physics.free_joints import FreeJoints
from softfinger.daemon.simulation.servo_model.trajectory import Profile


def twin(
    joints: FreeJoints, steps: int, step: float, commands: list[tuple[int, bool, float, float]]
):
    """The same joints in plain Python, one line a law."""
    inertia, viscous, coulomb, torque, lag, stiffness, damping = (
        0.002, 0.05, 0.02, 1.78, 0.001, 8.0, 0.10
    )  # fmt: skip
    out = []
    for j, (mode, on, goal, bound) in enumerate(commands):
        q, dq, i = float(joints.q[j]), float(joints.dq[j]), float(joints.current[j])
        for _ in range(steps):
            wanted = (
                bound
                if mode == reg.CURRENT_MODE
                else float(np.clip(stiffness * (goal - q) - damping * dq, -bound, bound))
            )
            i = i + ((wanted if on else 0.0) - i) * step / lag if on else 0.0
            dq = (dq + torque * i * step / inertia) / (1 + viscous * step / inertia)
            dq = np.sign(dq) * max(abs(dq) - coulomb * step / inertia, 0.0)
            q += dq * step
        out.append((q, dq, i))
    return np.array(out).T


@pytest.mark.parametrize(
    "commands",
    [
        [(reg.CURRENT_BASED_POSITION_MODE, True, 0.4, 0.3), (reg.POSITION_MODE, True, -0.2, 2.0)],
        [(reg.CURRENT_MODE, True, 0.0, -0.2), (reg.CURRENT_MODE, False, 0.0, 0.0)],
    ],
)
def test_joints_equal_their_twin(commands: list[tuple[int, bool, float, float]]) -> None:
    joints = FreeJoints(2)
    joints.dq[:] = 1.0, -3.0
    expected = twin(joints, 300, 0.0005, commands)
    for joint, (mode, on, goal, bound) in enumerate(commands):
        joints.drive(joint, mode, on, goal, bound)
    joints.advance(0.15)
    assert np.allclose([joints.q, joints.dq, joints.current], expected, rtol=1e-12, atol=1e-12)


def test_time_in_any_pieces_gives_the_same_bits_and_never_goes_back() -> None:
    whole, pieces = FreeJoints(2, 5.0), FreeJoints(2, 5.0)
    for joints in (whole, pieces):
        joints.drive(0, reg.POSITION_MODE, True, 0.7, 1.0)
    whole.advance(5.4)
    for t in np.linspace(5.0, 5.4, 173):
        pieces.advance(float(t))
        pieces.advance(float(t) - 0.01)
    pieces.advance(5.4)
    assert whole.q.tobytes() == pieces.q.tobytes()
    assert whole.q[0] == pytest.approx(0.7, abs=0.01)


@settings(max_examples=40)
@given(
    start=st.floats(-1000, 1000),
    target=st.floats(-1000, 1000),
    speed=st.floats(500, 5000),
    acceleration=st.floats(500, 1e5),
)
def test_a_profile_arrives_without_passing_and_within_its_limits(
    start: float, target: float, speed: float, acceleration: float
) -> None:
    profile = Profile()
    profile.hold(start)
    profile.aim(target, speed, acceleration)
    dt = 0.001
    ideal = abs(target - start) / speed + speed / acceleration
    last_velocity, steps = 0.0, 0
    while profile.busy:
        before = profile.position
        profile.step(dt)
        steps += 1
        low, high = sorted((start, target))
        assert low - 1e-6 <= profile.position <= high + 1e-6
        assert abs(profile.position - before) <= speed * dt * (1 + 1e-9)
        if profile.busy:
            assert abs(profile.velocity - last_velocity) <= acceleration * dt * (1 + 1e-6)
        last_velocity = profile.velocity
        assert steps * dt <= 1.05 * ideal + 0.05
    assert profile.position == target
