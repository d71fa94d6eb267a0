"""The step's linear equations where contacts couple more than the tips on the object do.

The usual scene is solved in `solver`, which knows its matrix's gaps. Where the object is on the
palm or the tips are on each other, the rows of layout.EXTRA join in, the matrix is full, and all of
it is here: assembled, factorised as L D Lᵀ and solved. Only kernels live here.
"""

from __future__ import annotations

from softfinger.daemon.simulation.physics import layout
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer

_INVERSE = layout.FULL + 25  # of the pivots


@inner_kernel
def factorise_full(memory: Pointer, pivots: tuple[float, float], g: float) -> None:
    """Factorise M + gD + g²K of stage 1 over all five coordinates; ``g`` = γh.

    ``pivots`` are the joints' own, with stops and motors.
    """
    full = layout.FULL
    for place in range(25):
        memory[full + place] = 0.0
    memory[full] = pivots[0]
    memory[full + 6] = pivots[1]
    memory[full + 12] = memory[layout.MASS] + g * memory[layout.DRAG + 2]
    memory[full + 18] = memory[layout.MASS] + g * memory[layout.DRAG + 3]
    memory[full + 24] = memory[layout.INERTIA] + g * memory[layout.DRAG + 4]
    for finger in range(2):
        row = layout.TIP + finger * layout.TIP_ROW
        for place, stiffness, damping in (
            (layout.JD, layout.K_D, layout.C_D),
            (layout.JTHETA, layout.K_THETA, layout.C_THETA),
            (layout.JT, layout.K_T, layout.C_T),
        ):
            weight = g * (memory[row + damping] + g * memory[row + stiffness])
            if weight == 0.0:
                continue
            for i in range(4):
                at = finger if i == 0 else 1 + i
                by = weight * memory[row + place + i]
                for j in range(4):
                    to = finger if j == 0 else 1 + j
                    memory[full + 5 * at + to] += by * memory[row + place + j]
    for extra in range(layout.EXTRA_ROWS):
        row = layout.EXTRA + extra * layout.EXTRA_ROW
        weight = g * (memory[row + 6] + g * memory[row + 5])
        if weight == 0.0:
            continue
        for i in range(5):
            by = weight * memory[row + i]
            for j in range(5):
                memory[full + 5 * i + j] += by * memory[row + j]
    for k in range(5):
        held = memory[layout.JOINTS_HELD] if k < 2 else memory[layout.OBJECT_HELD]
        if held != 0.0:
            for j in range(5):
                memory[full + 5 * k + j] = 0.0
                memory[full + 5 * j + k] = 0.0
            memory[_INVERSE + k] = 0.0
            continue
        pivot = memory[full + 6 * k]
        memory[_INVERSE + k] = 1.0 / pivot
        for i in range(k + 1, 5):
            share = memory[full + 5 * i + k] / pivot
            for j in range(k + 1, 5):
                memory[full + 5 * i + j] -= share * memory[full + 5 * k + j]
            memory[full + 5 * i + k] = share


@inner_kernel
def solve_full(memory: Pointer, out: int) -> None:
    """Solve the full matrix for the load; five results from ``out`` on, held parts 0."""
    full = layout.FULL
    for i in range(5):
        value = memory[layout.LOAD + i]
        for j in range(i):
            value -= memory[full + 5 * i + j] * memory[out + j]
        memory[out + i] = value
    for i in range(5):
        memory[out + i] *= memory[_INVERSE + i]
    for i in range(4, -1, -1):
        for j in range(i + 1, 5):
            memory[out + i] -= memory[full + 5 * j + i] * memory[out + j]


@inner_kernel
def extra_along(memory: Pointer, row: int, along: int) -> float:
    """An extra row times the coordinates' rates from ``along`` on."""
    rate: float = 0.0
    for j in range(5):
        rate += memory[row + j] * memory[along + j]
    return rate


@inner_kernel
def take_extra_stiffness(memory: Pointer, along: int, shears: int, g: float) -> None:
    """Take g K r of the extra rows from the load.

    r stands from ``along`` on, the six shears' from ``shears`` on.
    """
    for extra in range(layout.EXTRA_ROWS):
        row = layout.EXTRA + extra * layout.EXTRA_ROW
        if memory[row + 5] == 0.0:
            continue
        number = int(memory[row + 7])
        rate = memory[shears + number - 1] if number > 0 else extra_along(memory, row, along)
        by = g * memory[row + 5] * rate
        for j in range(5):
            memory[layout.LOAD + j] -= by * memory[row + j]


@inner_kernel
def add_extra_shears(memory: Pointer, along: int, shears: int, g: float) -> None:
    """Add what the solved k of velocity, from ``along`` on, brings to the shears' k: g row·k."""
    for extra in range(layout.EXTRA_ROWS):
        row = layout.EXTRA + extra * layout.EXTRA_ROW
        number = int(memory[row + 7])
        if number > 0 and memory[row + 5] != 0.0:
            memory[shears + number - 1] += g * extra_along(memory, row, along)


@inner_kernel
def clear_extra(memory: Pointer, first: int, last: int) -> None:
    """Take the extra rows from ``first`` to before ``last`` out of the matrix."""
    for extra in range(first, last):
        row = layout.EXTRA + extra * layout.EXTRA_ROW
        memory[row + 5] = 0.0
        memory[row + 6] = 0.0
