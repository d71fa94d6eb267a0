"""Faint contacts that are seen, and contacts that are seen where nothing presses.

The contact test takes a cell above ``peak_level`` standard deviations whose neighbours' weighted
mean, itself left out, is above ``patch_level``. In white noise both are independent, so that the
expected number of such cells in a frame, which bounds the chance of one from above, is

    cells · P(cell > peak_level) · P(neighbours > patch_level).

For frames that can go below zero both are Gaussian tails. For counts the neighbours' sum is a sum
of independent rounded, clipped and thresholded variables: its distribution is the convolution of
theirs on the counts' own lattice; it is skewed, so that the estimator asks ``CLIPPED_MORE`` more of
counts. Sampled frames check the figure where a lower patch_level makes alarms frequent enough.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.simulation.sensor.sensor_model import Board
from softfinger.kinematics.estimation.estimator import PATCH_LEVEL, PEAK_LEVEL, ContactEstimator
from softfinger.kinematics.estimation.frame_pipeline import CLIPPED_MORE
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.benchmarks.campaigns import accuracy_trials as trials
from softfinger.tools.benchmarks.campaigns.accuracy_trials import (
    EIGHT_BITS,
    LINEAR,
    MODULUS,
    PITCH,
    SIXTEEN_BITS,
    SIZE,
    TIP,
)
from softfinger.tools.benchmarks.framework.campaign import upper_bound
from softfinger.tools.benchmarks.framework.report import Report, Row

FloatArray = NDArray[np.float64]

FAINT = 0.0002  # m
NOISE = 0.002 * MODULUS
_BOARDS: dict[str, Board | None] = {
    "float": None,
    "16 bits of 4 Pa": SIXTEEN_BITS,
    "8 bits of 800 Pa, 3 sent": EIGHT_BITS,
}
# Noise-only frames need the tip's disc and two cells more, no whole sensor.
_SMALL = 36
_WEIGHTS = np.outer((1.0, 2.0, 2.0, 2.0, 1.0), (1.0, 2.0, 2.0, 2.0, 1.0))
_WEIGHTS[2, 2] = 0.0
_ROOT = math.sqrt(float(np.sum(_WEIGHTS**2)))
_BATCH = 500


def detection(around: int, frames: int, again_frames: int, seed: int = 11) -> list[Report]:
    """d = 0.2 mm at 0.2 % noise, over tilts, azimuths and offsets, as floats and as counts."""
    rows = []
    places = list(trials.places((FAINT,), (0.0, 7.5, 15.0, 22.5, 30.0), around))
    for name, board in list(_BOARDS.items())[:2]:
        random = np.random.default_rng(seed)
        missed = [_missed(place, frames, random, board) for place in places]
        worst = [places[k] for k in np.argsort(missed)[-3:]]
        again = max(_missed(place, again_frames, random, board) for place in worst)
        rows.append(
            {
                "name": name,
                "frames": frames * len(places),
                "seen": 1.0 - sum(missed) / (frames * len(places)),
                "95 % above": 1.0 - upper_bound(sum(missed), frames * len(places)),
                "worst contact": 1.0 - again / again_frames,
                "frames of it": again_frames,
                "aim ≥": 0.999,
            }
        )
    return [Report("share of d = 0.2 mm at 0.2 % noise that is seen", rows)]


def _missed(
    place: trials.Place, frames: int, random: np.random.Generator, board: Board | None
) -> int:
    made = trials.estimator(place, NOISE, True, board, method="moments")
    clean = place.grid.pressure(TIP, LINEAR, *place.truth[:3])
    missed = 0
    for first in range(0, frames, _BATCH):
        bank = random.standard_normal((min(_BATCH, frames - first), SIZE, SIZE))
        found = trials.run(made, clean, NOISE, bank, board)
        missed += len(bank) - int(found[:, trials.CONTACT].sum())
    return missed


def false_alarms(frames: int) -> list[Report]:
    """The default level on every board, and lower ones to check the computed figure."""
    rows = []
    levels = (2.5, 3.0, 3.5, 4.0, PATCH_LEVEL)
    for name, board in list(_BOARDS.items())[:2]:
        for level, count in zip(levels, sampled(levels, frames, NOISE, board), strict=True):
            row = _alarm_row(name, board, NOISE, level)
            row |= {"sampled": count / frames, "95 % below": upper_bound(count, frames)}
            rows.append(row | {"frames": frames})
    # Counts at other noises: how much of it rounding and the threshold leave differs.
    for name, board in list(_BOARDS.items())[1:]:
        for noise in trials.NOISES:
            if not (board is SIXTEEN_BITS and noise == NOISE):
                rows.append(_alarm_row(name, board, noise, PATCH_LEVEL))
    return [Report("alarms a frame of noise alone", rows)]


def _alarm_row(name: str, board: Board | None, noise: float, level: float) -> Row:
    return {
        "name": name,
        "noise Pa": noise,
        "level": level + (CLIPPED_MORE if board is not None else 0.0),
        "computed": expected_alarms(noise, board, level),
        "aim ≤": 1e-6 if level == PATCH_LEVEL else None,
    }


def disc(size: int = _SMALL) -> NDArray[np.bool_]:
    """Cells that the tip's disc touches: those that may raise an alarm."""
    edge = (np.arange(size + 1) - 0.5 * size) * PITCH
    nearest = np.where(edge[:-1] * edge[1:] <= 0.0, 0.0, np.minimum(abs(edge[:-1]), abs(edge[1:])))
    return np.asarray(np.hypot(nearest[:, None], nearest) < TIP.radius)


