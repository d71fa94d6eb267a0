"""State of the held object on this tick, written by perception and read by control and safety."""

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
    """Forces and lever arms on the held object, and consistency of each channel.

    Pairs are (left, right). SI units.
    """

    t: float  # time of the joint reading [s]
    q: Pair  # joint angles [rad]
    d: Pair  # tip displacements [m]
    force: Pair  # elastic tip forces [N]
    stiffness: Pair  # ∂F/∂d [N/m]
    normal: Pair  # normal forces [N]
    shear: float  # ratio of shear force to normal force at equilibrium without a load
    angle_std: float  # standard deviation of the object angle [rad]
    taper: float  # angle α between the object faces [rad]
    tilt_moment_ratio: float  # (∂U/∂θ)/(F θ d) of an upright tip, a constant

    # Lever arms
    moment_arm: Pair  # ∂(d1 + d2)/∂q [m]
    jacobian_rotation: Pair  # r1, r2 in φ̇ = r1 q̇1 − r2 q̇2
    jacobian_slide: float  # ∂(d1 + d2)/∂φ [m/rad]
    energy_arm: Pair  # joint torque divided by force, from the energy gradient [m]

    # A load L along the faces causes the mean residual load_arm L + load_curvature L².
    torque_residual: Pair  # joint torque attributed to a load along the faces [N·m]
    load_arm: float  # moment arm of the load [m], or 0 if the torques show no load
    load_curvature: float  # [m/N]
    pull_shear: float  # shear due to a pull, from the newest frames of solid tips [N]
    twist_shear: float  # shear due to a twist, from the newest frames of solid tips [N]
    free_torque: Pair  # maximum torque of each joint during free approach [N·m]
    unexplained_rotation: Pair  # accumulated object rotation that the joints do not explain [rad]

    # Consistency
    nis: Annotated[NDArray[np.float64], len(CHANNELS)]  # running average, expected value 1
    angle_jump: (
        Pair  # difference between the newest frame of a held object and its prediction [rad]
    )
    d_jump: Pair  # the same for the displacement, 0 if the frame does not measure it [m]
    rejects_frames: Pair  # 1 if more consecutive frames were rejected than may be missing
    d_bias: Pair  # [m]
    d_bias_std: Pair
    angle_bias: Pair  # [rad]
    angle_bias_std: Pair
    has_bias: Pair  # 1 if the sensor has a significant bias
    gain_change: Pair  # logarithm of the ratio of the gain to its prior
    gain_std: Pair
    gain_prior_std: Pair
    has_wrong_current: Pair  # 1 if a joint's current has differed from its goal for too long
    sensor_fault: bool  # True if a channel is faulty, so that the grip force must not increase
