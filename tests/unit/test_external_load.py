"""The load along the faces by the joints' torques, against the balance by the grasp's energy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softfinger import ContactTable, Fingertip, Material
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.hand.grasp_state import (
    held_motion,
    holding_levers,
    load_of,
    load_torques,
    sheared_gradient,
)
from tests.harness.called import called
from tests.harness.grasp import Grasp, GraspState
from tests.harness.reference_hand import ReferenceHand

# Inner kernels, made callable.
held_motion = called(held_motion)
holding_levers = called(holding_levers)
sheared_gradient = called(sheared_gradient)
load_of = called(load_of)
load_torques = called(load_torques)

HAND = ReferenceHand(finger_offset=0.003)
LENGTHS = (HAND.half_separation, HAND.finger_length, HAND.finger_offset, HAND.tip_radius)
WIDTH = 0.040


@pytest.fixture(scope="module", params=["constant", "table_i"])
def table(request: pytest.FixtureRequest) -> ContactTable:
    material = Material.constant(0.304e6) if request.param == "constant" else Material.table_i()
    return ContactTable.build(Fingertip(0.020), material)


def found_load(
    table: ContactTable, state: GraspState, rolled: float, more: float = 0.0
) -> tuple[float, float]:
    c = HAND.contacts(state.q, state.pose, WIDTH)
    motion = held_motion(tuple(state.q), tuple(c.d), state.pose[2], 0.0, LENGTHS)
    torque = Grasp(HAND, table, WIDTH).forces(state).torque + more
    data = table.data
    left1, left2, lever, bow = load_torques(
        data, data, tuple(c.d), tuple(c.theta), 0.0, motion, (rolled, rolled), tuple(torque)
    )
    return load_of(0.5 * (left1 + left2), lever, bow)


@pytest.mark.parametrize("load", [0.0, 4.0, 8.0, -3.0, -6.0])
@pytest.mark.parametrize("delta", [0.0, 0.06, -0.12])
def test_load_is_what_the_tips_bear(table: ContactTable, load: float, delta: float) -> None:
    state = Grasp(HAND, table, WIDTH).symmetric(0.0035)
    if delta:
        state = Grasp(HAND, table, WIDTH).steer(state, delta)
    along = load * np.array([-math.sin(state.pose[2]), math.cos(state.pose[2])])
    for k in range(1, 5):
        state = Grasp(HAND, table, WIDTH, weight=tuple(along * k / 4)).balance(state)
    shear = Grasp(HAND, table, WIDTH).forces(state).tangential
    rolled = 0.5 * (shear[0] + shear[1])
    found, slope = found_load(table, state, rolled)
    assert found == pytest.approx(0.5 * load, rel=0.02, abs=0.01)
    # An error of the torques makes one of the load as the slope says.
    more = 1e-5  # N·m
    again, _ = found_load(table, state, rolled, more)
    assert again - found == pytest.approx(more / slope, rel=0.02)


def test_without_two_contacts_there_is_no_load(table: ContactTable) -> None:
    motion = held_motion((0.1, 0.1), (0.0, 1e-3), 0.0, 0.0, LENGTHS)
    data = table.data
    rolled = (0.0, 0.0)
    found = load_torques(data, data, (0.0, 1e-3), (0.1, -0.1), 0.0, motion, rolled, (0.5, 0.5))
    assert found == (0.0, 0.0, 0.0, 0.0)


def test_torques_that_no_load_explains_give_a_finite_one(table: ContactTable) -> None:
    for torque in (-50.0, 50.0):
        for q in np.linspace(-0.5, 1.0, 7):
            motion = held_motion((q, 0.1), (1e-6, 1e-3), 0.1, 0.3, LENGTHS)
            at = (table.data, table.data, (1e-6, 1e-3), (q, -0.1), 0.3, motion)
            left1, left2, lever, bow = load_torques(*at, (0.3, 0.3), (torque, 0.5))
            if lever == 0.0:
                continue  # a load would not show
            load, slope = load_of(0.5 * (left1 + left2), lever, bow)
            assert math.isfinite(load)
            assert slope > 0.0


@pytest.mark.parametrize("load", [0.0, 3.0])
@pytest.mark.parametrize("taper", [-0.3, 0.3])
def test_load_on_a_tapering_object_is_told_from_what_presses_it_out(
    table: ContactTable, taper: float, load: float
) -> None:
    q, d, angle = (0.2, 0.2), (3e-3, 3e-3), 0.0
    theta = (q[0] - 0.5 * taper, 0.5 * taper - q[1])
    data, lean = table.data, math.tan(0.5 * taper)
    motion = held_motion(q, d, angle, taper, LENGTHS)
    _, _, mean, normal1, normal2 = holding_levers(data, data, d, theta, taper, motion)
    out = 0.5 * lean * (normal1 + normal2)
    rolled = (mean - out, mean + out)
    # The torques of both tips' energies, each with the shear that it bears.
    v, torques = HAND.tip_jacobian(q), []
    for i, shear in enumerate((rolled[0] + load, rolled[1] - load)):
        at = (i - 0.5) * taper
        n = np.array([math.cos(at), math.sin(at)])
        t = np.array([-n[1], n[0]])
        by_d, by_theta = sheared_gradient(lookup(data, d[i], theta[i]), d[i], theta[i], shear)
        normal = by_d - shear * math.tan(theta[i])
        torque = normal * n @ v[i] + shear * (HAND.tip_radius - d[i] - v[i] @ t) + by_theta
        torques.append(torque if i == 0 else -torque)
    left1, left2, lever, bow = load_torques(
        data, data, d, theta, taper, motion, rolled, tuple(torques)
    )
    found, _ = load_of(0.5 * (left1 + left2), lever, bow)
    assert found == pytest.approx(load, abs=2e-3)
    # Each joint shows its part of it: one that doesn't is no load.
    assert left1 == pytest.approx(left2, abs=1e-9)
