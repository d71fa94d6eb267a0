"""Measure the error that remains in the object angle with each control law.

An object is placed between the fingers at an angle and then grasped. The error is computed from the
object's true angle in the simulation, not from the daemon's estimate. The simulated plants differ
from the settings, and the sensor is either ideal or defective. All runs use virtual time, so the
results do not depend on the machine's speed.

The daemon's control laws are compared with two laws from the literature. *Equal torques* is the
`upright` law without its spring and dither. *Two-phased* (:class:`TwoPhased`) is the serial
two-phased controller for soft-fingered manipulation. The published two-phased controller uses a
camera, which measures the object angle with a delay. The two-phased controller and the daemon's law
are therefore also tested with delays of up to 0.3 s.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from softfinger.daemon.control.grip import Grip
from softfinger.daemon.types import ObjectPose, Reading
from softfinger.tools.benchmarks.measuring import Report, Row, figure
from softfinger.tools.benchmarks.rigs import SENSORS, SOLID, Sections, merged
from softfinger.tools.simulated_daemon import SimulatedDaemon

_FORCE = 10.0  # N
_ANGLE_STD = math.radians(5.0)
_DRAW_COUNT = 12
_READ_TIME = 5.0  # time from the grasp command to the final angle measurement [s]
_STEERING_TIME = 2.0  # duration of angle control before the final angle measurement [s]
DELAYS = (0.0, 0.05, 0.1, 0.2, 0.3)  # s
# Bandwidths of the angle integrator [Hz]. The slow integrator is stable at every delay in `DELAYS`,
# because ω × delay < π/2. The fast bandwidth is the default of `control.rotate_bandwidth`.
_SLOW_BANDWIDTH, _FAST_BANDWIDTH = 0.5, 4.0


class Altered(Grip):
    """The daemon's control law, with the object angle delayed by ``delay`` [s].

    ``apart`` is the difference between the two joints' torque constants, divided by their mean.
    """

    def __init__(self, hand: SimulatedDaemon, delay: float = 0.0, apart: float = 0.0) -> None:
        fingers = hand.control.fingers
        super().__init__(hand.settings, fingers.indices, fingers.grasp)
        ticks = round(delay * hand.settings.loop.rate)
        self._poses: deque[ObjectPose] = deque(maxlen=ticks + 1)
        self._apart = apart

    def torques(self, reading: Reading, pose: ObjectPose, holding: bool) -> tuple[float, float]:
        """Return the joint torques [N·m]."""
        self._poses.append(replace(pose))
        torque1, torque2 = self._law(reading, self._poses[0], holding)
        return torque1 * (1.0 + 0.5 * self._apart), torque2 * (1.0 - 0.5 * self._apart)

    def _law(self, reading: Reading, pose: ObjectPose, holding: bool) -> tuple[float, float]:
        return super().torques(reading, pose, holding)


class TwoPhased(Altered):
    """Serial two-phased controller from the literature.

    Phase one integrates the object angle error with ``bandwidth`` [Hz] into an antisymmetric joint
    goal. Phase two is a PD law that moves the joints to this goal. Both joint torques also include
    the same bias, which is computed from the requested force. The measured force is not used.
    """

    def __init__(
        self, hand: SimulatedDaemon, delay: float = 0.0, bandwidth: float = _SLOW_BANDWIDTH
    ) -> None:
        super().__init__(hand, delay)
        self._bandwidth = bandwidth

    def _law(self, reading: Reading, pose: ObjectPose, _: bool) -> tuple[float, float]:
        state, grasp, (q1, q2), (dq1, dq2) = self._state, self._grasp, reading.q, reading.dq
        self.force.step(state.force_rate)
        if pose.valid and not math.isnan(self.target_angle):
            error = self.target_angle - pose.angle
            rate = 2.0 * math.pi * self._bandwidth * error / sum(grasp.rolling_ratio)
            state.offset += rate * state.law.dt
        bias = 0.5 * self.force.value * sum(grasp.moment_arm)
        damping = state.law.damping * math.sqrt(state.joint_stiffness)
        steering = state.joint_stiffness * (state.offset - 0.5 * (q1 - q2))
        return bias + steering - damping * dq1, bias - steering - damping * dq2


_DEFAULT: Sections = {}


class Way(NamedTuple):
    """Control law under test, with its settings, the plant's settings and the target error [°]."""

    control: Mapping[str, Any] = _DEFAULT
    tips: Sections = _DEFAULT
    aim: float | None = None
    is_steered: bool = False  # True if the measured angle is controlled to 0
    law: Callable[[SimulatedDaemon], Grip] | None = None  # control law that replaces the daemon's
    force: float = _FORCE
    # Load along x and y after the grip is established [N].
    weight: tuple[float, float] = (0.0, 0.0)


