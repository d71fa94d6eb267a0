"""Test the forward model's cell averages against integrals, and cell sums against closed forms."""

import math

import numpy as np
import pytest

from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from tests.harness.paper_tip import LINEAR, MEASURED, PITCH, TIP, A, E, tilts


def cell_mean(grid, material, d, tilt_x, tilt_y, row, col, lines=400):
    """Return a cell's mean σ(ε).

    The integral over y uses the midpoint rule. The integral over x = R sin t uses Gauss quadrature
    in t.
    """
    n_x, n_y = math.sin(tilt_x), math.sin(tilt_y)
    n_z = math.sqrt(1.0 - n_x**2 - n_y**2)
    cells = grid.on(TIP)
    x_first, y_first, pitch_x, pitch_y = cells.x, cells.y, cells.pitch_x, cells.pitch_y
    x0 = x_first + col * pitch_x
    nodes, weights = np.polynomial.legendre.leggauss(30)
    y = (y_first + (row + (np.arange(lines) + 0.5) / lines) * pitch_y)[:, None]
    radius2 = A**2 - y**2
    q = (A - d) - y * n_y
    # The ends of the footprint on a line y satisfy (h − x n_x − y n_y)² = n_z² (R² − x²).
    a2 = n_x**2 + n_z**2
    root = (q * n_x) ** 2 - a2 * (q**2 - n_z**2 * radius2)
    inside = (root > 0.0) & (radius2 > 0.0)
    half = np.sqrt(np.where(inside, root, 0.0))
    left = np.maximum((q * n_x - half) / a2, x0)
    right = np.minimum((q * n_x + half) / a2, x0 + pitch_x)
    inside &= right > left
    radius = np.sqrt(np.where(inside, radius2, 1.0))
    start = np.arcsin(np.clip(np.where(inside, left / radius, 0.0), -1.0, 1.0))
    stop = np.arcsin(np.clip(np.where(inside, right / radius, 0.0), -1.0, 1.0))
    t = start + (stop - start) * 0.5 * (nodes + 1.0)
    x, z = radius * np.sin(t), radius * np.cos(t)
    strain = np.clip(1.0 - (q - x * n_x) / (n_z * z), 0.0, 1.0)
    line = (material.stress(strain) * z * weights).sum(axis=1) * 0.5 * (stop - start)[:, 0]
    return line.sum() / lines / pitch_x


