"""The linear equations of a step: factorised as L D Lᵀ, and solved. ``g`` is γh of `plant`.

In the usual scene only the tips touch the object: the joints are coupled only through it, so that
one 3 × 3 Schur complement is factorised. Where the object is on the palm or the tips are on each
other, the extra rows join in, and the matrix is full.
"""

from __future__ import annotations

from softfinger.daemon.simulation.physics.forces import stop_stiffness
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
    """Return the matrix's entry of a joint by itself: inertia, friction, stop and motor."""
    motor = plant.motor_by_rate[joint] + g * plant.motor_by_q[joint]
    pivot: float = plant.parameters.joint_inertia + g * (
        plant.drag[joint] + g * (stop_stiffness(plant, joint) + motor)
    )
    return pivot


@inner_kernel
def entry(tip: TipContact, i: int, j: int, g: float) -> float:
    """Return a tip's contribution to the matrix at its coordinates ``i`` and ``j``."""
    total = 0.0
    for r in range(3):
        weight = g * (tip.damping[r] + g * tip.stiffness[r])
        total += weight * tip.rows[r, i] * tip.rows[r, j]
    return total


@inner_kernel
def factorise(plant: Plant, g: float) -> None:
    """Factorise M + gD + g²K of the first stage."""
    p, factors = plant.parameters, plant.factors
    a = p.mass + g * plant.drag[2]
    b = 0.0
    c = p.mass + g * plant.drag[3]
    d = 0.0
    e = 0.0
    f = p.inertia + g * plant.drag[4]
    for finger in range(2):
        tip = plant.stages[0].on_object[finger]
        pivot = joint_pivot(plant, finger, g) + entry(tip, 0, 0, g)
        inverse = 0.0 if p.joints_held else 1.0 / pivot
        u0 = entry(tip, 0, 1, g)
        u1 = entry(tip, 0, 2, g)
        u2 = entry(tip, 0, 3, g)
        factors.joint[finger] = inverse
        factors.coupling[finger, 0] = u0
        factors.coupling[finger, 1] = u1
        factors.coupling[finger, 2] = u2
        a += entry(tip, 1, 1, g) - u0 * u0 * inverse
        b += entry(tip, 1, 2, g) - u0 * u1 * inverse
        c += entry(tip, 2, 2, g) - u1 * u1 * inverse
        d += entry(tip, 1, 3, g) - u0 * u2 * inverse
        e += entry(tip, 2, 3, g) - u1 * u2 * inverse
        f += entry(tip, 3, 3, g) - u2 * u2 * inverse
    free = 0.0 if p.object_held else 1.0
    first = 1.0 / a
    factors.l10 = b * first
    factors.l20 = d * first
    second = 1.0 / (c - factors.l10 * b)
    remainder = e - factors.l10 * d
    factors.l21 = remainder * second
    factors.pivot[0] = free * first
    factors.pivot[1] = free * second
    factors.pivot[2] = free / (f - factors.l20 * d - factors.l21 * remainder)


@inner_kernel
def solve(plant: Plant, k: Motion) -> None:
    """Solve for the load: the velocities of ``k``, those of held parts 0."""
    load, factors, out = plant.load, plant.factors, k.velocity
    joint, coupling, pivot = factors.joint, factors.coupling, factors.pivot
    r0 = load[0] * joint[0]
    r1 = load[1] * joint[1]
    b0 = load[2] - coupling[0, 0] * r0 - coupling[1, 0] * r1
    b1 = load[3] - coupling[0, 1] * r0 - coupling[1, 1] * r1
    b2 = load[4] - coupling[0, 2] * r0 - coupling[1, 2] * r1
    b1 -= factors.l10 * b0
    b2 -= factors.l20 * b0 + factors.l21 * b1
    z2 = b2 * pivot[2]
    z1 = b1 * pivot[1] - factors.l21 * z2
    z0 = b0 * pivot[0] - factors.l10 * z1 - factors.l20 * z2
    out[0] = r0 - joint[0] * (coupling[0, 0] * z0 + coupling[0, 1] * z1 + coupling[0, 2] * z2)
    out[1] = r1 - joint[1] * (coupling[1, 0] * z0 + coupling[1, 1] * z1 + coupling[1, 2] * z2)
    out[2] = z0
    out[3] = z1
    out[4] = z2


@inner_kernel
def along_row(tip: TipContact, r: int, finger: int, rates: FloatArray) -> float:
    """Return a tip's row ``r`` times the coordinates' ``rates``."""
    rate: float = (
        tip.rows[r, 0] * rates[finger]
        + tip.rows[r, 1] * rates[2]
        + tip.rows[r, 2] * rates[3]
        + tip.rows[r, 3] * rates[4]
    )
    return rate


@inner_kernel
def take_stiffness(plant: Plant, k: Motion, g: float) -> None:
    """Take g K r from the load, with K of the first stage; r are positions and shears of ``k``."""
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


# --- with the extra rows -------------------------------------------------------------------------


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
            ratio = full[i, k] / pivot
            for j in range(k + 1, 5):
                full[i, j] -= ratio * full[k, j]
            full[i, k] = ratio


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
    """Return an extra row times the coordinates' ``rates``."""
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
