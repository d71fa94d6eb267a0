"""Fuzz the simulated hand with random commands, pushes and parameters, in every kind of scene.

All commands for a hand are drawn in advance and executed in one compiled loop.
"""

import math

import numpy as np

from softfinger.daemon.simulation.physics.plant import step
from softfinger.daemon.simulation.physics.plant_state import SHEARS
from softfinger.kinematics.compiled.kernel import kernel
from tests.fuzz import Report
from tests.harness.plant import BOUNDED, CURRENT, PAPER, POSITION, TABLE_I, make

LONGER = 10  # factor by which the time step of every third hand is longer
EACH = 400  # number of commands per hand
SHAPES = ("rectangle", "rectangle", "disc", "wedge", "none")
# Columns of a command: joint, mode, torque on, goal, current, three load components, load set,
# reset, seconds, quiet.
_COLUMNS = 12

FINE, NOT_FINITE, UNTOLD, RUNAWAY, CREATED = range(5)
WRONG = (
    "",
    "not finite",
    "past the limit untold",
    "joints far past their stops",
    "energy from nowhere",
)


@kernel
def past_limit(radius, d, theta, curvature):
    """Return the minimum rim indentation [m] implied by the tip's d and θ."""
    if curvature == 0.0:
        return d - radius * (1.0 - abs(math.sin(theta)))
    away = radius - d + 1.0 / curvature
    beyond = max(abs(away * math.sin(theta)) - radius, 0.0)
    return 1.0 / curvature - math.hypot(away * math.cos(theta), beyond)


@kernel
def is_sound(plant):
    """Return True if all values of the hand are finite."""
    state, felt = plant.state, plant.sensed_contact
    total = plant.energy
    for j in range(5):
        total += state.position[j] + state.velocity[j]
    for j in range(SHEARS):
        total += state.extra_shear[j]
    for j in range(2):
        each = felt[j]
        total += state.shear[j] + state.current[j] + each.d + each.theta + each.force
        total += each.normal + each.tangential + each.rim
    return math.isfinite(total)


@kernel
def carry_out(plants, data, ring, commands):
    """Execute the commands; return the first error and the index of the faulty command."""
    plant = plants[0]
    goals, state, felt = plant.goals, plant.state, plant.sensed_contact
    for k in range(commands.shape[0]):
        joint = int(commands[k, 0])
        goals.mode[joint] = int(commands[k, 1])
        goals.torque_on[joint] = int(commands[k, 2])
        goals.q[joint] = commands[k, 3]
        goals.current[joint] = commands[k, 4]
        if commands[k, 8] > 0.0:
            goals.load[:] = commands[k, 5:8]
        if commands[k, 9] > 0.0:  # Open the hand and put the object back between the fingers.
            state.position[:] = 0.0
            state.velocity[:] = 0.0
            state.position[3] = 0.08
        if commands[k, 11] > 0.0:  # Without input, the energy may only decrease.
            goals.torque_on[:] = 0
            state.current[:] = 0.0
            goals.load[:] = 0.0
        most = math.inf
        for _ in range(int(commands[k, 10] / plant.parameters.step) + 1):
            step(plants, data, ring, 1)
            if commands[k, 11] > 0.0:
                if plant.energy > most:
                    return CREATED, k
                most = plant.energy + 1e-12 * (abs(plant.energy) + 1e-3)
        if not is_sound(plant):
            return NOT_FINITE, k
        for finger in range(2):
            each = felt[finger]
            least = past_limit(plant.parameters.radius, each.d, each.theta, each.curvature)
            if each.force > 0.0 and least > 1e-9 and not each.rim > 0.0:
                return UNTOLD, k
            if abs(state.position[finger]) > 1.6:
                return RUNAWAY, k
    return FINE, commands.shape[0]


def random_hand(generator: np.random.Generator, long: bool = False):
    """Return a hand with a random scene and random parameters.

    Masses range from 1 g to 10 kg, moduli from 10 kPa to 10 MPa, friction coefficients from 0 to 2,
    and joint inertias from 1e-4 to 0.1 kg·m². Gravity may have any direction.
    """
    table = (PAPER, TABLE_I)[generator.integers(2)]
    modulus = float(10 ** generator.uniform(4, 7))
    parameters = {
        "object_shape": str(generator.choice(SHAPES)),
        "object_radius": float(generator.uniform(0.005, 0.03)),
        "object_taper": float(generator.uniform(-1, 1)),
        "object_mass": float(10 ** generator.uniform(-3, 1)),
        "modulus_scale": modulus / float(table.header.modulus),
        "tip_friction": float(generator.uniform(0, 2)),
        "palm_friction": float(generator.uniform(0, 2)),
        "palm": float(generator.uniform(-0.05, 0.045)),
        "joint_inertia": float(10 ** generator.uniform(-4, -1)),
        "tip_loss": float(10 ** generator.uniform(-5, -1)),
        "gravity": tuple(float(g) for g in generator.normal(size=2)),
        "tip_shear_stiffness": float(10 ** generator.uniform(-1, 1)),
        "tip_creep_time": float(generator.choice([0.0, 0.01, 1.0])),
        "tip_micro_slip": bool(generator.integers(2)),
        "joint_stribeck": float(generator.uniform(0, 0.1)),
        "joint_load_friction": tuple(generator.uniform(0, 0.3, 2).tolist()),
        "joint_presliding": float(10 ** generator.uniform(-5, -2)),
        "tip_law": str(generator.choice(["springs", "bristles"])),
    }
    hand = make(table, **parameters)
    if long:
        hand = make(table, step=LONGER * hand.step, **parameters)
    return hand


def random_commands(generator: np.random.Generator, count: int) -> np.ndarray:
    commands = np.empty((count, _COLUMNS))
    commands[:, 0] = generator.integers(2, size=count)
    commands[:, 1] = generator.choice([CURRENT, POSITION, BOUNDED], size=count)
    commands[:, 2] = generator.random(count) < 0.9
    commands[:, 3] = generator.uniform(-2, 2, count)
    commands[:, 4] = generator.uniform(-4, 4, count)
    commands[:, 5:8] = generator.normal(size=(count, 3)) * [1, 1, 0.05]
    commands[:, 5:8] *= (generator.random(count) < 0.5)[:, None]
    commands[:, 8] = generator.random(count) < 0.2
    commands[:, 9] = generator.random(count) < 0.01
    commands[:, 10] = generator.uniform(0, 0.02, count)
    commands[:, 11] = generator.random(count) < 0.1
    return commands


def abuse(seed: int, count: int = EACH) -> str:
    """Send ``count`` random commands to a random hand; return the error, or an empty string."""
    generator = np.random.default_rng(seed)
    hand = random_hand(generator, seed % 3 == 0)
    commands = random_commands(generator, count)
    code, at = carry_out(hand.plant.array, hand.table.data, hand._ring, commands)
    return f"seed {seed}, command {at}: {WRONG[code]}" if code != FINE else ""


def fuzz(count: int, seed: int) -> Report:
    """Send ``count`` commands in total, and create a new hand for every EACH commands."""
    hands = max(count // EACH, 1)
    found = [abuse(each) for each in range(1000 * seed, 1000 * seed + hands)]
    return Report(hands, [each for each in found if each])
