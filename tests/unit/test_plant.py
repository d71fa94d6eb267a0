"""Test the plant's forces, energy decay, robustness and shear relaxation."""

import math

import numpy as np
import pytest

from softfinger import ContactTable, Fingertip, Material
from softfinger.daemon.simulation.physics.contacts import touch_object
from softfinger.daemon.simulation.physics.forces import place_finger
from softfinger.daemon.simulation.physics.plant_state import SHEARS, TipContact
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.kinematics.compiled.kernel import kernel
from tests.fuzz.plant import abuse, is_sound, random_hand
from tests.harness.plant import MODULUS, PAPER, TABLE_I, make, place

# Single tip.


@kernel
def evaluate_one(plants, tables, finger, turn):
    plant = plants[0]
    place_finger(plant, finger, plant.state.position[finger])
    tip = plant.stages[0].on_object[finger]
    touch_object(plant, tables[0], tip, finger, plant.state, math.cos(turn), math.sin(turn))


def tip_at(hand: SimulatedHand, finger: int, q, pose, shear: float) -> TipContact:
    """Set the given position and shear without motion; return a copy of a tip's contact."""
    state = hand.plant.state
    state.velocity[:] = 0.0
    state.position[:] = q, q, *pose
    state.shear[:] = shear
    hand.plant.forces[:] = 0.0
    evaluate_one(hand.plant.array, hand.table.data, finger, pose[2])
    return TipContact(hand.plant.stages[0].on_object[finger].array.copy())


GRADIENTS = {
    "soft": ((0.001, 0.010), {}),
    "softer along": ((0.001, 0.010), {"tip_shear_stiffness": 0.6}),
    "bristles": ((0.001, 0.010), {"tip_law": "bristles"}),
    "bristles on the rim": ((0.010, 0.019), {"tip_law": "bristles"}),
    "rim": ((0.010, 0.019), {}),
    "flat on the rim": ((0.0190, 0.0205), {}),
    "corner": ((0.001, 0.015), {"object_height": 0.002}),
    "wedge": ((0.001, 0.015), {"object_shape": "wedge", "object_taper": 0.4}),
    "disc": ((0.001, 0.018), {"object_shape": "disc", "object_radius": 0.025}),
    "disc on the rim": ((0.016, 0.022), {"object_shape": "disc", "object_radius": 0.012}),
}


@pytest.mark.parametrize("table", [PAPER, TABLE_I], ids=["constant", "table_i"])
@pytest.mark.parametrize(("depth", "scene"), GRADIENTS.values(), ids=GRADIENTS)
def test_tip_forces_are_the_gradient_of_one_energy(table, depth, scene):
    gradient_of_one_energy(table, depth, scene)


def test_forces_of_a_sticking_solid_tip_are_the_gradient_of_one_energy():
    tip = Fingertip(0.020, "solid", 0.48, "lying", "sticking")
    gradient_of_one_energy(ContactTable.build(tip, Material.constant(MODULUS)), (1e-3, 0.01), {})


def gradient_of_one_energy(table, depth, scene):
    hand = make(table, tip_friction=500.0, **scene)
    generator = np.random.default_rng(3)
    step = 1e-7
    checked = 0
    for _ in range(150):
        finger = int(generator.integers(2))
        q = generator.uniform(0, 0.9)
        pose = generator.uniform([0, 0.05, -0.9], [0, 0.10, 0.9])
        gap = tip_at(hand, finger, q, pose, 0.0).d
        side = 1 - 2 * finger
        want = generator.uniform(*depth)
        pose[0] += side * (want - gap) / math.cos(pose[2])
        shear = generator.uniform(-0.3, 0.3) * want
        tip = tip_at(hand, finger, q, pose, shear)
        if tip.gain == 0.0 or tip.shear != shear:
            continue
        coordinates = [finger, 2, 3, 4]
        forces = hand.plant.forces[coordinates]
        move = generator.normal(size=4) * [1, 0.05, 0.05, 1]
        rolled = tip.rows[2, coordinates] @ move
        ahead, behind = (
            tip_at(hand, finger, q + s * move[0], pose + s * move[1:], shear + s * rolled).energy
            for s in (step, -step)
        )
        slope = (ahead - behind) / (2 * step)
        assert -forces @ move == pytest.approx(
            slope, rel=1e-5, abs=1e-5 * np.abs(forces * move).sum()
        )
        checked += 1
    assert checked > 15


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_bristles_carry_shear_at_any_tilt_with_the_normal_force_of_the_springs(tilt):
    d, shear = 0.004, 3e-4
    pose = -0.010 - d / math.cos(tilt), 0.08, tilt
    springs, bristles = (
        tip_at(make(PAPER, tip_law=law, tip_friction=50.0), 0, 0.0, pose, shear)
        for law in ("springs", "bristles")
    )
    d = bristles.d
    assert bristles.force == springs.force
    assert bristles.tangential == pytest.approx(2.0 * math.pi * MODULUS * d * shear, rel=1e-6)
    pressed = math.pi * MODULUS * (d**2 / math.cos(tilt) ** 2 + shear**2)
    assert bristles.normal == pytest.approx(pressed, rel=1e-6)
    energy = math.pi * MODULUS * (d**3 / (3.0 * math.cos(tilt) ** 2) + d * shear**2)
    assert bristles.energy == pytest.approx(energy, rel=1e-6)
    leans = math.pi * MODULUS * d**2 * math.tan(tilt)
    assert springs.tangential - bristles.tangential == pytest.approx(leans, rel=1e-6)


