"""The covariance carries what frames don't show: errors are as large as it says, in each case."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.error_budget import Uncertainty
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.kinematics.sensing.solid_pressure import SolidPressure
from tests.harness.paper_tip import LINEAR, NOISE, PITCH, TIP

PLACE = (2e-4, -5e-4)
GRID = SensorGrid(44, 44, PITCH, PLACE)
LENGTH = 1.5  # cells over which the noise is correlated
LAGS = np.arange(8.0)
CORRELATION = np.exp(-(LAGS[:, None] ** 2 + LAGS**2) / (2.0 * LENGTH**2))
SMOOTH = np.exp(-((np.arange(58) - np.arange(7, 51)[:, None]) ** 2) / LENGTH**2)
SMOOTH /= np.sqrt((SMOOTH[20] ** 2).sum())

SPRINGS, SOLID = TIP, Fingertip(0.020, "solid", 0.49, "lying")
CASES = {
    "correlated": Uncertainty(correlation=CORRELATION),
    "baseline": Uncertainty(baseline=1000.0),
    "centre": Uncertainty(centre=5e-4),
    "pitch": Uncertainty(pitch=0.01),
    "modulus": Uncertainty(modulus=0.05),
    "all": Uncertainty(baseline=1000.0, centre=5e-4, correlation=CORRELATION),
}


def correlated_noise(rng: np.random.Generator) -> np.ndarray:
    return SMOOTH @ rng.normal(0.0, NOISE, (44 + 14, 44 + 14)) @ SMOOTH.T


def white(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(0.0, NOISE, GRID.shape)


def clean(truth: tuple[float, float, float], _: np.random.Generator) -> np.ndarray:
    return GRID.pressure(TIP, LINEAR, *truth)


def really(known: Uncertainty) -> list[SensorGrid]:
    """Sensors whose places or pitches have the standard deviation that is known, one by one."""
    turns = np.arange(8) * 0.25 * math.pi + 0.1
    if known.centre:
        off = [(7.07e-4 * math.cos(turn), 7.07e-4 * math.sin(turn)) for turn in turns]
        return [replace(GRID, centre=(PLACE[0] + x, PLACE[1] + y)) for x, y in off]
    return [
        replace(GRID, pitch=PITCH * share, centre=(PLACE[0] * share, PLACE[1] * share))
        for share in ((1.0 - known.pitch, 1.0 + known.pitch) if known.pitch else (1.0,))
    ]


def nees(tip: Fingertip, case: str, told: bool, d: float, theta: float) -> tuple[float, float]:
    """Mean normalised square of the estimates' errors, a parameter; share of valid ones.

    A solid tip's face is sheared, too.
    """
    known = CASES[case]
    truth = np.array([d, theta, -0.5 * theta])
    free = tip is SPRINGS and not known.modulus
    given = known if told else None
    estimator = ContactEstimator(tip, LINEAR, GRID, NOISE, free_gain=free, known=given)
    grids, out = really(known), np.empty(GRID.shape)
    press = [SolidPressure(tip, LINEAR, grid.images(tip)) for grid in grids if tip is SOLID]
    rng, squares, frames = np.random.default_rng(12), [], 96 if tip is SOLID else 192
    for k in range(frames):
        gain = 1.0 + rng.normal(0.0, known.modulus)
        if tip is SOLID:
            shear = tuple(rng.normal(0.0, 0.1, 2))
            press[k % len(press)]((d, *np.sin(truth[1:])), gain, out, shear)
        else:
            grids[k % len(grids)].pressure(tip, LINEAR, *truth, gain=gain, out=out)
        noise = white(rng) if known.correlation is None else correlated_noise(rng)
        e = estimator(out + noise + rng.normal(0.0, known.baseline))
        if e.contact and e.valid and not e.misfit:
            n = 4 if free else 3  # with the gain
            error = (np.array([e.d, e.tilt_x, e.tilt_y, e.gain]) - [*truth, 1.0])[:n]
            squares.append(error @ np.linalg.solve(e.covariance[:n, :n], error) / n)
    return float(np.mean(squares)), len(squares) / frames


@pytest.mark.usefixtures("exact_solid_data")
@pytest.mark.parametrize(("d", "theta"), [(0.001, 0.0), (0.002, 0.4), (0.006, 0.2)])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("tip", [SPRINGS, SOLID], ids=lambda tip: tip.physics)
def test_the_errors_are_as_large_as_the_covariance_says(
    tip: Fingertip, case: str, d: float, theta: float
) -> None:
    score, valid = nees(tip, case, True, d, theta)
    low, high = (0.7, 1.35) if tip is SOLID else (0.8, 1.3)
    assert low < score < high
    assert valid > (0.83 if tip is SOLID else 0.9)


@pytest.mark.parametrize("case", CASES)
def test_without_it_they_are_not(case: str) -> None:
    assert nees(SPRINGS, case, False, 0.002, 0.35)[0] > 5.0


def test_what_frames_share_is_told_apart_and_nothing_known_adds_nothing() -> None:
    frame = clean((0.003, 0.2, 0.0), np.random.default_rng(0))
    plain = ContactEstimator(TIP, LINEAR, GRID, NOISE)(frame)
    assert not plain.systematic.any()
    shifted = ContactEstimator(TIP, LINEAR, GRID, NOISE, known=Uncertainty(centre=5e-4))(frame)
    assert (shifted.d, shifted.tilt_x, shifted.gain) == (plain.d, plain.tilt_x, plain.gain)
    np.testing.assert_allclose(shifted.covariance - shifted.systematic, plain.covariance, rtol=1e-3)
    # The tip's place is taken for a turn about the tip's centre.
    assert math.sqrt(shifted.systematic[2, 2]) == pytest.approx(5e-4 / 0.019, rel=0.05)


def test_correlated_noise_raises_no_alarm_and_no_misfit() -> None:
    estimator = ContactEstimator(
        TIP, LINEAR, GRID, NOISE, known=Uncertainty(correlation=CORRELATION)
    )
    rng = np.random.default_rng(2)
    for _ in range(300):
        assert not estimator.update(correlated_noise(rng)).contact
        assert not estimator.update(clean((0.003, 0.1, 0.0), rng) + correlated_noise(rng)).misfit


def test_a_law_off_its_points_widens_what_it_says() -> None:
    strain = np.linspace(0.025, 1.0, 40)
    law = Material.from_points(strain, 1e5 * np.where(strain < 0.3, strain, 3.0 * strain - 0.6))
    frame = GRID.pressure(TIP, law, 0.004)
    exact = Material(law.coefficients)
    known, unknown = (ContactEstimator(TIP, each, GRID, NOISE)(frame) for each in (exact, law))
    assert unknown.d == known.d
    assert unknown.d_std > 2.0 * known.d_std


@pytest.mark.parametrize(
    "wrong", [{"baseline": -1.0}, {"centre": math.nan}, {"correlation": np.ones(3)}]
)
def test_refusals(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must"):
        Uncertainty(**wrong)


Imperfection = Callable[[Fingertip, float, float, float, float], np.ndarray]
X, Y = np.meshgrid(*2 * (PITCH * (np.arange(44) - 21.5),))
FLAT = SensorGrid(44, 44, PITCH)


def pressed(
    tip: Fingertip, d: float, x: float, y: float, grid: SensorGrid = FLAT, radius: float = 0.020
) -> np.ndarray:
    return grid.pressure(replace(tip, radius=radius), LINEAR, d, x, y)


def unloading(tip: Fingertip, d: float, x: float, y: float, sign: float) -> np.ndarray:
    """Off by up to 10 % of what each cell read at a depth of 1.3 d."""
    loaded = np.maximum(pressed(tip, 1.3 * d, x, y), 1e-9)
    strain = np.clip(pressed(tip, d, x, y) / loaded, 0.0, 1.0)
    return pressed(tip, d, x, y) + sign * 0.4 * loaded * strain * (1.0 - strain)


def crosstalk(tip: Fingertip, d: float, x: float, y: float, sign: float) -> np.ndarray:
    frame = pressed(tip, d, x, y)
    return frame + sign * 0.03 * (frame.mean(axis=0) + frame.mean(axis=1)[:, None])


def power(tip: Fingertip, d: float, x: float, y: float, sign: float) -> np.ndarray:
    frame = pressed(tip, d, x, y) / 50e3
    return 50e3 * np.sign(frame) * np.abs(frame) ** (1.0 + 0.08 * sign)


def scanned(tip: Fingertip, d: float, x: float, y: float, sign: float) -> np.ndarray:
    """Rows one after the other, while the face goes 0.2 mm."""
    rows = [pressed(tip, d + sign * 2e-4 * (k - 21.5) / 44, x, y)[k] for k in range(44)]
    return np.stack(rows)


# What real cells have and a sensor's model lacks, and what has to be known for it.
IMPERFECTIONS: dict[str, tuple[Uncertainty, Imperfection]] = {
    "unloading": (Uncertainty(gain=0.1, smooth=0.04), unloading),
    "crosstalk": (Uncertainty(gain=0.02, smooth=0.01), crosstalk),
    "power": (Uncertainty(gain=0.2, smooth=0.03), power),
    "rotation": (
        Uncertainty(rotation=math.radians(2.0)),
        lambda tip, d, x, y, sign: pressed(
            tip, d, x, y, replace(FLAT, rotation=sign * math.radians(2.0))
        ),
    ),
    "slope": (
        Uncertainty(slope=1000.0),
        lambda tip, d, x, y, sign: pressed(tip, d, x, y) + sign * 5e4 * (X + Y),
    ),
    "scan": (Uncertainty(skew=2e-4), scanned),
    "radius": (
        Uncertainty(radius=0.02),
        lambda tip, d, x, y, sign: pressed(tip, d, x, y, radius=0.020 * (1.0 + 0.02 * sign)),
    ),
    "gain": (
        Uncertainty(gain=0.12),
        lambda tip, d, x, y, sign: pressed(tip, d, x, y) * (1.0 + 0.12 * sign),
    ),
}


def worst_nees(known: Uncertainty, tip: Fingertip, imperfect: Imperfection) -> float:
    """Return the largest mean NEES of (d, tilts) at 0.5 to 7 mm, where no misfit is flagged."""
    estimator = ContactEstimator(tip, LINEAR, FLAT, NOISE, known=known)
    rng, worst = np.random.default_rng(3), 0.0
    for d in (0.5e-3, 1e-3, 2e-3, 4e-3, 6e-3):
        squares = []
        for azimuth in (0.3, 1.9, 3.6, 5.2):
            n = math.sin(0.26) * np.array([math.cos(azimuth), math.sin(azimuth)])
            truth = np.array([d, *np.arcsin(n)])
            for sign in (-1.0, 1.0):
                frame = imperfect(tip, *truth, sign)
                for _ in range(4):
                    e = estimator(frame + rng.normal(0.0, NOISE, frame.shape))
                    if e.valid and not e.misfit:
                        error = np.array([e.d, e.tilt_x, e.tilt_y]) - truth
                        squares.append(error @ np.linalg.solve(e.covariance[:3, :3], error) / 3.0)
        if len(squares) > 16:  # else flagged
            worst = max(worst, float(np.mean(squares)))
    return worst


@pytest.mark.parametrize("physics", ["springs", "solid"])
@pytest.mark.parametrize("name", IMPERFECTIONS)
def test_imperfections_of_real_cells_are_covered_or_flagged(
    name: str, physics: str, request: pytest.FixtureRequest
) -> None:
    known, imperfect = IMPERFECTIONS[name]
    tip = Fingertip(0.020, physics)  # type: ignore[arg-type]
    assert 0.7 < worst_nees(known, tip, imperfect) < 1.5
    request.getfixturevalue("exact_solid_data")
    if (name, physics) not in (("gain", "springs"), ("slope", "solid")):  # which take no harm
        assert worst_nees(Uncertainty(), tip, imperfect) > 5.0
