"""The linear equations of a step in the usual scene, where only the tips touch the object.

The joints are coupled only through the object, so that one 3 × 3 Schur complement is factorised;
`coupled` has the full matrix. Only kernels live here.
"""

from __future__ import annotations

from softfinger.daemon.simulation.physics import layout
from softfinger.daemon.simulation.physics.forces import stop_stiffness
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer


@inner_kernel
def joint_pivot(memory: Pointer, joint: int, g: float) -> float:
    """The matrix's entry of a joint by itself: inertia, friction, stop and motor."""
    motor = memory[layout.MOTOR + 2 + joint] + g * memory[layout.MOTOR + joint]
    pivot: float = memory[layout.JOINT_INERTIA] + g * (
        memory[layout.DRAG + joint] + g * (stop_stiffness(memory, joint) + motor)
    )
    return pivot


@inner_kernel
def factorise(memory: Pointer, g: float) -> None:
    """Factorise M + gD + g²K of stage 1 into the matrix; ``g`` = γh.

    Places 0, 1: inverse joint pivots; 2-4 and 5-7: the joints' couplings to (x, y, φ); 8-13: the
    object's 3 × 3 Schur complement as L D Lᵀ (inverse d0, l10, l20, inverse d1, l21, inverse d2).
    """
    a = memory[layout.MASS] + g * memory[layout.DRAG + 2]
    b = 0.0
    c = memory[layout.MASS] + g * memory[layout.DRAG + 3]
    d = 0.0
    e = 0.0
    f = memory[layout.INERTIA] + g * memory[layout.DRAG + 4]
    for finger in range(2):
        row = layout.TIP + finger * layout.TIP_ROW
        w_d = g * (memory[row + layout.C_D] + g * memory[row + layout.K_D])
        w_r = g * (memory[row + layout.C_THETA] + g * memory[row + layout.K_THETA])
        w_t = g * (memory[row + layout.C_T] + g * memory[row + layout.K_T])
        d0 = memory[row + layout.JD]
        d1 = memory[row + layout.JD + 1]
        d2 = memory[row + layout.JD + 2]
        d3 = memory[row + layout.JD + 3]
        r0 = memory[row + layout.JTHETA]
        r1 = memory[row + layout.JTHETA + 1]
        r2 = memory[row + layout.JTHETA + 2]
        r3 = memory[row + layout.JTHETA + 3]
        t0 = memory[row + layout.JT]
        t1 = memory[row + layout.JT + 1]
        t2 = memory[row + layout.JT + 2]
        t3 = memory[row + layout.JT + 3]
        pivot = joint_pivot(memory, finger, g)
        pivot += w_d * d0 * d0 + w_r * r0 * r0 + w_t * t0 * t0
        inverse = 0.0 if memory[layout.JOINTS_HELD] != 0.0 else 1.0 / pivot
        u0 = w_d * d0 * d1 + w_r * r0 * r1 + w_t * t0 * t1
        u1 = w_d * d0 * d2 + w_r * r0 * r2 + w_t * t0 * t2
        u2 = w_d * d0 * d3 + w_r * r0 * r3 + w_t * t0 * t3
        memory[layout.MATRIX + finger] = inverse
        memory[layout.MATRIX + 2 + 3 * finger] = u0
        memory[layout.MATRIX + 3 + 3 * finger] = u1
        memory[layout.MATRIX + 4 + 3 * finger] = u2
        a += w_d * d1 * d1 + w_r * r1 * r1 + w_t * t1 * t1 - u0 * u0 * inverse
        b += w_d * d1 * d2 + w_r * r1 * r2 + w_t * t1 * t2 - u0 * u1 * inverse
        c += w_d * d2 * d2 + w_r * r2 * r2 + w_t * t2 * t2 - u1 * u1 * inverse
        d += w_d * d1 * d3 + w_r * r1 * r3 + w_t * t1 * t3 - u0 * u2 * inverse
        e += w_d * d2 * d3 + w_r * r2 * r3 + w_t * t2 * t3 - u1 * u2 * inverse
        f += w_d * d3 * d3 + w_r * r3 * r3 + w_t * t3 * t3 - u2 * u2 * inverse
    free = 0.0 if memory[layout.OBJECT_HELD] != 0.0 else 1.0
    first = 1.0 / a
    l10 = b * first
    l20 = d * first
    second = 1.0 / (c - l10 * b)
    rest = e - l10 * d
    l21 = rest * second
    memory[layout.MATRIX + 8] = free * first
    memory[layout.MATRIX + 9] = l10
    memory[layout.MATRIX + 10] = l20
    memory[layout.MATRIX + 11] = free * second
    memory[layout.MATRIX + 12] = l21
    memory[layout.MATRIX + 13] = free / (f - l20 * d - l21 * rest)


