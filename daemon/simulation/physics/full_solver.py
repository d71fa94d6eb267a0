"""The step's linear equations where contacts couple more than the tips on the object do.

Where the object is on the palm or the tips are on each other, the extra rows join in, and the
matrix is full: it is assembled, factorised as L D Lᵀ and solved here. ``g`` is γh of `plant`.
"""

from __future__ import annotations

from softfinger.daemon.simulation.physics.plant_state import (
    EXTRA_ROWS,
    ExtraRow,
    FloatArray,
    Motion,
    Plant,
)
from softfinger.daemon.simulation.physics.solver import joint_pivot
from softfinger.kinematics.compiled.kernel import inner_kernel


@inner_kernel
def factorise_full(plant: Plant, g: float) -> None:
    """Factorise M + gD + g²K of the first stage over all five coordinates."""
    p = plant.parameters
    full = plant.full.lower
    for i in range(5):
        for j in range(5):
            full[i, j] = 0.0
    full[0, 0] = joint_pivot(plant, 0, g)
    full[1, 1] = joint_pivot(plant, 1, g)
    full[2, 2] = p.mass + g * plant.drag[2]
    full[3, 3] = p.mass + g * plant.drag[3]
    full[4, 4] = p.inertia + g * plant.drag[4]
    for finger in range(2):
        tip = plant.stages[0].on_object[finger]
        for r in range(3):
            weight = g * (tip.damping[r] + g * tip.stiffness[r])
            if weight == 0.0:
                continue
            for i in range(4):
                at = finger if i == 0 else 1 + i
                by = weight * tip.rows[r, i]
                for j in range(4):
                    full[at, finger if j == 0 else 1 + j] += by * tip.rows[r, j]
    for number in range(EXTRA_ROWS):
        extra = plant.extra[number]
        weight = g * (extra.damping + g * extra.stiffness)
        if weight == 0.0:
            continue
        for i in range(5):
            by = weight * extra.row[i]
            for j in range(5):
                full[i, j] += by * extra.row[j]
    inverse = plant.full.inverse
    for k in range(5):
        if p.joints_held if k < 2 else p.object_held:
            for j in range(5):
                full[k, j] = 0.0
                full[j, k] = 0.0
            inverse[k] = 0.0
            continue
        pivot = full[k, k]
        inverse[k] = 1.0 / pivot
        for i in range(k + 1, 5):
            share = full[i, k] / pivot
            for j in range(k + 1, 5):
                full[i, j] -= share * full[k, j]
            full[i, k] = share


@inner_kernel
def solve_full(plant: Plant, k: Motion) -> None:
    """Solve for the load: the velocities of ``k``, those of held parts 0."""
    full, out = plant.full.lower, k.velocity
    for i in range(5):
        value = plant.load[i]
        for j in range(i):
            value -= full[i, j] * out[j]
        out[i] = value
    for i in range(5):
        out[i] *= plant.full.inverse[i]
    for i in range(4, -1, -1):
        for j in range(i + 1, 5):
            out[i] -= full[j, i] * out[j]


@inner_kernel
def along_extra(extra: ExtraRow, rates: FloatArray) -> float:
    """An extra row times the coordinates' ``rates``."""
    rate: float = 0.0
    for j in range(5):
        rate += extra.row[j] * rates[j]
    return rate


@inner_kernel
def take_extra_stiffness(plant: Plant, k: Motion, g: float) -> None:
    """Take g K r of the extra rows from the load; r are positions and extra shears of ``k``."""
    for number in range(EXTRA_ROWS):
        extra = plant.extra[number]
        if extra.stiffness == 0.0:
            continue
        shear = extra.shear
        rate = k.extra_shear[shear - 1] if shear > 0 else along_extra(extra, k.position)
        by = g * extra.stiffness * rate
        for j in range(5):
            plant.load[j] -= by * extra.row[j]


@inner_kernel
def add_extra_shears(plant: Plant, k: Motion, g: float) -> None:
    """Add what the solved velocities of ``k`` bring to its extra shears: g row·k."""
    for number in range(EXTRA_ROWS):
        extra = plant.extra[number]
        if extra.shear > 0 and extra.stiffness != 0.0:
            k.extra_shear[extra.shear - 1] += g * along_extra(extra, k.velocity)
