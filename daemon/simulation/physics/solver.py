"""Solve the linear equations of a step by L D Lᵀ factorisation.

``g`` is the product γh that `plant` defines.

The matrix always includes the contacts between the tips and the object. Palm contacts and
tip-to-tip contacts add extra rows.
"""

from __future__ import annotations

from softfinger.daemon.simulation.physics.forces import joint_stiffness
from softfinger.daemon.simulation.physics.plant_state import (
    ALONG_D,
    ALONG_SHEAR,
    ALONG_THETA,
    EXTRA_ROWS,
    ExtraRow,
    FloatArray,
    Motion,
    Plant,
    TipContact,
)
from softfinger.kinematics.compiled.kernel import inner_kernel


@inner_kernel
def joint_pivot(plant: Plant, joint: int, g: float) -> float:
    """Return a joint's diagonal entry in the step matrix."""
    motor = plant.motor_by_rate[joint] + g * plant.motor_by_q[joint]
    pivot: float = plant.parameters.joint_inertia + g * (
        plant.drag[joint] + g * (joint_stiffness(plant, joint) + motor)
    )
    return pivot


@inner_kernel
def along_row(tip: TipContact, r: int, finger: int, rates: FloatArray) -> float:
    """Return the scalar product of a tip's row ``r`` and the ``rates`` of the coordinates."""
    rate: float = (
        tip.rows[r, 0] * rates[finger]
        + tip.rows[r, 1] * rates[2]
        + tip.rows[r, 2] * rates[3]
        + tip.rows[r, 3] * rates[4]
    )
    return rate


@inner_kernel
def take_stiffness(plant: Plant, k: Motion, g: float) -> None:
    """Subtract g K r from the load. K is the first-stage stiffness; r are the rates in ``k``."""
    for finger in range(2):
        tip = plant.stages[0].on_object[finger]
        rows, stiffness = tip.rows, tip.stiffness
        by_d = g * stiffness[ALONG_D] * along_row(tip, ALONG_D, finger, k.position)
        by_r = g * stiffness[ALONG_THETA] * along_row(tip, ALONG_THETA, finger, k.position)
        by_t = g * stiffness[ALONG_SHEAR] * k.shear[finger]
        for j in range(4):
            plant.load[finger if j == 0 else 1 + j] -= (
                rows[ALONG_D, j] * by_d + rows[ALONG_THETA, j] * by_r + rows[ALONG_SHEAR, j] * by_t
            )


@inner_kernel
def factorise(plant: Plant, g: float) -> None:
    """Factorise the first-stage matrix M + gD + g²K for the five coordinates."""
    p = plant.parameters
    full = plant.factors
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
    for number in range(EXTRA_ROWS if plant.has_extra_rows else 0):
        extra = plant.extra[number]
        weight = g * (extra.damping + g * extra.stiffness)
        if weight == 0.0:
            continue
        for i in range(5):
            by = weight * extra.row[i]
            for j in range(5):
                full[i, j] += by * extra.row[j]
    for k in range(5):
        if p.joints_held if k < 2 else p.object_held:
            for j in range(5):
                full[k, j] = 0.0
                full[j, k] = 0.0
            continue
        pivot = full[k, k]
        for i in range(k + 1, 5):
            ratio = full[i, k] / pivot
            for j in range(k + 1, 5):
                full[i, j] -= ratio * full[k, j]
            full[i, k] = ratio
        full[k, k] = 1.0 / pivot


@inner_kernel
def solve(plant: Plant, k: Motion) -> None:
    """Solve the step equations for the velocities in ``k``, which are 0 for fixed bodies."""
    full, out = plant.factors, k.velocity
    for i in range(5):
        value = plant.load[i]
        for j in range(i):
            value -= full[i, j] * out[j]
        out[i] = value
    for i in range(5):
        out[i] *= full[i, i]
    for i in range(4, -1, -1):
        for j in range(i + 1, 5):
            out[i] -= full[j, i] * out[j]


@inner_kernel
def along_extra(extra: ExtraRow, rates: FloatArray) -> float:
    """Return the scalar product of an extra row and the ``rates`` of the coordinates."""
    rate: float = 0.0
    for j in range(5):
        rate += extra.row[j] * rates[j]
    return rate


@inner_kernel
def take_extra_stiffness(plant: Plant, k: Motion, g: float) -> None:
    """Subtract the extra rows' g K r from the load; r are the rates in ``k``."""
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
    """Add the contribution of the solved velocities to the extra shear rates in ``k``."""
    for number in range(EXTRA_ROWS):
        extra = plant.extra[number]
        if extra.shear > 0 and extra.stiffness != 0.0:
            k.extra_shear[extra.shear - 1] += g * along_extra(extra, k.velocity)