@inner_kernel
def solve(memory: Pointer, out: int) -> None:
    """Solve the factorised matrix for the load; five results from ``out`` on, held parts 0."""
    m = layout.MATRIX
    r0 = memory[layout.LOAD] * memory[m]
    r1 = memory[layout.LOAD + 1] * memory[m + 1]
    b0 = memory[layout.LOAD + 2] - memory[m + 2] * r0 - memory[m + 5] * r1
    b1 = memory[layout.LOAD + 3] - memory[m + 3] * r0 - memory[m + 6] * r1
    b2 = memory[layout.LOAD + 4] - memory[m + 4] * r0 - memory[m + 7] * r1
    b1 -= memory[m + 9] * b0
    b2 -= memory[m + 10] * b0 + memory[m + 12] * b1
    z2 = b2 * memory[m + 13]
    z1 = b1 * memory[m + 11] - memory[m + 12] * z2
    z0 = b0 * memory[m + 8] - memory[m + 9] * z1 - memory[m + 10] * z2
    memory[out] = r0 - memory[m] * (memory[m + 2] * z0 + memory[m + 3] * z1 + memory[m + 4] * z2)
    memory[out + 1] = r1 - memory[m + 1] * (
        memory[m + 5] * z0 + memory[m + 6] * z1 + memory[m + 7] * z2
    )
    memory[out + 2] = z0
    memory[out + 3] = z1
    memory[out + 4] = z2


@inner_kernel
def row_along(memory: Pointer, row: int, finger: int, along: int) -> float:
    """A tip's row over (q, x, y, φ) times the coordinates' rates from ``along`` on."""
    rate: float = (
        memory[row] * memory[along + finger]
        + memory[row + 1] * memory[along + 2]
        + memory[row + 2] * memory[along + 3]
        + memory[row + 3] * memory[along + 4]
    )
    return rate


@inner_kernel
def take_stiffness(memory: Pointer, along: int, shear1: float, shear2: float, g: float) -> None:
    """Take g K r from the load, K of stage 1; r stands from ``along`` on, then both shears."""
    for finger in range(2):
        row = layout.TIP + finger * layout.TIP_ROW
        at_d = row + layout.JD
        at_r = row + layout.JTHETA
        at_t = row + layout.JT
        by_d = g * memory[row + layout.K_D] * row_along(memory, at_d, finger, along)
        by_r = g * memory[row + layout.K_THETA] * row_along(memory, at_r, finger, along)
        by_t = g * memory[row + layout.K_T] * (shear1 if finger == 0 else shear2)
        memory[layout.LOAD + finger] -= (
            memory[at_d] * by_d + memory[at_r] * by_r + memory[at_t] * by_t
        )
        for j in range(1, 4):
            memory[layout.LOAD + 1 + j] -= (
                memory[at_d + j] * by_d + memory[at_r + j] * by_r + memory[at_t + j] * by_t
            )


@inner_kernel
def shear_along(memory: Pointer, finger: int, along: int) -> float:
    """Rate of a tip's d_t by stage 1's row for the coordinates' rates from ``along`` on."""
    row = layout.TIP + finger * layout.TIP_ROW + layout.JT
    return row_along(memory, row, finger, along)
