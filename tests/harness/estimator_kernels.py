"""Steps of the estimator as tests call them: inner kernels behind a kernel that Python may call."""

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.layout import Records
from softfinger.kinematics.compiled.simd import address
from softfinger.kinematics.estimation import detection, likelihood
from softfinger.kinematics.estimation.state import PLANES, EstimatorState

FloatArray = NDArray[np.float64]


def state_for(packed: FloatArray) -> EstimatorState:
    """A state whose model has as many cells as ``packed`` [PLANES, n], all of them packed."""
    assert len(packed) == PLANES
    state = EstimatorState()
    state.model.rows, state.model.cols = 1, packed.shape[1]
    state.fit.count = packed.shape[1]
    return state


@kernel
def activity(states: Records[EstimatorState], frame: FloatArray, centres: FloatArray) -> None:
    """:func:`detection.activity`."""
    detection.activity(states[0], address(frame), address(centres))


@kernel
def press_and_accumulate(states: Records[EstimatorState], packed: FloatArray) -> None:
    """:func:`likelihood.compress`, then :func:`likelihood.accumulate`."""
    likelihood.compress(states[0], address(packed))
    likelihood.accumulate(states[0], address(packed))
