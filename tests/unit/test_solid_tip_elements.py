"""The solid tip's finite elements: presses again on a coarse mesh, sticking, base in balance."""

from __future__ import annotations

import numpy as np
import pytest

from research.solid_tip.fit import SolidTip, rms_difference
from research.solid_tip.green import Meridian
from tests.unit.test_solid_tip_data import FILE

pytest.importorskip("scipy")


THETA, D = np.radians(20.0), 0.25


def test_a_linear_press_is_in_balance_and_a_sticking_one_stiffer() -> None:
    from research.solid_tip.contact import TiltedPlane
    from research.solid_tip.fit import RING_EDGES, Samples
    from research.solid_tip.green import green

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


def test_neo_hookean_elements_press_as_the_data_file_says() -> None:
    pytest.importorskip("pypardiso")
    from research.solid_tip.rubber import MIDDLES, Body

    with np.load(FILE) as data:
        tip = SolidTip(data, "lying", 0.48)
    mesh = Meridian(8, finer=2, widest=0.2)
    softer, press = (
        next(Body(mesh, 0.48, False, None, linear=linear).press([D])) for linear in (True, False)
    )
    push, energy, pressure = tip.press(D, 0.0)
    assert press.energy == pytest.approx(energy, rel=0.01)
    assert press.push == pytest.approx(push, rel=0.02)
    assert press.push > 1.07 * softer.push
    near = MIDDLES < 0.9
    assert rms_difference(press.base[0, near], pressure[0, near]) < 0.03
    spread = MIDDLES > 1.0
    assert press.base[0, spread].any()
    assert not softer.base[0, spread].any()