def gaussian_tail(level: float) -> float:
    """P(a standard normal number > level)."""
    return 0.5 * math.erfc(level / math.sqrt(2.0))


def expected_alarms(
    noise: float, board: Board | None = None, patch_level: float = PATCH_LEVEL
) -> float:
    """Expected number of cells a frame that pass the contact test in noise alone.

    ``patch_level`` is the estimator's argument.
    """
    cells = int(disc().sum())
    if board is None:
        return cells * gaussian_tail(PEAK_LEVEL) * gaussian_tail(patch_level)
    scale = board.pascal_per_count
    deviation = math.sqrt(noise**2 + scale**2 / 12.0) / scale  # counts, as the estimator has it
    one = count_distribution(noise / scale, board)
    cell = float(np.sum(one[math.floor(PEAK_LEVEL * deviation) + 1 :]))
    total = neighbours_distribution(one)
    first = math.floor((patch_level + CLIPPED_MORE) * deviation * _ROOT) + 1
    return cells * cell * float(np.sum(np.maximum(total[first:], 0.0)))


def count_distribution(noise: float, board: Board) -> FloatArray:
    """P(count = k) of a cell that nothing presses, ``noise`` in counts."""
    last = min(math.ceil(9.0 * noise) + 1, board.full_count)
    above = np.array([gaussian_tail((k - 0.5) / noise) for k in range(last + 2)])
    one = above[:-1] - above[1:]
    one[: max(board.threshold, 1)] = 0.0
    one[0] = 1.0 - above[max(board.threshold, 1)]
    return np.asarray(one)


def neighbours_distribution(one: FloatArray) -> FloatArray:
    """P(Σ weight · count = k) over the neighbourhood of independent cells, each as ``one``."""
    weights = _WEIGHTS[_WEIGHTS > 0.0].astype(int)
    size = 1 << int(np.ceil(np.log2(weights.sum() * (len(one) - 1) + 1)))
    spectrum = np.ones(size // 2 + 1, dtype=complex)
    for weight in np.unique(weights):
        spread = np.zeros(size)
        spread[: weight * len(one) : weight][: len(one)] = one
        spectrum *= np.fft.rfft(spread) ** int(np.count_nonzero(weights == weight))
    return np.asarray(np.fft.irfft(spectrum, size))


def sampled(
    levels: tuple[float, ...], frames: int, noise: float, board: Board | None = None, seed: int = 17
) -> list[int]:
    """Frames of noise alone, of ``frames``, that the estimator takes for a contact, by level."""
    random = np.random.default_rng(seed)
    grid = SensorGrid(_SMALL, _SMALL, PITCH)
    made = []
    for level in levels:
        ends = trials.readings(board)
        made.append(ContactEstimator(TIP, LINEAR, grid, noise, method="moments", readings=ends))
        made[-1].state.options.patch_level = level
    nothing = np.zeros(grid.shape)
    alarms = [0] * len(levels)
    for first in range(0, frames, _BATCH):
        bank = random.standard_normal((min(_BATCH, frames - first), _SMALL, _SMALL))
        for k, each in enumerate(made):
            found = trials.run(each, nothing, noise, bank, board)
            alarms[k] += int(found[:, trials.CONTACT].sum())
    return alarms