# Energy.


@pytest.mark.parametrize("trial", range(24))
def test_energy_never_increases_without_input(trial):
    # Scenes, masses, moduli, friction and the initial motion are random. In some trials, a contact
    # extends beyond the tip's rim. One trial in three uses a time step that is ten times too long.
    generator = np.random.default_rng(trial)
    hand = random_hand(generator, trial % 3 == 0)
    held = hand.plant.parameters.object_held
    where = (
        generator.uniform(0.10, 0.45 if trial % 2 else 0.25, 2),
        generator.uniform([-0.003, 0.07, -0.2], [0.003, 0.09, 0.2]),
    )
    speeds = generator.normal(size=2) * 2, generator.normal(size=3) * [0.3, 0.3, 3] * (not held)
    place(hand, *where)
    at_rest = hand.plant.energy
    place(hand, *where, *speeds)
    start = energy = hand.plant.energy
    scale = abs(start) + 1e-3
    for _ in range(1500):
        hand.advance(hand.t + 1.5 * hand.step)
        later = hand.plant.energy
        assert later <= energy + 1e-12 * scale
        energy = later
    # Joints that stick keep the tips indented, so part of the energy remains.
    assert energy < start - min(1e-3 * scale, 0.25 * (start - at_rest))


# Extreme input.


@pytest.mark.extended
def test_the_state_stays_finite_for_random_commands_and_extreme_parameters():
    # Two in three trials use the normal time step. The other trials use a step that is ten times
    # too long.
    assert [wrong for wrong in map(abuse, range(6)) if wrong] == []


DEPTH = 0.004
STEP = 1e-4  # s
MU = 0.3


def pressed(**simulation: float) -> SimulatedHand:
    """Return a hand whose left tip presses upright on an object; joints and object are fixed."""
    hand = make(PAPER, STEP, tip_friction=MU, **simulation)
    hand.plant.parameters.joints_held = hand.plant.parameters.object_held = True
    place(hand, (0.0, -0.3), (-0.010 - DEPTH, 0.08, 0.0))
    return hand


def sheared(hand: SimulatedHand, way: list[float]) -> list[float]:
    """Move the face from 0 to each position [m] in ``way``; return T/(μN) at each position."""
    found, at = [], 0.0
    for target in way:
        for value in np.linspace(at, target, 400)[1:]:
            hand.shear[0] += value - at
            at = value
            hand.refresh()
            hand.advance(hand.t + STEP)
        found.append(float(hand.tangential[0] / (MU * hand.normal[0])))
    return found


@pytest.mark.parametrize("shear", range(SHEARS))
def test_fuzzing_detects_every_shear_that_is_not_finite(shear):
    hand = make()
    assert is_sound(hand.plant.array[0])
    hand.plant.state.extra_shear[shear] = math.nan
    assert not is_sound(hand.plant.array[0])


def test_creep_relaxes_a_stuck_shear_exponentially():
    hand = pressed(tip_creep_time=0.5)
    hand.shear[0] = 0.2 * DEPTH * MU
    hand.refresh()
    first = hand.tangential[0]
    assert first > 0.1
    hand.advance(hand.t + 0.75)
    assert hand.tangential[0] == pytest.approx(first * math.exp(-1.5), rel=1e-3)


def test_slip_starts_at_the_edge_and_is_stored_layer_by_layer() -> None:
    # The expected T/(μN) is derived from the friction of all springs. During the first loading, the
    # ratio is 1 − (1 − u/μd)². After a reversal, the change of the ratio is twice this function,
    # evaluated at half the distance. A closed path restores the initial force.
    def virgin(u: float) -> float:
        return 1.0 - (1.0 - min(u / (MU * DEPTH), 1.0)) ** 2

    part, back = 0.6 * MU * DEPTH, 0.2 * MU * DEPTH
    out, turned, again = sheared(pressed(tip_micro_slip=True), [part, back, part])
    assert out == pytest.approx(virgin(part), abs=0.01)
    assert turned == pytest.approx(out - 2.0 * virgin(0.5 * (part - back)), abs=0.01)
    assert again == pytest.approx(out, abs=1e-3)
    # An oscillation with decreasing amplitude removes the shear.
    fading = [part * (-1.0) ** k * (1.0 - k / 30.0) for k in range(31)]
    (*_, left) = sheared(pressed(tip_micro_slip=True), fading)
    assert abs(left) < 0.05 * out
    (whole,) = sheared(pressed(), [0.6 * 0.5 * MU * DEPTH])
    assert whole == pytest.approx(0.6, rel=0.01), (
        "without micro-slip, the tip must stick until it slips as a whole"
    )
