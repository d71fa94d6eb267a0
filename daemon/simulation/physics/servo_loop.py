"""The servos inside the plant's sub-steps: position loop, limits of the motor, end stops."""

from __future__ import annotations

from softfinger.daemon.simulation.physics.plant_state import (
    CURRENT_BASED_POSITION_MODE,
    CURRENT_MODE,
    Plant,
)
from softfinger.kinematics.compiled.kernel import inner_kernel


@inner_kernel
def current_reference(plant: Plant, joint: int, q: float, rate: float) -> float:
    """Current [A] that a servo asks of its motor: its mode's law within all limits.

    The supply's limit falls linearly from the stall current at rest to none at no-load speed.
    """
    p, goals = plant.parameters, plant.goals
    if goals.torque_on[joint] == 0:
        return 0.0
    limit = p.current_limit
    mode = goals.mode[joint]
    if mode == CURRENT_MODE:
        reference = goals.current[joint]
    else:
        reference = p.position_gain * (goals.q[joint] - q) - p.rate_gain * rate
        if mode == CURRENT_BASED_POSITION_MODE:
            limit = min(limit, abs(goals.current[joint]))
    reference = min(max(reference, -limit), limit)
    back = p.stall_current * rate / p.no_load_speed
    current: float = min(max(reference, -p.stall_current - back), p.stall_current - back)
    return current


@inner_kernel
def set_motor_slopes(plant: Plant, g: float) -> None:
    """How steeply the motors' torques fall with angle and with velocity, over (τ + g).

    Only where a step of ``g`` makes them stiff, else 0. They are upper bounds, since whether the
    reference is limited may change within the step.
    """
    p, goals = plant.parameters, plant.goals
    constant = p.torque_constant
    for joint in range(2):
        by_q = 0.0
        by_rate = 0.0
        if goals.torque_on[joint] != 0:
            by_rate = p.stall_current / p.no_load_speed
            if goals.mode[joint] != CURRENT_MODE:
                by_q = p.position_gain
                by_rate = max(by_rate, p.rate_gain)
            if g * constant * (by_rate + g * by_q) < 0.1 * p.joint_inertia:
                by_q = 0.0
                by_rate = 0.0
        plant.motor_by_q[joint] = constant * by_q / (p.electric_time + g)
        plant.motor_by_rate[joint] = constant * by_rate / (p.electric_time + g)


@inner_kernel
def stop_stiffness(plant: Plant, joint: int) -> float:
    """Stiffness [N·m/rad] of the end stop that the joint is on or will be within a step, else 0."""
    p = plant.parameters
    stiffness: float = 0.0
    q = plant.state.position[joint]
    ahead = q + p.step * plant.state.velocity[joint]
    if min(q, ahead) < p.stop_low[joint] or max(q, ahead) > p.stop_high[joint]:
        stiffness = p.stop_stiffness
    return stiffness
