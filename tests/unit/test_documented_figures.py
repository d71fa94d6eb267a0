"""Test documented values that take too long to compute while the site is built."""

import json
import re
import statistics
from pathlib import Path

import numpy as np
import pytest

from softfinger import SensorGrid
from softfinger.kinematics.calibration.press_fit import Presses, compare_tips
from softfinger.tools.benchmarks import control

ROOT = Path(__file__).parents[2]
ROW = re.compile(
    r"(?m)^\| (bonded|lying), (\w+) \| (upright[^|]*) \| (bonded|lying), \**(\w+)\** "
    r"\| ([\d.]+) \| (\S+) % \| (\S+) \|$"
)
MODULUS, RADIUS, POISSON, NOISE = 0.25e6, 0.020, 0.49, 600.0
GRID = SensorGrid(44, 44, 0.058 / 44)


@pytest.mark.extended
def test_tip_models_identified_from_finite_elements_match_the_page() -> None:
    page = (ROOT / "docs" / "which-model.md").read_text(encoding="utf-8").replace("−", "-")
    rows = ROW.findall(page)
    assert len(rows) == 5
    with np.load(ROOT / "tests" / "golden" / "solid_frames.npz") as file:
        kinds, d, theta = file["base"], file["d"] * RADIUS, file["theta"]
        frames = file["frame"].astype(np.float64) * MODULUS
    for base, face, tilts, found_base, found_face, chi2, off, poisson_off in rows:
        chosen = kinds == base + "-sticking" * (face == "sticking")
        if tilts == "upright":
            chosen &= theta == 0.0
        seen = frames[chosen]
        seen += NOISE * np.random.default_rng(1).standard_normal(seen.shape)
        used = np.ones(seen.shape, np.bool_)
        presses = Presses(seen, d[chosen], theta[chosen], NOISE, used)
        best, *_ = compare_tips(presses, RADIUS, GRID, np.ones(GRID.shape, np.bool_))
        assert (best.tip.base, best.tip.face) == (found_base, found_face)
        assert best.chi2 == pytest.approx(float(chi2), abs=0.06)
        assert 100.0 * (best.modulus / MODULUS - 1.0) == pytest.approx(float(off), abs=0.2)
        assert best.tip.poisson - POISSON == pytest.approx(float(poisson_off), abs=0.002)


_DRAW_COUNT = 3  # number of stored random draws to simulate again


@pytest.mark.extended
@pytest.mark.parametrize(
    ("name", "way"),
    [
        (name, ways[name])
        for ways, name in (
            (control.WAYS, "energy, steered to 0"),
            (control.WAYS, "upright (blind)"),
            (control.LIMITS, "torque constants 5 % apart"),
            (control.LIMITS, "tips without tangential coupling"),
            (control.LATE_LIMITS, "two-phased, 0.5 Hz, 300 ms"),
            (control.LATE_TIPS, "without tangential coupling, 300 ms"),
        )
    ],
)
def test_stored_angle_errors_match_the_current_control_laws(name, way) -> None:
    content = json.loads((ROOT / "docs" / "control.json").read_text(encoding="utf-8"))
    (kept,) = (row for row in content["rows"] if row["name"] == name)
    found = [control.left(way, plant) for plant in control.drawn(_DRAW_COUNT)]
    expected = kept["angles"][:_DRAW_COUNT]
    assert None not in [*found, *expected]
    assert statistics.median(found) == pytest.approx(statistics.median(expected), rel=0.2, abs=0.1)
