"""What a sensor reads from a disc: the springs under a cylinder, against a literal sum in NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softfinger.daemon.simulation.sensor.sensor_model import Board, SensorModel
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

TIP = Fingertip(0.020)
MATERIAL = Material.table_i()
PITCH = 0.058 / 44
COUNT = 2.5  # Pa


def frame(grid: SensorGrid, d: float, tilt: float, curvature: float) -> np.ndarray:
    sensor = SensorModel(grid, TIP, MATERIAL, Board(COUNT))
    out = np.zeros(grid.shape, np.uint16)
    sensor.frame(d, tilt, 0.0, out, curvature=curvature)
    return out * COUNT


def literal(d: float, tilt: float, radius: float, rotation: float, parts: int = 24) -> np.ndarray:
    """Mean pressure on 44 × 44 cells, each of ``parts``² points, sensor turned by ``rotation``."""
    at = (np.arange(44 * parts) + 0.5) * PITCH / parts - 0.029
    sensor_x, sensor_y = np.meshgrid(at, at)
    x = math.cos(rotation) * sensor_x - math.sin(rotation) * sensor_y
    away = TIP.radius - d + radius
    root = np.sqrt(np.maximum(radius**2 - (x - away * math.sin(tilt)) ** 2, 0.0))
    face = np.where(root > 0.0, away * math.cos(tilt) - root, np.inf)
    length = np.sqrt(np.maximum(TIP.radius**2 - sensor_x**2 - sensor_y**2, 1e-30))
    pressure = MATERIAL.stress(np.maximum(1.0 - np.minimum(face / length, 1.0), 0.0))
    return np.asarray(pressure.reshape(44, parts, 44, parts).mean(axis=(1, 3)))


@pytest.mark.parametrize("rotation", [0.0, 0.4])
@pytest.mark.parametrize(("d", "tilt"), [(0.001, -0.1), (0.004, 0.3), (0.006, -0.4)])
@pytest.mark.parametrize("radius", [0.012, 0.04])
def test_cells_read_the_springs_under_the_cylinder(
    radius: float, d: float, tilt: float, rotation: float
) -> None:
    grid = SensorGrid(44, 44, PITCH, rotation=rotation)
    found = frame(grid, d, tilt, 1.0 / radius)
    expected = literal(d, tilt, radius, rotation)
    assert np.abs(found - expected).max() < 1.5e-3 * MATERIAL.reference_modulus
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-3)


def test_a_face_that_is_all_but_plane_reads_like_a_plane_one() -> None:
    grid = SensorGrid(44, 44, PITCH, rotation=0.2)
    plane, curved = frame(grid, 0.004, 0.25, 0.0), frame(grid, 0.004, 0.25, 1e-5)
    assert np.abs(plane - curved).max() < 6e-4 * MATERIAL.reference_modulus
    assert not frame(grid, 0.0, 0.25, 50.0).any()
    assert not frame(grid, -0.001, 0.25, 50.0).any()


@pytest.mark.parametrize(("radius", "share"), [(0.02, 0.72), (0.04, 0.825)])
def test_an_estimator_that_knows_planes_finds_less_depth_but_the_force(
    radius: float, share: float
) -> None:
    grid = SensorGrid(44, 44, PITCH)
    for d, tilt in ((0.002, 0.1), (0.005, 0.2)):
        pressure = frame(grid, d, tilt, 1.0 / radius)
        found = ContactEstimator(TIP, MATERIAL, grid, 1520.0)(pressure)
        assert found.d / d == pytest.approx(share, abs=0.02)
        assert 0.93 < found.tilt_x / tilt < 1.0
        model = grid.pressure(TIP, MATERIAL, found.d, found.tilt_x, 0.0, gain=found.gain)
        assert model.sum() == pytest.approx(pressure.sum(), rel=0.03)
