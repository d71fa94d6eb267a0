"""Comparison models, and what sets them apart: no minimum of energy in the tilt."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from softfinger import ContactTable, Fingertip, Material
from softfinger.kinematics.contact.closed_form import closed_forms
from softfinger.kinematics.contact.other_laws import HertzModel, PowerLawModel, RadialModel

TIP = Fingertip(0.020)
E = 0.304e6


def test_checkpoints() -> None:
    np.testing.assert_allclose(RadialModel(TIP, E).energy(0.004) * 1e3, 22.694278248, rtol=1e-10)
    np.testing.assert_allclose(HertzModel(TIP, E).force(0.004), 19.3355282534, rtol=1e-11)
    law = PowerLawModel(TIP, 1e-3)
    assert law.pressure_factor == pytest.approx(1.5, rel=1e-14)
    assert PowerLawModel(TIP, 1e-3, shape=1.8).pressure_factor == pytest.approx(
        1.607979809, rel=1e-9
    )


def test_radial_energy_is_smooth_and_tends_to_the_cube() -> None:
    model = RadialModel(TIP, E)
    d = 0.02 * 10.0 ** np.arange(-12.0, -3.0)
    np.testing.assert_allclose(
        model.energy(d), math.pi * E * d**3 / 3 * (1 + d / 0.02 / 2), rtol=1e-6
    )
    # Across the change between series and formula, and at full compression: πa³E.
    near = model.energy(0.02 * (0.3 + np.array([-1e-9, 1e-9])))
    slope = 2 * math.pi * 0.02**2 * E * (-math.log(0.7) - 0.3)
    np.testing.assert_allclose(near[1] - near[0], slope * 0.02 * 2e-9, rtol=1e-5)
    np.testing.assert_allclose(model.energy(0.02), math.pi * 0.02**3 * E, rtol=1e-14)
    np.testing.assert_allclose(model.force(0.004), math.pi * E * 0.004**2)


def test_energies_are_the_integrals_of_the_forces() -> None:
    for model in (
        HertzModel(TIP, E),
        PowerLawModel.through(TIP, 0.004, 15.0),
        PowerLawModel.through(TIP, 0.004, 15.0, exponent=0.2),
    ):
        expected = quad(lambda x, m=model: float(m.force(x)), 0.0, 0.006, epsrel=1e-12)[0]
        np.testing.assert_allclose(model.energy(0.006), expected, rtol=1e-10)


def test_power_law_meets_its_point_and_its_pressure_sums_to_the_force() -> None:
    for exponent, shape in [(1 / 3, 2.0), (0.25, 1.8), (0.1, 4.0)]:
        model = PowerLawModel.through(TIP, 0.004, 15.0, exponent, shape)
        np.testing.assert_allclose(model.force(0.004), 15.0, rtol=1e-12)
        edge = float(model.contact_radius(0.004))
        total = quad(
            lambda r, m=model: 2 * math.pi * r * float(m.pressure(r, 0.004)), 0, edge, limit=200
        )[0]
        np.testing.assert_allclose(total, 15.0, rtol=1e-6)
        assert model.pressure(1.01 * edge, 0.004) == 0.0
    for exponent in (0.0, 0.34, -1.0):
        with pytest.raises(ValueError, match="exponent"):
            PowerLawModel(TIP, 1e-3, exponent)
    with pytest.raises(ValueError, match="positive"):
        PowerLawModel(TIP, 0.0)


@pytest.mark.parametrize("material", [Material.constant(E), Material.table_i()])
def test_only_parallel_springs_have_a_local_minimum_in_the_tilt(material: Material) -> None:
    theta = np.radians(np.linspace(-25, 25, 101))
    table = ContactTable.build(TIP, material, 1e-9)
    for d in (0.002, 0.004, 0.008):
        ours = table(d, theta)
        assert ours.energy.argmin() == 50
        assert np.all(np.diff(ours.energy[50:]) > 0)
        assert np.all(np.diff(ours.energy[:51]) < 0)
        assert ours.energy_theta[50] == 0.0
        assert np.all(ours.energy_theta * theta >= 0)
        # Radial springs know only d: turning the face about the tip leaves d and the energy as
        # they are, so no tilt is preferred.
        radial = np.broadcast_to(RadialModel(TIP, E).energy(np.full_like(theta, d)), theta.shape)
        assert np.ptp(radial) == 0.0


def test_radial_and_parallel_springs_agree_in_force_at_no_tilt() -> None:
    d = np.array([0.001, 0.004])
    np.testing.assert_allclose(
        RadialModel(TIP, E).force(d), closed_forms(E, d, 0.0).force, rtol=1e-15
    )


@pytest.mark.parametrize(
    "model", [RadialModel(TIP, E), HertzModel(TIP, E), PowerLawModel.through(TIP, 0.004, 15.0)]
)
def test_odd_input(model: RadialModel | HertzModel | PowerLawModel) -> None:
    for function in (model.force, model.energy):
        assert function(-1.0) == 0.0
        assert function(0.0) == 0.0
        assert math.isnan(function(math.nan))
        assert function(np.empty((2, 0))).shape == (2, 0)
        assert function(np.float32(0.004)).shape == ()
        with pytest.raises(ValueError, match="exceeds the tip's radius"):
            function(0.03)
