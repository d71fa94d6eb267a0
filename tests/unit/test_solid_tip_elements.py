"""The solid tip's finite elements: one press again on a coarse mesh, and its base in balance."""

from __future__ import annotations

import numpy as np
import pytest

from softfinger.tools.solid_tip.evaluate import SolidTip, rms_difference
from tests.unit.test_solid_tip_data import CELLS, FILE, PITCH

pytest.importorskip("scipy")


def test_a_coarse_mesh_presses_as_the_data_file_says() -> None:
    from softfinger.tools.solid_tip.contact import TiltedPlane
    from softfinger.tools.solid_tip.fit import RING_EDGES, Samples
    from softfinger.tools.solid_tip.green import green

    surface = green(rings=12, poisson=0.48, bonded=True, base_harmonics=9)
    theta, d = np.radians(20.0), 0.25
    press = TiltedPlane(surface, theta, d).press(d)
    base = Samples.of([press], surface.base_radius).base[0]
    force = base[0] @ np.diff(RING_EDGES**2) * np.pi
    assert force == pytest.approx(press.push * np.cos(theta), rel=1e-9)
    with np.load(FILE) as data:
        tip = SolidTip(data, "bonded", 0.48)
    push, energy, pressure = tip.press(d, theta)
    assert press.push == pytest.approx(push, rel=0.005)
    assert press.energy == pytest.approx(energy, rel=0.003)
    assert rms_difference(tip.frame(base, PITCH, CELLS), tip.frame(pressure, PITCH, CELLS)) < 0.01
