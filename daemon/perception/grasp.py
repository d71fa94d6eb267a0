"""The held object in this tick: the result of perception that control and safety read."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.layout import Pair, Record

CHANNELS = (
    "angle, left",
    "angle, right",
    "footprint, left",
    "footprint, right",
    "amplitude, left",
    "amplitude, right",
    "encoder, left",
    "encoder, right",
    "torque",
    "balance",
)


class GraspState(Record):
    """Forces and lever arms of the held object, and the consistency of each channel.

    Pairs are (left, right). SI units.
    """

    t: float  # when the joints were read [s]
    q: Pair  # joint angles [rad]
    d: Pair  # displacements of the tips [m]
    force: Pair  # elastic forces of the tips [N]
    stiffness: Pair  # ∂F/∂d [N/m]
    normal: Pair  # normal forces [N]
    shear: float  # shear force over normal force in the balance without a load
    angle_std: float  # standard deviation of the object's angle [rad]
    taper: float  # angle α between the object's faces [rad]
    tilt_moment_ratio: float  # ∂U/∂θ over F θ d of an upright tip; constant

    # Lever arms
    moment_arm: Pair  # ∂(d1 + d2)/∂q [m]
    jacobian_rotation: Pair  # r1, r2 of φ̇ = r1 q̇1 − r2 q̇2
    jacobian_slide: float  # ∂(d1 + d2)/∂φ [m/rad]
    energy_arm: Pair  # joint torque over force, by the gradient of the energy [m]

    # Load along the faces: it causes the mean residual load_arm L + load_curvature L².
    torque_residual: Pair  # joint torque that only a load along the faces explains [N·m]
    load_arm: float  # [m]; 0: the torques show no load
    load_curvature: float  # [m/N]
    pull_shear: float  # shear of a pull in the newest frames of solid tips [N]
    twist_shear: float  # shear of a twist, likewise [N]
    free_torque: Pair  # largest torque of each joint in the free approach [N·m]
    unexplained_rotation: Pair  # rotation of the object that no joint caused, summed [rad]

    # Consistency
    nis: Annotated[NDArray[np.float64], len(CHANNELS)]  # averaged, 1 is expected
    angle_innovation: Pair  # of the newest frame's angle [rad]
    d_innovation: Pair  # of the newest frame's displacement [m]
    rejected_count: Pair  # frames rejected in a row
    d_bias: Pair  # [m]
    d_bias_std: Pair
    angle_bias: Pair  # [rad]
    angle_bias_std: Pair
    has_bias: Pair  # 1 if one of the biases of a sensor is significant
    gain_change: Pair  # logarithm of the gain over its prior
    gain_std: Pair
    gain_prior_std: Pair
    current_off_time: Pair  # for how long a joint's current has differed from its goal [s]
    sensor_fault: bool  # one of the channels is faulty: no reason to increase the force