@pytest.mark.parametrize("material", [LINEAR, MEASURED], ids=["constant", "table_i"])
@pytest.mark.parametrize(
    ("d", "degrees", "azimuth"),
    [
        (1e-5, 0.0, 0.0),  # The footprint is smaller than a cell.
        (2e-4, 5.0, 1.0),
        (1e-3, 10.0, 0.3),
        (4e-3, 30.0, 0.7),
        (8e-3, 30.0, 2.2),
        (8e-3, 36.0, 0.4),  # The footprint almost reaches the rim.
    ],
)
def test_cell_averages_for_all_kinds_of_cells(material, d, degrees, azimuth):
    grid = SensorGrid(44, 44, PITCH, centre=(0.3e-3, -0.2e-3))
    tilt_x, tilt_y = tilts(math.radians(degrees), azimuth)
    p = grid.pressure(TIP, material, d, tilt_x, tilt_y)
    touched = np.argwhere(p > 0.0)
    order = np.argsort(p[p > 0.0])
    allowed = 1e-5 if degrees < 30.0 else 1e-4 if degrees < 36.0 else 1e-3
    # Test some of all cells, and the cells with the lowest pressure, which are on the outline.
    chosen = np.unique(np.concatenate([order[:25], order[:: max(1, len(order) // 15)]]))
    for row, col in touched[chosen]:
        expected = cell_mean(grid, material, d, tilt_x, tilt_y, row, col)
        assert abs(p[row, col] - expected) <= allowed * material.reference_modulus


def test_cells_outside_the_footprint_are_exactly_zero():
    grid = SensorGrid(44, 44, PITCH)
    p = grid.pressure(TIP, LINEAR, 0.002, 0.2, -0.1)
    n_x, n_y = math.sin(0.2), math.sin(-0.1)
    centres = (np.arange(44) - 21.5) * PITCH
    far = np.hypot(centres[None, :] - 0.018 * n_x, centres[:, None] - 0.018 * n_y)
    rho = math.sqrt(2 * A * 0.002 - 0.002**2)
    assert np.all(p[far > rho + PITCH] == 0.0)
    assert np.all(p[far < 0.9 * rho - PITCH] > 0.0)


@pytest.mark.parametrize(
    ("d", "degrees", "force"),
    [(8, 45, 81.266754123), (10, 35, 114.126873792), (12, 30, 153.849535079)],
)
@pytest.mark.parametrize("azimuth", [0.0, 0.5, math.pi / 2])
def test_beyond_the_limit_the_strain_is_cut_off_at_the_rim(d, degrees, force, azimuth):
    grid = SensorGrid(44, 44, PITCH, centre=(1e-4, 3e-4))
    p = grid.pressure(TIP, LINEAR, d * 1e-3, *tilts(math.radians(degrees), azimuth))
    assert p.sum() * PITCH**2 == pytest.approx(force, rel=2e-4)
    assert p.max() <= E * (1 + 1e-12)


def test_a_rotated_sensor_sees_the_tilt_rotated_back():
    plain = SensorGrid(44, 44, PITCH)
    turned = SensorGrid(44, 44, PITCH, rotation=math.pi / 2)
    # The sensor's x axis is parallel to the finger's y axis.
    np.testing.assert_allclose(
        turned.pressure(TIP, LINEAR, 0.003, 0.0, 0.25),
        plain.pressure(TIP, LINEAR, 0.003, 0.25, 0.0),
        atol=1e-9 * E,
    )


def test_the_tip_centre_shifts_the_map_and_gain_scales_it():
    plain = SensorGrid(44, 44, PITCH).pressure(TIP, LINEAR, 0.003, 0.1)
    shifted = SensorGrid(44, 44, PITCH, centre=(3 * PITCH, -2 * PITCH))
    np.testing.assert_allclose(
        shifted.pressure(TIP, LINEAR, 0.003, 0.1)[:-2, 3:], plain[2:, :-3], atol=1e-7 * E
    )
    doubled = SensorGrid(44, 44, PITCH).pressure(TIP, LINEAR, 0.003, 0.1, gain=2.0)
    np.testing.assert_allclose(doubled, 2.0 * plain, rtol=1e-14)


def test_a_footprint_beyond_the_sensor_is_clipped_not_wrapped():
    grid = SensorGrid(44, 44, PITCH, centre=(0.029, 0.0))
    p = grid.pressure(TIP, LINEAR, 0.004)
    whole = SensorGrid(88, 88, PITCH).pressure(TIP, LINEAR, 0.004)
    assert p.sum() == pytest.approx(whole.sum() / 2, rel=1e-3)
    assert np.all(p[:, :20] == 0.0)


def test_no_contact_is_all_zero_and_out_is_reused():
    grid = SensorGrid(8, 9, PITCH)
    out = np.ones((8, 9))
    assert grid.pressure(TIP, LINEAR, 0.0, out=out) is out
    assert np.all(out == 0.0)
    assert np.all(grid.pressure(TIP, LINEAR, -0.001) == 0.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: SensorGrid(0, 4, PITCH), "at least one row and one column"),
        (lambda: SensorGrid(4, 4, 0.0), "pitch"),
        (lambda: SensorGrid(4, 4, (PITCH, math.nan)), "pitch"),
        (lambda: SensorGrid(4, 4, PITCH, centre=(math.inf, 0.0)), "centre"),
        (lambda: SensorGrid(4, 4, PITCH).pressure(TIP, LINEAR, math.nan), "finite"),
        (lambda: SensorGrid(4, 4, PITCH).pressure(TIP, LINEAR, 0.021), "radius"),
        (lambda: SensorGrid(4, 4, PITCH).pressure(TIP, LINEAR, 0.001, 2.0), "normal"),
        (lambda: SensorGrid(4, 4, PITCH).pressure(TIP, LINEAR, 0.001, 1.2, 1.2), "normal"),
        (lambda: SensorGrid(4, 4, PITCH).pressure(TIP, LINEAR, 0.001, out=np.ones(4)), "shape"),
    ],
)
def test_invalid_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
