"""Pressure maps as characters: colours, resampling, orientation."""

from __future__ import annotations

import numpy as np
import pytest
from rich.color import ColorTriplet
from rich.style import Style

from softfinger.tools.terminal import heatmap
from softfinger.tools.terminal.heatmap import FullScale, fit, picture, resample


def lightness(colour: ColorTriplet) -> float:
    linear = [(c / 255.0) ** 2.2 for c in colour]
    return float(np.dot((0.2126, 0.7152, 0.0722), linear))


def test_colours_grow_lighter_step_by_step() -> None:
    bar = heatmap.colour_bar(heatmap.LEVELS, True)
    styles = [span.style for span in bar.spans if isinstance(span.style, Style)]
    colours = [style.color.get_truecolor() for style in styles if style.color]
    light = [lightness(colour) for colour in colours]
    assert light == sorted(light)
    assert len(set(light)) == heatmap.LEVELS
    assert light[-1] > 10.0 * light[0]


def test_resample_is_the_area_average() -> None:
    grid = np.random.default_rng(1).random((44, 44))
    blocks = grid.reshape(22, 2, 11, 4).mean(axis=(1, 3))
    assert resample(grid, 22, 11) == pytest.approx(blocks, abs=1e-12)
    assert resample(grid, 88, 132) == pytest.approx(np.kron(grid, np.ones((2, 3))), abs=1e-12)
    # On sizes that don't divide: the twin counts on a common refinement.
    fine = np.kron(grid, np.ones((17, 9)))
    twin = fine.reshape(17, 44, 9, 44).mean(axis=(1, 3))
    assert resample(grid, 17, 9) == pytest.approx(twin, abs=1e-12)


def test_row_0_is_lowest_and_column_0_is_left() -> None:
    grid = np.zeros((4, 4))
    grid[0, 0] = 1.0
    lines = picture(grid, 1.0, 2, 4, True)
    lowest = lines[-1].spans[0]
    assert (lowest.start, lowest.end) == (0, 1)
    assert isinstance(lowest.style, Style)
    assert lowest.style.bgcolor is not None
    brightest = heatmap.colour_map()[-1]
    assert lowest.style.bgcolor.get_truecolor() == ColorTriplet(*brightest)
    assert [line.plain for line in picture(grid, 1.0, 4, 4, False)] == [
        "    ",
        "    ",
        "    ",
        "█   ",
    ]


def test_fit_keeps_cells_square() -> None:
    assert fit(44, 44, 11, 22) == (11, 22)
    assert fit(44, 44, 11, 60) == (11, 22)
    assert fit(44, 44, 40, 22) == (11, 22)
    assert fit(10, 40, 11, 22) == (3, 22)
    assert fit(256, 4, 11, 22) == (11, 1)
    assert fit(12, 32, 11, 22, 32 / 12) == (11, 22)  # oblong cells of a square sensor


def test_scale_grows_at_once_and_shrinks_late() -> None:
    scale = FullScale(smallest=5.0, patience=3.0)
    assert scale.follow(0.0, 0.0) == 5.0
    assert scale.follow(41.0, 1.0) == 50.0
    assert scale.follow(8.0, 2.0) == 50.0
    assert scale.follow(45.0, 4.0) == 50.0  # back up: the wait begins anew
    assert scale.follow(8.0, 5.0) == 50.0
    assert scale.follow(8.0, 7.9) == 50.0
    assert scale.follow(8.0, 8.1) == 8.0
