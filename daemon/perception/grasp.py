"""The held object at this tick, as perception tells control and safety of it."""

from __future__ import annotations

from softfinger.kinematics.compiled.layout import Pair, Record


class GraspState(Record):
    """Response of the held object to the joints at this tick, and what speaks against a channel."""

    t: float  # when the joints were read [s]
    d: Pair  # displacements [m]
    force: Pair  # of the tips, their moduli's scale times their tables' [N]
    angle_std: float  # standard deviation of the object's angle [rad]
    taper: float  # α between the object's faces, as both tips feel them [rad]
    unexplained_rotation: Pair  # of the object, by no joint, summed, as each tip shows it [rad]
    turning: float  # ∂U/∂θ over F θ d of the tips, upright: set once
    q: Pair  # joint angles [rad]
    moment_arm: Pair  # ∂(d1 + d2)/∂q [m]
    jacobian_rotation: Pair  # r of φ̇ = r1 q̇1 − r2 q̇2
    jacobian_slide: float  # ∂(d1 + d2)/∂φ [m/rad]
    energy_arm: Pair  # torque over force by the energy [m]
    stiffness: Pair  # ∂F/∂d [N/m]
    normal: Pair  # normal forces [N]
    shear: float  # shear over normal force, by the object's balance, unloaded
    sheared: float  # along the faces, as solid tips' newest frames show it [N]
    twisted: float  # likewise, of a twist: alike on both faces [N]
    torque_residual: Pair  # what only a load along the faces explains of the joints' torques [N·m]
    torque_std: float  # of the joints' mean torque, by what is not known of the tips' forces [N·m]
    load_arm: float  # a load L makes them arm L + curvature L²; 0: none shows [m]
    load_curvature: float  # [m/N]
    free_torque: Pair  # the most that each joint took on its way to the touch: friction's bound
    refused: Pair  # frames in a row that were not believed
    angle_off: Pair  # of the newest frame's angle from what was expected [rad]
    d_off: Pair  # likewise, of its d [m]
    drift: Pair  # d that frames show beyond the tips' [m] …
    drift_std: Pair  # … and its standard deviation
    shift: Pair  # likewise of the angle [rad]
    shift_std: Pair
    gain_off: Pair  # logarithm of the sensors' gains over what was known of them before …
    gain_std: Pair  # … its standard deviation, and that of what was known
    gain_prior: Pair
    drifted: Pair  # 1 where one of the two is more than the sensor's frames may be off
    off_goal: Pair  # for how long a joint's current has not been its goal's [s]
    doubted: bool  # a channel is named as false
