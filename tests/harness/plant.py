"""Build, position and run simulated hands for tests."""

import math

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools.simulated_daemon import SimulatedDaemon

MODULUS = 0.304e6
WIDTH = 0.040
CONSTANT = 1.78  # N·m/A
PAPER = ContactTable.build(Fingertip(radius=0.020), Material.constant(MODULUS))
TABLE_I = ContactTable.build(Fingertip(radius=0.020), Material.table_i(), tolerance=1e-6)
CURRENT, POSITION, BOUNDED = 0, 3, 5  # operating modes
LOSSLESS = {
    "tip_loss": 0.0,
    "joint_damping": 0.0,
    "joint_friction": 0.0,
    "table_friction": 0.0,
    "tip_friction": 50.0,
}


def make(table: ContactTable = PAPER, step: float | None = None, **simulation) -> SimulatedHand:
    settings = Settings.model_validate({"simulation": simulation})
    return SimulatedHand(settings, table=table, step=step)


def place(hand: SimulatedHand, q, pose, dq=(0, 0), velocity=(0, 0, 0)) -> None:
    hand.q[:], hand.object_pose[:] = q, pose
    hand.dq[:], hand.object_velocity[:] = dq, velocity
    hand.refresh()


def hold_with(hand: SimulatedHand, currents) -> None:
    """Apply motor currents that stay constant at any joint velocity."""
    hand.plant.parameters.no_load_speed = 1e9
    hand.current[:] = currents
    for joint in range(2):
        hand.drive(joint, CURRENT, True, 0.0, currents[joint])


def run(hand: SimulatedHand, seconds: float) -> None:
    hand.advance(hand.t + seconds)


def settled(hand: SimulatedHand, goals, current: float, seconds: float = 2.0) -> None:
    for joint in range(2):
        hand.drive(joint, BOUNDED, True, goals[joint], current)
    run(hand, seconds)


def push_along(hand: SimulatedDaemon, force: float, rate: float, start: float = 0.0) -> float:
    """Push the object along its faces from ``start`` to ``force`` [N] at ``rate`` [N/s].

    The force remains applied; a positive force points away from the palm. Returns the tips' maximum
    friction utilisation.
    """
    dt, used = 0.02, 0.0
    count = max(round(abs(force - start) / (rate * dt)), 1)
    for k in range(1, count + 1):
        now = start + (force - start) * k / count
        angle = float(hand.plant.object_pose[2])
        hand.plant.apply_load(-now * math.sin(angle), now * math.cos(angle))
        used = max(used, float(hand.watch(dt).slip.max()))
    return used
