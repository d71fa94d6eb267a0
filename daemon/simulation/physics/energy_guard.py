"""Compute the plant's energy, and prevent integration steps from creating energy.

If the forces are smooth, the integration error is small and decreases with the step size. Without
the guard, long steps or non-smooth forces could add more energy than the motors and loads supply.
For example, the forces are not smooth when a light object hits the stiff rim of the backing plate.
The guard subtracts the excess energy from the kinetic energy. If the kinetic energy is too small,
the guard stops the motion and shortens the step. For undamped tips, the guard tolerates the
integrator's small energy drift in smooth steps.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics.plant_state import LAYERS, SHEARS, STOP_STIFFNESS, Plant
from softfinger.daemon.simulation.physics.tip import average_layers
from softfinger.kinematics.compiled.kernel import inner_kernel

_LOSSLESS_TOLERANCE = 1e-3  # relative energy gain allowed in smooth steps of undamped tips
# Relative rounding error of the energy. The error is large because d is the small difference
# between two larger lengths.
_ROUNDING = 3e-13
HALVINGS = 12  # maximum number of times that a step is halved


@inner_kernel
def kinetic_energy(plant: Plant) -> float:
    """Return the kinetic energy of the joints and the object [J]."""
    p, v = plant.parameters, plant.state.velocity
    joints = v[0] ** 2 + v[1] ** 2
    moving = v[2] ** 2 + v[3] ** 2
    energy: float = 0.5 * (p.joint_inertia * joints + p.mass * moving + p.inertia * v[4] ** 2)
    return energy


@inner_kernel
def weight_energy(plant: Plant) -> float:
    """Return the gravitational potential energy of the object [J]."""
    p, at = plant.parameters, plant.state.position
    energy: float = -p.mass * (p.gravity[0] * at[2] + p.gravity[1] * at[3])
    return energy


@inner_kernel
def elastic_energy(plant: Plant) -> float:
    """Return the elastic energy [J] stored in end stops, bristles and first-stage contacts."""
    p, stage = plant.parameters, plant.stages[0]
    energy: float = plant.palm_energy
    for finger in range(2):
        q = plant.state.position[finger]
        beyond = min(q - p.stop_low[finger], 0.0)
        beyond += max(q - p.stop_high[finger], 0.0)
        energy += 0.5 * STOP_STIFFNESS * beyond * beyond
        gears = plant.gears[finger]
        deflection = gears.limited_deflection
        energy += 0.5 * gears.friction / p.joint_presliding * deflection * deflection
        energy += stage.on_object[finger].energy
        energy += stage.on_tip[finger].energy
    return energy


@inner_kernel
def total_energy(plant: Plant) -> float:
    """Return the kinetic, elastic and gravitational energy [J]."""
    return kinetic_energy(plant) + elastic_energy(plant) + weight_energy(plant)


@inner_kernel
def is_on_rim(plant: Plant) -> bool:
    """Return True if the rim of a backing plate is in contact."""
    stage = plant.stages[0]
    for finger in range(2):
        if stage.on_object[finger].rim > 0.0 or stage.on_tip[finger].rim > 0.0:
            return True
    return False


@inner_kernel
def open_guard(plant: Plant) -> None:
    """Accept the new energy if code outside the integrator has changed the state."""
    energy = total_energy(plant)
    if energy != plant.energy:
        plant.energy = energy
        plant.energy_limit = energy


@inner_kernel
def work_done(plant: Plant) -> float:
    """Return an upper bound on the work [J] that motors and loads do in the present step."""
    before, now = plant.last_state, plant.state
    work = 0.0
    for j in range(5):
        displacement = now.position[j] - before.position[j]
        if j < 2:
            largest = max(before.current[j] * displacement, now.current[j] * displacement)
            work += plant.parameters.torque_constant * largest
        else:
            work += plant.goals.load[j - 2] * displacement
    return work


@inner_kernel
def guard_step(plant: Plant, was_on_rim: bool) -> int:
    """Remove a step's excess energy by reducing the velocities.

    If the function changes the state, the caller must evaluate the state again and call
    :func:`allow_changed_energy`.

    Returns
    -------
    int
        0 if the step is unchanged, 1 if the motion was slowed, 2 if the kinetic energy was too
        small and the motion was stopped. If the result is 2, the caller must shorten the step with
        :func:`shorten` until :func:`is_within_limit` returns True.
    """
    moving = kinetic_energy(plant)
    weight = weight_energy(plant)
    energy = moving + elastic_energy(plant) + weight
    work = work_done(plant)
    limit = plant.energy_limit + work
    allowed = limit
    if was_on_rim or is_on_rim(plant):
        allowed = min(limit, plant.energy + work)
    elif plant.parameters.tip_loss == 0.0:
        allowed += _LOSSLESS_TOLERANCE * max(limit - weight, 0.0)
    if energy <= allowed + _ROUNDING * (moving + abs(energy) + abs(weight)):
        plant.energy = energy
        plant.energy_limit = min(energy, limit)
        return 0
    plant.limited_step_count += 1
    remaining = moving - (energy - allowed)
    scale = math.sqrt(remaining / moving) if remaining > 0.0 else 0.0
    for j in range(5):
        plant.state.velocity[j] *= scale
    return 1 if remaining >= 0.0 else 2


@inner_kernel
def shorten(plant: Plant, scale: float) -> None:
    """Multiply this step's changes in position, shear and bristle deflection by ``scale``."""
    before, now = plant.last_state, plant.state
    for j in range(5):
        now.position[j] = before.position[j] + scale * (now.position[j] - before.position[j])
    for j in range(2):
        now.shear[j] = before.shear[j] + scale * (now.shear[j] - before.shear[j])
        bent = now.bristles[j] - before.bristles[j]
        now.bristles[j] = before.bristles[j] + scale * bent
        layers, earlier = plant.layers[j], plant.last_layers[j]
        for k in range(LAYERS):
            layers[k] = earlier[k] + scale * (layers[k] - earlier[k])
        average_layers(plant, j)
    for j in range(SHEARS):
        displacement = now.extra_shear[j] - before.extra_shear[j]
        now.extra_shear[j] = before.extra_shear[j] + scale * displacement


@inner_kernel
def is_within_limit(plant: Plant) -> bool:
    """Return True if the sum of elastic and gravitational energy is within the limit."""
    energy = elastic_energy(plant) + weight_energy(plant)
    return bool(energy <= plant.energy_limit + work_done(plant))


@inner_kernel
def allow_changed_energy(plant: Plant) -> None:
    """Update the energy and its limit after :func:`guard_step` has changed the state."""
    energy = total_energy(plant)
    plant.energy = energy
    plant.energy_limit = min(energy, plant.energy_limit + work_done(plant))


@inner_kernel
def allow_relaxed_energy(plant: Plant) -> None:
    """Update the energy after tip relaxation, and change the energy limit by the same amount."""
    energy = total_energy(plant)
    plant.energy_limit += energy - plant.energy
    plant.energy = energy
