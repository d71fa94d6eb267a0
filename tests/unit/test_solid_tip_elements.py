"""The solid tip's finite elements: one press again on a coarse mesh, sticking, base in balance."""

from __future__ import annotations

import numpy as np
import pytest

from research.solid_tip.fit import SolidTip, rms_difference
from tests.unit.test_solid_tip_data import CELLS, FILE, PITCH

pytest.importorskip("scipy")


THETA, D = np.radians(20.0), 0.25


def test_a_coarse_mesh_presses_as_the_data_file_says() -> None:
    from research.solid_tip.contact import TiltedPlane
    from research.solid_tip.fit import RING_EDGES, Samples
    from research.solid_tip.green import green
    from research.solid_tip.ways import StickingPlane, straight

    surface = green(rings=12, poisson=0.48, bonded=True, base_harmonics=9)
    press = TiltedPlane(surface, THETA, D).press(D)
    plane = TiltedPlane(surface, THETA, D, sticking=True)
    stuck = [plane.press(d) for d in np.linspace(0.2, np.sqrt(D), 8) ** 2][-1]
    bases = Samples.of([press, stuck], surface.base_radius).base
    for each, base in zip((press, stuck), bases, strict=True):
        force = base[0] @ np.diff(RING_EDGES**2) * np.pi
        balance = each.push * np.cos(THETA) - each.shear * np.sin(THETA)
        assert force == pytest.approx(balance, rel=1e-9)
    assert 1.05 < stuck.push / press.push < 1.15
    assert -0.1 < stuck.shear / stuck.push < -0.05
    *_, (_, same) = straight(StickingPlane(surface, 0.6), THETA, D)
    assert same[:2] == pytest.approx((stuck.push, stuck.shear), rel=0.02)
    assert same[2:] == pytest.approx((force, stuck.energy), rel=0.005)
    with np.load(FILE) as data:
        tip = SolidTip(data, "bonded", 0.48)
    push, energy, pressure = tip.press(D, THETA)
    assert press.push == pytest.approx(push, rel=0.005)
    assert press.energy == pytest.approx(energy, rel=0.003)
    frames = (tip.frame(each, PITCH, CELLS) for each in (bases[0], pressure))
    assert rms_difference(*frames) < 0.01
