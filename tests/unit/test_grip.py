"""The grip laws' kernels against the same laws in plain Python."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from softfinger.daemon.control.grip import Grip
from softfinger.daemon.perception.contact_filter_kernels import GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import ObjectPose, Reading

DT = 0.002


def between(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)


class Smooth:
    """A reference: a ramp, then the means of its last values, then the means of those."""

    def __init__(self, window: float, value: float) -> None:
        self.ramps = [value] * round(window / DT)
        self.means = [value] * round(0.5 * window / DT)
        self.target = self.value = value
        self.speed = 0.0
        self.idle = 10**6

    @property
    def arrived(self) -> bool:
        return self.ramps[-1] == self.target and self.idle >= len(self.ramps) + len(self.means)

    def step(self, rate: float) -> None:
        left = self.target - self.ramps[-1]
        self.idle = self.idle + 1 if left == 0.0 else 0
        self.ramps = [*self.ramps[1:], self.ramps[-1] + between(left, rate * DT)]
        self.means = [*self.means[1:], float(np.mean(self.ramps))]
        last, self.value = self.value, float(np.mean(self.means))
        self.speed = (self.value - last) / DT


@dataclass
class Twin:
    """The steered laws' equations for two fingers, one tick at a time."""

    settings: Settings
    force: Smooth
    angle: Smooth
    offset: float
    integral: float = 0.0
    shift: float = 0.0
    pull: tuple[float, float] = (0.0, 0.0)
    rate: float = 0.0
    steering: bool = False

    def torques(
        self, held: GraspState, felt: float, turned: float, dq: tuple[float, float]
    ) -> tuple[float, float]:
        law = self.settings.control
        arm1, arm2 = held.moment_arm
        arm = 0.5 * (arm1 + arm2)
        stiffness = float(np.mean(held.stiffness))
        turn = sum(held.jacobian_rotation)
        self.force.step(self.rate)
        error = self.force.value - felt
        most = self.settings.safety.current_max * law.torque_constant
        if error < 0.0 or max(map(abs, self.pull)) < most:
            self.integral += 2.0 * math.pi * law.force_bandwidth * error * DT
            self.integral = between(self.integral, 0.3 * self.force.target)
        push = self.force.value + law.force_gain * error + self.integral
        bound = 1.2 * self.force.target + law.joint_friction / max(arm, 0.008)
        push = min(push, bound)
        lean = 0.0
        if self.steering:
            self.angle.step(law.rotate_speed)
            lean = self.angle.speed / turn
            off = self.angle.value - turned
            if self.angle.arrived:
                off -= between(off, 3.0 * held.angle_std)
            self.offset += (2.0 * math.pi * law.rotate_bandwidth * off / turn + lean) * DT
        if self.force.arrived and (self.angle.arrived or not self.steering):
            uneven = 0.5 * (held.normal[0] - held.normal[1]) / (stiffness * arm)
            shift = between(self.shift - 2.0 * math.pi * 2.0 * uneven * DT, 3e-3 / turn)
            self.offset += shift - self.shift
            self.shift = shift
        close = 2.0 * self.force.speed / stiffness
        close = (close - (arm1 - arm2 + held.jacobian_slide * turn) * lean) / (arm1 + arm2)
        damping = 2.0 * law.damping_ratio * math.sqrt(law.joint_inertia)
        calm = damping * math.sqrt(stiffness * arm**2) * (close - 0.5 * sum(dq))
        steer = law.joint_stiffness * (self.offset - 0.5 * (held.q[0] - held.q[1]))
        steer += damping * math.sqrt(law.joint_stiffness) * (lean - 0.5 * (dq[0] - dq[1]))
        levers = held.energy_arm if law.law == "energy" else held.moment_arm
        rub = [
            law.joint_friction * between(w / law.friction_speed, 1.0)
            for w in (close + lean, close - lean)
        ]
        self.pull = (
            levers[0] * push + calm + steer + rub[0],
            levers[1] * push + calm - steer + rub[1],
        )
        return self.pull


def change(held: GraspState, generator: np.random.Generator) -> None:
    """Another object, but for the forces of the tips."""
    held.q = list(generator.uniform(-0.2, 0.2, 2))
    held.moment_arm = list(generator.uniform(0.06, 0.09, 2))
    held.jacobian_rotation = list(generator.uniform(0.5, 1.0, 2))
    held.energy_arm = list(generator.uniform(0.06, 0.09, 2))
    held.stiffness = list(generator.uniform(2e3, 9e3, 2))
    held.normal = list(generator.uniform(5.0, 9.0, 2))
    held.jacobian_slide = generator.uniform(-0.02, 0.02)
    held.angle_std = generator.uniform(0.0, 0.02)


def some_held(generator: np.random.Generator, force: float = 0.0) -> GraspState:
    held = GraspState()
    change(held, generator)
    held.force = [force, force]
    return held


@pytest.mark.parametrize(("law", "steered"), [("energy", 700), ("upright", 0)])
def test_the_torques_are_those_of_the_law_in_plain_python(law: str, steered: int) -> None:
    generator = np.random.default_rng(5)
    # Without a margin to keep, the force that is gone to is the one that was asked for.
    settings = Settings.model_validate({"control": {"law": law, "grip_raise_max": 0.0}})
    held = some_held(generator)
    grip = Grip(settings, [0, 1], held)
    window = settings.control.smooth_time
    twin = Twin(settings, Smooth(window, 1.0), Smooth(window, 0.05), 0.5 * (held.q[0] - held.q[1]))
    grip.start(1.0, 8.0)
    twin.force.target, twin.rate = 8.0, 7.0 / settings.control.force_time
    reading = Reading()
    for k in range(2000):
        if k == steered:
            grip.steer(0.05, 0.15)
            twin.steering, twin.angle.target = True, 0.15
        if k == 1200:
            twin.rate = abs(6.0 - grip.force.value) / settings.control.force_time
            grip.retarget(6.0)
            twin.force.target = 6.0
        change(held, generator)
        forces = generator.uniform(5.0, 9.0, 2)
        reading.dq[:] = generator.uniform(-0.3, 0.3, 2)
        pose = ObjectPose(True, generator.uniform(0.0, 0.2), 0.03)
        held.force = forces
        found = grip.torques(reading, pose, False)
        expected = twin.torques(held, forces.mean(), pose.angle, (reading.dq[0], reading.dq[1]))
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-11)
    assert twin.force.arrived
    assert twin.angle.arrived
    assert twin.shift != 0.0


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
