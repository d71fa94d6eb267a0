"""What the tips of the simulated hand feel: recorded with the state, and sampled at the frames'.

Only kernels live here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.simulation.physics import layout
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.simd import Pointer

FloatArray = NDArray[np.float64]


@inner_kernel
def felt_row(memory: Pointer, finger: int) -> int:
    """The row of what a tip feels: of object and other tip the one that presses more."""
    row = layout.TIP + finger * layout.TIP_ROW
    if memory[layout.MUTUAL_NEAR] != 0.0:
        other = layout.MUTUAL + finger * layout.TIP_ROW
        if (
            memory[layout.SHAPE] == layout.NO_OBJECT
            or memory[other + layout.FORCE] > memory[row + layout.FORCE]
        ):
            return other
    return row


@inner_kernel
def sample(memory: Pointer, ring: FloatArray) -> None:
    """Write the sample that is due into ``ring``, between the recorded tips and stage 1's."""
    h = memory[layout.STEP]
    number = memory[layout.SAMPLES]
    due = number * memory[layout.SAMPLE_PERIOD]
    back = min((memory[layout.STEPS] * h - due) / h, 1.0)
    at = int(number) % ring.shape[0]
    ring[at, layout.SAMPLE_SEQ] = number
    ring[at, layout.SAMPLE_T] = due
    for finger in range(2):
        row = felt_row(memory, finger)
        # Between what is touched before and after there is nothing to interpolate.
        same = (row >= layout.MUTUAL) == (memory[layout.CONTACT_MUTUAL + finger] != 0.0)
        share = back if same else 0.0
        for place, before, now in (
            (layout.SAMPLE_D, layout.CONTACT_D, layout.D),
            (layout.SAMPLE_THETA, layout.CONTACT_THETA, layout.THETA),
            (layout.SAMPLE_GAIN, layout.CONTACT_GAIN, layout.GAIN),
        ):
            change = memory[row + now] - memory[before + finger]
            ring[at, place + finger] = memory[row + now] - share * change
        ring[at, layout.SAMPLE_BEND + finger] = memory[row + layout.BEND]
    memory[layout.SAMPLES] = number + 1.0


@inner_kernel
def settle(memory: Pointer, ring: FloatArray) -> None:
    """Take the samples that fall due at the state's instant, then record what the tips feel."""
    while (
        memory[layout.SAMPLES] * memory[layout.SAMPLE_PERIOD]
        <= memory[layout.STEPS] * memory[layout.STEP]
    ):
        sample(memory, ring)
    for finger in range(2):
        on_object = layout.TIP + finger * layout.TIP_ROW
        memory[layout.SHEAR + finger] = memory[on_object + layout.TIP_SHEAR]
        if memory[layout.MUTUAL_NEAR] != 0.0:
            other = layout.MUTUAL + finger * layout.TIP_ROW
            memory[layout.MUTUAL_SHEAR + finger] = memory[other + layout.TIP_SHEAR]
        row = felt_row(memory, finger)
        memory[layout.CONTACT_D + finger] = memory[row + layout.D]
        memory[layout.CONTACT_THETA + finger] = memory[row + layout.THETA]
        memory[layout.CONTACT_GAIN + finger] = memory[row + layout.GAIN]
        memory[layout.CONTACT_FORCE + finger] = memory[row + layout.FORCE]
        memory[layout.CONTACT_NORMAL + finger] = memory[row + layout.NORMAL]
        memory[layout.CONTACT_TANGENTIAL + finger] = memory[row + layout.TANGENTIAL]
        memory[layout.CONTACT_RIM + finger] = memory[row + layout.RIM]
        memory[layout.CONTACT_BEND + finger] = memory[row + layout.BEND]
        memory[layout.CONTACT_MUTUAL + finger] = 1.0 if row >= layout.MUTUAL else 0.0
