"""The object on the palm: each corner, or a disc's lowest point, on springs with Coulomb friction.

The palm is a plane along x. A corner below it is pushed up by a spring with a viscous loss, which
doesn't pull. Along the palm a second spring follows the corner's slide, sticks, and gives way where
its force would exceed friction times the push, so that a resting object doesn't creep. Only kernels
live here.
"""

from __future__ import annotations

import numpy as np

from softfinger.daemon.simulation.physics import layout
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer

STIFFNESS = 1e5  # N/m, of each corner up and along
LOSS = 1e-3  # s, damping over stiffness


@inner_kernel
def palm_is_far(memory: Pointer, position: int, velocity: int) -> bool:
    """Whether no point of the object can meet the palm within a step."""
    height = memory[position + 3] - memory[layout.PALM] - memory[layout.EXTENT]
    rate = memory[velocity + 3]
    turning = memory[velocity + 4] * memory[layout.EXTENT]
    return bool(height > memory[layout.STEP] * (abs(rate) + abs(turning)))


@inner_kernel
def evaluate_palm(
    memory: Pointer, position: int, velocity: int, shear: int, nx: float, ny: float, stage: np.int64
) -> None:
    """Add the palm's forces on the object to FORCES; write its energy and its shears' rates.

    ``position``, ``velocity`` and ``shear`` are where the coordinates, their rates and the shears
    stand; (nx, ny) is the object's n. The first ``stage`` also brings the shears within friction
    and hands the rows to the coupled matrix.
    """
    h = memory[layout.STEP]
    height = memory[position + 3] - memory[layout.PALM]
    x_rate = memory[velocity + 2]
    y_rate = memory[velocity + 3]
    turn_rate = memory[velocity + 4]
    round_ = memory[layout.SHAPE] == layout.DISC
    energy = 0.0
    for corner in range(1 if round_ else 4):
        lever_x = 0.0
        lever_y = -memory[layout.ROUNDNESS]
        if not round_:
            edge = layout.OUTLINE + corner * layout.EDGE
            u = memory[edge + layout.EDGE_X]
            v = memory[edge + layout.EDGE_Y]
            lever_x = u * nx - v * ny
            lever_y = u * ny + v * nx
        depth = -(height + lever_y)
        rate = -(y_rate + lever_x * turn_rate)
        slide = x_rate - lever_y * turn_rate
        coming = max(depth, depth + h * rate) > 0.0
        push = 0.0
        drag = 0.0
        loss = LOSS * STIFFNESS
        along = 0.0
        if depth > 0.0:
            push = max(STIFFNESS * (depth + LOSS * rate), 0.0)
            most = memory[layout.PALM_FRICTION] * push
            along = min(max(STIFFNESS * memory[shear + corner], -most), most)
            energy += 0.5 * (STIFFNESS * depth * depth + along * along / STIFFNESS)
            if slide != 0.0:
                opposed = along if slide > 0.0 else -along
                loss = min(loss, (most - opposed) / abs(slide))
            drag = along + loss * slide
            memory[layout.FORCES + 2] -= drag
            memory[layout.FORCES + 3] += push
            memory[layout.FORCES + 4] += push * lever_x + drag * lever_y
        memory[layout.EXTRA_RATE + 6 * int(stage) + corner] = slide if depth > 0.0 else 0.0
        if stage == layout.FIRST_STAGE:
            memory[shear + corner] = along / STIFFNESS
            up = layout.EXTRA + 2 * corner * layout.EXTRA_ROW
            side = up + layout.EXTRA_ROW
            memory[up + 3] = -1.0
            memory[up + 4] = -lever_x
            memory[up + 5] = STIFFNESS if coming else 0.0
            memory[up + 6] = LOSS * STIFFNESS if coming else 0.0
            memory[up + 7] = 0.0
            memory[side + 2] = 1.0
            memory[side + 4] = -lever_y
            memory[side + 5] = STIFFNESS if coming else 0.0
            memory[side + 6] = loss if coming else 0.0
            memory[side + 7] = 1.0 + corner
            if coming:
                memory[layout.COUPLED] = 1.0
    memory[layout.PALM_ENERGY] = energy
