"""The grip without new frames, and of one finger alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softfinger.daemon.control.grip import Grip
from softfinger.daemon.perception.contact_filter_kernels import GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import ObjectPose, Reading


def some_held(generator: np.random.Generator, force: float) -> GraspState:
    held = GraspState()
    held.force = [force, force]
    held.q = list(generator.uniform(-0.2, 0.2, 2))
    held.moment_arm = list(generator.uniform(0.06, 0.09, 2))
    held.jacobian_rotation = list(generator.uniform(0.5, 1.0, 2))
    held.energy_arm = list(generator.uniform(0.06, 0.09, 2))
    held.stiffness = list(generator.uniform(2e3, 9e3, 2))
    held.normal = list(generator.uniform(5.0, 9.0, 2))
    held.jacobian_slide = generator.uniform(-0.02, 0.02)
    held.angle_std = generator.uniform(0.0, 0.02)
    return held


def test_late_frames_leave_the_push_and_let_a_turn_come_to_rest() -> None:
    generator = np.random.default_rng(6)
    held = some_held(generator, 8.0)
    grip = Grip(Settings(), [0, 1], held)
    held.jacobian_slide, held.moment_arm = 0.0, [0.08, 0.08]
    reading = Reading()
    grip.start(8.0, 8.0)
    grip.steer(0.0, 0.3)
    for _ in range(100):
        grip.torques(reading, ObjectPose(True, 0.0, 0.03), False)
    pushes, leans = [], []
    for _ in range(400):
        left, right = grip.hold_goal(reading)
        pushes.append(left / held.moment_arm[0] + right / held.moment_arm[1])
        leans.append(left - right)
    assert np.ptp(pushes) < 1e-6 * pushes[0]
    assert abs(leans[-1] - leans[-2]) < 1e-6 < abs(leans[1] - leans[0])


@pytest.mark.parametrize("finger", [0, 1])
def test_one_finger_presses_and_the_other_gets_nothing(finger: int) -> None:
    settings = Settings.model_validate({"scene": {"fingers": (("left", "right")[finger],)}})
    held, reading = some_held(np.random.default_rng(7), 5.0), Reading()
    grip = Grip(settings, [finger], held)
    grip.start(5.0, 5.0)
    reading.dq[finger] = 0.1
    law = settings.control
    arm, stiffness = held.moment_arm[finger], held.stiffness[finger]
    damping = 2.0 * law.damping_ratio * math.sqrt(law.joint_inertia * stiffness) * arm
    for torques in (grip.torques(reading, ObjectPose(), False), grip.hold_goal(reading)):
        assert torques[finger] == pytest.approx(arm * 5.0 - damping * 0.1)
        assert torques[1 - finger] == 0.0
