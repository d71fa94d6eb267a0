"""The object on the palm: each corner, or a disc's lowest point, on springs with Coulomb friction.

The palm is a plane along x. A corner below it is pushed up by a spring with a viscous loss, which
doesn't pull. Along the palm a second spring follows the corner's slide, sticks, and gives way where
its force would exceed friction times the push, so that a resting object doesn't creep.
"""

from __future__ import annotations

from softfinger.daemon.simulation.physics.plant_state import (
    CORNERS,
    DISC,
    Motion,
    Plant,
    Stage,
)
from softfinger.kinematics.compiled.kernel import inner_kernel

STIFFNESS = 1e5  # N/m, of each corner up and along
LOSS = 1e-3  # s, damping over stiffness


@inner_kernel
def palm_is_far(plant: Plant, now: Motion) -> bool:
    """Whether no point of the object can meet the palm within a step."""
    p = plant.parameters
    height = now.position[3] - p.palm - p.extent
    rate = now.velocity[3]
    turning = now.velocity[4] * p.extent
    return bool(height > p.step * (abs(rate) + abs(turning)))


@inner_kernel
def touch_palm(
    plant: Plant, now: Motion, stage: Stage, nx: float, ny: float, is_first: bool
) -> None:
    """Add the palm's forces on the object, where it may meet it; (nx, ny) is the object's n.

    The first stage also brings the shears within friction and hands the rows to the full matrix.
    """
    if palm_is_far(plant, now):
        for corner in range(CORNERS):
            stage.extra_rate[corner] = 0.0
        if is_first and plant.palm_energy != 0.0:
            plant.palm_energy = 0.0
            for corner in range(CORNERS):
                now.extra_shear[corner] = 0.0
        return
    p = plant.parameters
    height = now.position[3] - p.palm
    x_rate = now.velocity[2]
    y_rate = now.velocity[3]
    turn_rate = now.velocity[4]
    round_ = p.shape == DISC
    energy = 0.0
    for corner in range(1 if round_ else CORNERS):
        lever_x = 0.0
        lever_y = -p.roundness
        if not round_:
            u = p.outline[corner].x
            v = p.outline[corner].y
            lever_x = u * nx - v * ny
            lever_y = u * ny + v * nx
        depth = -(height + lever_y)
        rate = -(y_rate + lever_x * turn_rate)
        slide = x_rate - lever_y * turn_rate
        coming = max(depth, depth + p.step * rate) > 0.0
        push = 0.0
        drag = 0.0
        loss = LOSS * STIFFNESS
        along = 0.0
        if depth > 0.0:
            push = max(STIFFNESS * (depth + LOSS * rate), 0.0)
            most = p.palm_friction * push
            along = min(max(STIFFNESS * now.extra_shear[corner], -most), most)
            energy += 0.5 * (STIFFNESS * depth * depth + along * along / STIFFNESS)
            if slide != 0.0:
                opposed = along if slide > 0.0 else -along
                loss = min(loss, (most - opposed) / abs(slide))
            drag = along + loss * slide
            plant.forces[2] -= drag
            plant.forces[3] += push
            plant.forces[4] += push * lever_x + drag * lever_y
        stage.extra_rate[corner] = slide if depth > 0.0 else 0.0
        if is_first:
            now.extra_shear[corner] = along / STIFFNESS
            up = plant.extra[2 * corner]
            up.row[3] = -1.0
            up.row[4] = -lever_x
            up.stiffness = STIFFNESS if coming else 0.0
            up.damping = LOSS * STIFFNESS if coming else 0.0
            up.shear = 0
            side = plant.extra[2 * corner + 1]
            side.row[2] = 1.0
            side.row[4] = -lever_y
            side.stiffness = up.stiffness
            side.damping = loss if coming else 0.0
            side.shear = 1 + corner
            plant.coupled = plant.coupled or coming
    plant.palm_energy = energy
