"""The plant's energy, and the rule that a step must not create any.

Where forces are smooth the method's error is small and falls with the step. Where they aren't, as
when the backing plate's stiff rim is hit by a light object, or where a step is far too long, a step
could leave more energy than there was and than the motors and pushes put in. It is then taken out
of the motion; when there isn't enough, the motion ends, at rest, where there is. Without
any losses, where the energy should stay, the method's own small drift is let be in smooth steps.
Only kernels live here.
"""

from __future__ import annotations

import math

from softfinger.daemon.simulation.physics import layout
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer

LOSSLESS_TOLERANCE = 1e-3  # of the energy, what smooth steps may gain in all without losses
_ROUNDING = 3e-13  # of the energy, for d comes from lengths that are much greater
HALVINGS = 12  # of a step that has to be shortened
_KEPT = 20  # places of the state that are kept: all before layout.STEPS


@inner_kernel
def kinetic(memory: Pointer) -> float:
    """Kinetic energy of joints and object [J]."""
    v = layout.VELOCITY
    joints = memory[v] ** 2 + memory[v + 1] ** 2
    moving = memory[v + 2] ** 2 + memory[v + 3] ** 2
    energy: float = 0.5 * (
        memory[layout.JOINT_INERTIA] * joints
        + memory[layout.MASS] * moving
        + memory[layout.INERTIA] * memory[v + 4] ** 2
    )
    return energy


@inner_kernel
def weight_energy(memory: Pointer) -> float:
    """Potential energy of the object's weight [J]."""
    energy: float = -memory[layout.MASS] * (
        memory[layout.GRAVITY] * memory[layout.POSITION + 2]
        + memory[layout.GRAVITY + 1] * memory[layout.POSITION + 3]
    )
    return energy


@inner_kernel
def elastic(memory: Pointer) -> float:
    """Energy of all contacts as last evaluated in stage 0, and of the end stops [J]."""
    energy: float = memory[layout.PALM_ENERGY]
    for finger in range(2):
        q = memory[layout.POSITION + finger]
        beyond = min(q - memory[layout.STOP_LOW + finger], 0.0)
        beyond += max(q - memory[layout.STOP_HIGH + finger], 0.0)
        energy += 0.5 * memory[layout.STOP_STIFFNESS] * beyond * beyond
        energy += memory[layout.TIP + finger * layout.TIP_ROW + layout.ENERGY]
        energy += memory[layout.MUTUAL + finger * layout.TIP_ROW + layout.ENERGY]
    return energy


@inner_kernel
def on_rim(memory: Pointer) -> bool:
    """Whether a backing plate's rim is pressed into something."""
    row = layout.TIP
    other = layout.MUTUAL
    depth = memory[row + layout.RIM] + memory[row + layout.TIP_ROW + layout.RIM]
    depth += memory[other + layout.RIM] + memory[other + layout.TIP_ROW + layout.RIM]
    return bool(depth > 0.0)


@inner_kernel
def open_ledger(memory: Pointer) -> None:
    """Start from the energy there is, unless it is the one that the last step left."""
    total = kinetic(memory) + elastic(memory) + weight_energy(memory)
    if total != memory[layout.TOTAL]:
        memory[layout.TOTAL] = total
        memory[layout.LEDGER] = total


@inner_kernel
def keep_earlier(memory: Pointer) -> None:
    """Remember the state before a step."""
    for place in range(_KEPT):
        memory[layout.EARLIER + place] = memory[place]


@inner_kernel
def work_done(memory: Pointer) -> float:
    """The most that motors and pushes can have put in since the state that was kept [J]."""
    work = 0.0
    for j in range(5):
        way = memory[layout.POSITION + j] - memory[layout.EARLIER + layout.POSITION + j]
        if j < 2:
            before = memory[layout.EARLIER + layout.CURRENT + j] * way
            now = memory[layout.CURRENT + j] * way
            work += memory[layout.TORQUE_CONSTANT] * max(before, now)
        else:
            work += memory[layout.PUSH + j - 2] * way
    return work


@inner_kernel
def balance_ledger(memory: Pointer, was_on_rim: bool) -> int:
    """Enter a step's energy, brought down to what it may be: 0 when it is, else what was changed.

    1: the motion was slowed. 2: it has too little energy to be slowed, and was ended; the step has
    to be shortened by :func:`shorten` until :func:`is_covered`. The changed state is to be
    evaluated again and entered by :func:`enter_changed`.
    """
    moving = kinetic(memory)
    weight = weight_energy(memory)
    total = moving + elastic(memory) + weight
    work = work_done(memory)
    limit = memory[layout.LEDGER] + work
    if was_on_rim or on_rim(memory):
        most = min(limit, memory[layout.TOTAL] + work)
    else:
        most = limit + memory[layout.TOLERANCE] * max(limit - weight, 0.0)
    if total <= most + _ROUNDING * (moving + abs(total) + abs(weight)):
        memory[layout.TOTAL] = total
        memory[layout.LEDGER] = min(total, limit)
        return 0
    memory[layout.GUARDED] += 1.0
    kept = moving - (total - most)
    share = math.sqrt(kept / moving) if kept > 0.0 else 0.0
    for j in range(5):
        memory[layout.VELOCITY + j] *= share
    return 1 if kept >= 0.0 else 2


@inner_kernel
def shorten(memory: Pointer, share: float) -> None:
    """Leave only ``share`` of the way and of the shears that the step brought."""
    for place in range(_KEPT):
        if (
            place < layout.VELOCITY
            or layout.SHEAR <= place < layout.CURRENT
            or place >= layout.PALM_SHEAR
        ):
            before = memory[layout.EARLIER + place]
            memory[place] = before + share * (memory[place] - before)


@inner_kernel
def is_covered(memory: Pointer) -> bool:
    """Whether a state at rest has no more energy than it may have."""
    total = elastic(memory) + weight_energy(memory)
    return bool(total <= memory[layout.LEDGER] + work_done(memory))


@inner_kernel
def enter_changed(memory: Pointer) -> None:
    """Enter the energy of a state that :func:`balance_ledger` changed."""
    total = kinetic(memory) + elastic(memory) + weight_energy(memory)
    memory[layout.TOTAL] = total
    memory[layout.LEDGER] = min(total, memory[layout.LEDGER] + work_done(memory))
