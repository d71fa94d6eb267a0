"""State of the held object on one tick. Perception writes the state; control and safety read it."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.layout import Pair, Record

# Index of each measurement channel in `GraspState.nis`. For the first four channels, each name is
# the index for the left tip. The next index is for the right tip.
ANGLE_CHANNEL, FOOTPRINT, AMPLITUDE, ENCODER_CHANNEL, TORQUES = range(0, 10, 2)
BALANCE, CHANNELS = 9, 10


class GraspState(Record):
    """Tip forces on the held object, moment arms, and consistency of the measurement channels.

    Pairs are (left, right). All quantities are in SI units.
    """

    t: float  # time of the joint reading [s]
    q: Pair  # joint angles [rad]
    d: Pair  # tip displacements [m]
    force: Pair  # elastic tip forces [N]
    stiffness: Pair  # ∂F/∂d [N/m]
    normal: Pair  # normal forces [N]
    shear: float  # ratio of shear force to normal force, at equilibrium without a load
    angle_std: float  # standard deviation of the object angle [rad]
    tilt_moment_ratio: float  # (∂U/∂θ)/(F θ d) near θ = 0; springs: 2/3, solid rubber: about 0

    # Moment arms
    moment_arm: Pair  # ∂(d1 + d2)/∂q [m]
    rolling_ratio: Pair  # r1, r2 in φ̇ = r1 q̇1 − r2 q̇2
    slide: float  # ∂(d1 + d2)/∂φ [m/rad]
    energy_arm: Pair  # joint torque per unit of tip force, computed from the energy gradient [m]

    # A load L along the object faces changes the mean torque residual by load_arm L +
    # load_curvature L².
    torque_residual: Pair  # joint torque attributed to a load along the object faces [N·m]
    load_arm: float  # moment arm of the load [m], or 0 if the load has no effect on the torques
    load_curvature: float  # [m/N]
    pull_shear: float  # shear due to a pulling load, measured by solid tips [N]
    twist_shear: float  # shear due to a twisting load, measured by solid tips [N]
    free_torque: Pair  # maximum torque of each joint during this approach, before contact [N·m]
    unexplained_rotation: Pair  # accumulated object rotation not explained by joint motion [rad]

    # Consistency
    nis: Annotated[NDArray[np.float64], CHANNELS]  # running averages; the expected value is 1
    angle_jump: Pair  # angle in the newest frame minus the predicted angle, during a grip [rad]
    d_jump: Pair  # d in the newest frame minus the predicted d [m]; 0 if d is not measured
    rejects_frames: Pair  # 1 if too many consecutive frames were rejected
    d_bias: Pair  # [m]
    angle_bias: Pair  # [rad]
    has_d_bias: Pair  # 1 if `d_bias` is significant
    has_angle_bias: Pair  # 1 if `angle_bias` is significant
    gain_change: Pair  # ln(sensor gain / prior gain)
    gain_std: Pair
    gain_prior_std: Pair
    has_wrong_current: Pair  # 1 if the joint's current has differed from its goal for too long
    sensor_fault: bool  # True if the grip force must not increase because a channel is faulty