EQUAL_TORQUES = {"law": "upright", "dither_time": 0.0, "joint_stiffness": 1e-9}
_UPRIGHT = {"law": "upright"}
_RELAXING: Sections = {"simulation": {"tip_creep_time": 20.0, "tip_micro_slip": True}}
WAYS = {
    "equal torques (blind)": Way(EQUAL_TORQUES),
    "equal torques, tips that relax": Way(EQUAL_TORQUES, _RELAXING),
    "equal torques, solid tips": Way(EQUAL_TORQUES, SOLID),
    "energy": Way(),
    "energy, steered to 0": Way(aim=0.2, is_steered=True),
    "upright (blind)": Way(_UPRIGHT, aim=0.5),
    "upright, tips that relax": Way(_UPRIGHT, _RELAXING, 0.5),
    "upright, solid tips": Way(_UPRIGHT, SOLID, 0.5),
    **{
        f"energy, steered to 0, {sensor}": Way({}, flaws, 1.0, True)
        for sensor, flaws in SENSORS.items()
    },
}


def _upright(
    law: Callable[[SimulatedDaemon], Grip] | None = None,
    force: float = _FORCE,
    width: float = 0.0,
    weight: tuple[float, float] = (0.0, 0.0),
    **simulation: Any,
) -> Way:
    """Return a test of the `upright` law on a plant that violates the law's assumptions."""
    tips: Sections = {"simulation": simulation}
    if width:
        tips = {"object": {"width": width}, "simulation": {"object_width": width}}
    return Way(_UPRIGHT, tips, law=law, force=force, weight=weight)


LIMITS = {
    "torque constants 1 % apart": _upright(partial(Altered, apart=0.01)),
    "torque constants 5 % apart": _upright(partial(Altered, apart=0.05)),
    "tips without tangential coupling": _upright(tip_law="bristles"),
    "tips half as stiff along the face": _upright(tip_shear_stiffness=0.5),
    "tips twice as stiff along the face": _upright(tip_shear_stiffness=2.0),
    "a weight of 2 N along the fingers": _upright(weight=(0.0, -2.0)),
    "a weight of 2 N across the fingers": _upright(weight=(2.0, 0.0)),
    **{f"a grip of {force:g} N": _upright(force=force) for force in (3.0, 2.0, 1.0)},
    **{f"joint friction {each:g} N·m": _upright(joint_friction=each) for each in (0.1, 0.15, 0.2)},
    **{f"an object of {1e3 * width:g} mm": _upright(width=width) for width in (0.06, 0.07, 0.09)},
}
_STEERED_LAWS: dict[str, tuple[Mapping[str, Any], Callable[..., Grip]]] = {
    f"two-phased, {_SLOW_BANDWIDTH:g} Hz": ({}, TwoPhased),
    f"energy, {_SLOW_BANDWIDTH:g} Hz": ({"rotate_bandwidth": _SLOW_BANDWIDTH}, Altered),
    f"two-phased, {_FAST_BANDWIDTH:g} Hz": ({}, partial(TwoPhased, bandwidth=_FAST_BANDWIDTH)),
    f"energy, {_FAST_BANDWIDTH:g} Hz": ({}, Altered),
}
LATE_LIMITS = {
    f"{name}, {1e3 * delay:g} ms": Way(control, is_steered=True, law=partial(law, delay=delay))
    for name, (control, law) in _STEERED_LAWS.items()
    for delay in DELAYS
}
# At θ = 0, the energy curvature of tips without tangential coupling is four times that of relaxed
# spring tips. If the tangential stiffness is less than three quarters of the default, the energy
# has a maximum at θ = 0.
_TIPS: dict[str, Sections] = {
    "solid": SOLID,
    "without tangential coupling": {"simulation": {"tip_law": "bristles"}},
    "half as stiff along the face": {"simulation": {"tip_shear_stiffness": 0.5}},
}
LATE_TIPS = {
    f"{name}, {1e3 * delay:g} ms": Way(
        {}, tips, is_steered=True, law=partial(TwoPhased, delay=delay)
    )
    for name, tips in _TIPS.items()
    for delay in DELAYS
}


