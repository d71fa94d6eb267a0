"""The trajectory that servos follow to a goal."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from softfinger.daemon.simulation.servo_model.servo_joint import Profile


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
