"""The plant's energy, and the guard by which a step doesn't create any.

Where forces are smooth the method's error is small and falls with the step. Where they aren't, as
when the backing plate's stiff rim is hit by a light object, or where a step is far too long, a step
could leave more energy than there was and than the motors and pushes put in. The excess is then
taken out of the motion; when there isn't enough, the motion ends, at rest, where there is. Without
any losses, where the energy should stay, the method's own small drift is allowed in smooth steps.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics.plant_state import LAYERS, SHEARS, Plant
from softfinger.kinematics.compiled.kernel import inner_kernel

LOSSLESS_TOLERANCE = 1e-3  # of the energy, what smooth steps may gain in all without losses
_ROUNDING = 3e-13  # of the energy, for d comes from lengths that are much greater
HALVINGS = 12  # of a step that has to be shortened


@inner_kernel
def kinetic_energy(plant: Plant) -> float:
    """Return kinetic energy of joints and object [J]."""
    p, v = plant.parameters, plant.state.velocity
    joints = v[0] ** 2 + v[1] ** 2
    moving = v[2] ** 2 + v[3] ** 2
    energy: float = 0.5 * (p.joint_inertia * joints + p.mass * moving + p.inertia * v[4] ** 2)
    return energy


@inner_kernel
def weight_energy(plant: Plant) -> float:
    """Return potential energy of the object's weight [J]."""
    p, at = plant.parameters, plant.state.position
    energy: float = -p.mass * (p.gravity[0] * at[2] + p.gravity[1] * at[3])
    return energy


@inner_kernel
def elastic_energy(plant: Plant) -> float:
    """Return the energy [J] of end stops, bristles and all contacts in the first stage."""
    p, stage = plant.parameters, plant.stages[0]
    energy: float = plant.palm_energy
    for finger in range(2):
        q = plant.state.position[finger]
        beyond = min(q - p.stop_low[finger], 0.0)
        beyond += max(q - p.stop_high[finger], 0.0)
        energy += 0.5 * p.stop_stiffness * beyond * beyond
        gears = plant.gears[finger]
        energy += 0.5 * gears.friction / p.presliding * gears.bent * gears.bent
        energy += stage.on_object[finger].energy
        energy += stage.on_tip[finger].energy
    return energy


@inner_kernel
def on_rim(plant: Plant) -> bool:
    """Return whether a backing plate's rim is pressed into something."""
    stage = plant.stages[0]
    depth = 0.0
    for finger in range(2):
        depth += stage.on_object[finger].rim + stage.on_tip[finger].rim
    return bool(depth > 0.0)


@inner_kernel
def open_guard(plant: Plant) -> None:
    """Allow the energy there is, unless it is the one that the last step left."""
    energy = kinetic_energy(plant) + elastic_energy(plant) + weight_energy(plant)
    if energy != plant.energy:
        plant.energy = energy
        plant.allowed = energy


@inner_kernel
def work_done(plant: Plant) -> float:
    """Return the largest work of motors and loads since the earlier state [J]."""
    before, now = plant.earlier, plant.state
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
    """Take a step's excess energy out of its velocities; what was changed.

    0: nothing. 1: the motion was slowed. 2: it had too little energy to be slowed, and was ended;
    the step has to be shortened by :func:`shorten` until :func:`is_allowed`. A changed state is to
    be evaluated again and entered by :func:`enter_changed`.
    """
    moving = kinetic_energy(plant)
    weight = weight_energy(plant)
    energy = moving + elastic_energy(plant) + weight
    work = work_done(plant)
    limit = plant.allowed + work
    if was_on_rim or on_rim(plant):
        allowed = min(limit, plant.energy + work)
    else:
        allowed = limit + plant.parameters.tolerance * max(limit - weight, 0.0)
    if energy <= allowed + _ROUNDING * (moving + abs(energy) + abs(weight)):
        plant.energy = energy
        plant.allowed = min(energy, limit)
        return 0
    plant.guarded += 1
    remaining = moving - (energy - allowed)
    scale = math.sqrt(remaining / moving) if remaining > 0.0 else 0.0
    for j in range(5):
        plant.state.velocity[j] *= scale
    return 1 if remaining >= 0.0 else 2


@inner_kernel
def shorten(plant: Plant, scale: float) -> None:
    """Leave only ``scale`` of what a step brought to positions, shears and bristles."""
    before, now = plant.earlier, plant.state
    for j in range(5):
        now.position[j] = before.position[j] + scale * (now.position[j] - before.position[j])
    for j in range(2):
        now.shear[j] = before.shear[j] + scale * (now.shear[j] - before.shear[j])
        bent = now.bristles[j] - before.bristles[j]
        now.bristles[j] = before.bristles[j] + scale * bent
        layers, earlier = plant.layers[j], plant.earlier_layers[j]
        mean = square = 0.0
        for k in range(LAYERS):  # whole arrays at once would load Numba's ufuncs at each start
            layers[k] = earlier[k] + scale * (layers[k] - earlier[k])
            mean += layers[k] / LAYERS
        for k in range(LAYERS):
            square += (layers[k] - mean) ** 2
        plant.shear_variance[j] = square / LAYERS
    for j in range(SHEARS):
        displacement = now.extra_shear[j] - before.extra_shear[j]
        now.extra_shear[j] = before.extra_shear[j] + scale * displacement


@inner_kernel
def is_allowed(plant: Plant) -> bool:
    """Return whether a state at rest has no more energy than it may have."""
    energy = elastic_energy(plant) + weight_energy(plant)
    return bool(energy <= plant.allowed + work_done(plant))


@inner_kernel
def enter_changed(plant: Plant) -> None:
    """Enter the energy of a state that :func:`guard_step` changed."""
    energy = kinetic_energy(plant) + elastic_energy(plant) + weight_energy(plant)
    plant.energy = energy
    plant.allowed = min(energy, plant.allowed + work_done(plant))


@inner_kernel
def enter_relaxed(plant: Plant) -> None:
    """Enter the energy of a state whose tips have relaxed, and allow as much more or less."""
    energy = kinetic_energy(plant) + elastic_energy(plant) + weight_energy(plant)
    plant.allowed += energy - plant.energy
    plant.energy = energy