def measure(brief: bool = False) -> list[Report]:
    """Return tables of residual angles [°]. With few plants, p99 is close to the maximum."""
    plants = drawn(2 if brief else _DRAW_COUNT)
    title = (
        f"remaining angle of {math.degrees(_ANGLE_STD):g}° after {_READ_TIME:g} s at {_FORCE:g} N"
    )
    return [
        Report(f"{title}{of}", [row(name, way, plants) for name, way in ways.items()])
        for of, ways in (
            ("", WAYS),
            (", upright, limits", LIMITS),
            (", delayed angle", LATE_LIMITS),
            (", delayed angle, other tips, two-phased", LATE_TIPS),
        )
    ]


def drawn(count: int) -> list[dict[str, Any]]:
    """Create random plants that differ from the settings; all control laws use the same plants."""
    rng = np.random.default_rng(16)
    return [
        {
            "seed": k,
            "object_angle": _ANGLE_STD * (-1.0) ** k,
            "object_position": (rng.uniform(-0.003, 0.003), 0.080),
            "modulus_scale": rng.uniform(0.7, 1.3),
            "tip_friction": rng.uniform(0.2, 0.8),
            "object_mass": 0.10 * 2.0 ** rng.uniform(-1.0, 1.0),
        }
        for k in range(count)
    ]


def row(name: str, way: Way, plants: list[dict[str, Any]]) -> Row:
    """Return a row with one law's residual angles on ``plants`` and the number of lost objects.

    ``angles`` lists the residual angle on each plant [°], or None if the object is not held.
    """
    angles = [left(way, plant) for plant in plants]
    held = [each for each in angles if each is not None]
    more = {"not held": len(angles) - len(held), "angles": angles}
    return figure(name, "°", held, way.aim, **more) if held else {"name": name, **more}


def left(way: Way, simulation: Mapping[str, Any]) -> float | None:
    """Return the residual object angle [°] on one plant, or None if the object is not held."""
    sections = merged({"simulation": simulation, "control": way.control}, way.tips)
    with SimulatedDaemon(sections) as hand:
        if way.law is not None:
            hand.control.grip = way.law(hand)
        hand.grasp(way.force)
        begun = hand.now
        while (
            min(hand.plant.force) < 0.7 * way.force
            and hand.now < begun + _READ_TIME - _STEERING_TIME
        ):
            hand.run(hand.loop.period)
        hand.plant.apply_load(*way.weight)
        hand.run(begun + _READ_TIME - _STEERING_TIME - hand.now)
        if way.is_steered:  # Do not wait for a measured force; some laws do not measure it.
            hand.control.grip.steer(hand.state.object.angle, 0.0)
        hand.run(_STEERING_TIME)
        is_held = min(hand.plant.force) > 0.0
        return math.degrees(abs(float(hand.plant.object_pose[2]))) if is_held else None
