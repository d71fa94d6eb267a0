"""The plant's parameters from the settings, and the physical constants that no setting names.

The defaults are this project's own choice of a plausible hand; they come from no publication.
"""

from __future__ import annotations

import math

import numpy as np

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.simulation.physics.energy_guard import LOSSLESS_TOLERANCE
from softfinger.daemon.simulation.physics.plant_state import NO_OBJECT, Parameters
from softfinger.daemon.simulation.physics.shapes import shape_of
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.hand.geometry import HandGeometry

STANDARD_GRAVITY = 9.80665  # m/s²
LONGEST_STEP = 0.25e-3  # s
SHORTEST_STEP = 0.05e-3  # s
PHASE_A_STEP = 0.25  # rad of the fastest oscillation that a sub-step may cover
ELECTRIC_TIME = 1e-3  # s, lag of the servo's current behind its reference
FULL_EFFORT_ERROR = 0.27  # rad of position error at which the loop asks for the stall current
JOINT_SPEED = 0.002  # rad/s, below it joint friction is viscous
TABLE_SPEED = 0.0005  # m/s, likewise for the object on the table
STOP_CLEARANCE = 0.05  # rad between the commanded range and the mechanical end stops
STOP_STIFFNESS = 500.0  # N·m/rad
RIM_STIFFNESS = 1e6  # N/m, backing plate on the object
COMPRESSION_DEPTH = 0.4  # of the tip's radius, how far the scripted compression presses


def geometry_of(settings: Settings) -> HandGeometry:
    """Return the hand's lengths as the settings have them."""
    hand = settings.hand
    return HandGeometry(
        hand.pivot_separation, hand.finger_length, hand.finger_offset, settings.tip.radius
    )


def stiff_step(settings: Settings, table: ContactTable) -> float:
    """Return the sub-step [s] for the stiffest oscillation of the object on deeply pressed tips."""
    simulation = settings.simulation
    d = min(settings.safety.d_max, 0.6 * settings.tip.radius, _deepest(settings, table))
    c = table(d, 0.0)
    # Normal stiffness ∂F/∂d and shear stiffness 2F/d are of one size; both tips push.
    stiffness = 2.0 * simulation.modulus_scale * max(float(c.force_d), 2.0 * float(c.force) / d)
    shape = shape_of(settings)
    if shape.kind == NO_OBJECT:
        fastest = geometry_of(settings).reach * math.sqrt(stiffness / simulation.joint_inertia)
    else:
        turning = (shape.half_width / shape.gyration) ** 2
        fastest = math.sqrt(stiffness / simulation.object_mass * max(1.0, turning))
    step = min(max(PHASE_A_STEP / fastest, SHORTEST_STEP), LONGEST_STEP)
    # A whole number of sub-steps to the millisecond keeps ticks and frames on the grid.
    return 1e-3 / math.ceil(1e-3 / step - 1e-9)


def _deepest(settings: Settings, table: ContactTable) -> float:
    """d [m] up to which the tips' law holds."""
    return float(table.header.deepest) if table.is_solid else settings.tip.radius


def set_parameters(p: Parameters, settings: Settings, table: ContactTable, step: float) -> None:
    """Set the plant's parameters. Raises SettingsError for an unknown servo."""
    simulation = settings.simulation
    p.step = step
    p.sample_period = 1.0 / settings.tactile.rate
    p.modulus = float(table.header.modulus) * simulation.modulus_scale
    p.radius = settings.tip.radius
    p.deepest = _deepest(settings, table)
    p.scale = simulation.modulus_scale
    p.friction = simulation.tip_friction
    p.loss = simulation.tip_loss
    p.shear_stiffness = simulation.tip_shear_stiffness
    if simulation.tip_creep_time > 0.0:
        p.creep = -math.expm1(-step / simulation.tip_creep_time)
    p.micro_slip = simulation.tip_micro_slip
    p.rim_stiffness = RIM_STIFFNESS
    p.tolerance = LOSSLESS_TOLERANCE if simulation.tip_loss == 0.0 else 0.0
    p.half_separation = 0.5 * settings.hand.pivot_separation
    p.length = settings.hand.finger_length
    p.offset = settings.hand.finger_offset
    p.present[:] = [name in settings.scene.fingers for name in FINGERS]
    _object(p, settings)
    _joints(p, settings)
    _script(p, settings)


def _object(p: Parameters, settings: Settings) -> None:
    simulation = settings.simulation
    shape, mass = shape_of(settings), simulation.object_mass
    p.palm = simulation.palm
    p.palm_friction = simulation.palm_friction
    p.shape = shape.kind
    p.half_width = 0.5 * simulation.object_width
    p.half_height = 0.5 * simulation.object_height
    p.roundness = shape.roundness
    p.extent = shape.extent
    p.corners = len(shape.corners)
    for k, values in enumerate(shape.edges().tolist()):
        edge = p.outline[k]
        edge.x, edge.y, edge.normal_x, edge.normal_y, edge.length = values
    # κ of a face with that radius, see tip.py.
    curved = shape.roundness
    p.factor = math.sqrt(curved / (curved + settings.tip.radius)) if curved else 1.0
    if settings.tip.physics == "solid":
        p.factor = math.sqrt(p.factor)
    p.mass = mass
    p.inertia = mass * shape.gyration**2
    p.gravity[:] = simulation.gravity
    # What gravity doesn't pull along the plane presses the object on the table.
    pressing = math.sqrt(max(STANDARD_GRAVITY**2 - math.hypot(*simulation.gravity) ** 2, 0.0))
    p.table_force = simulation.table_friction * mass * pressing
    p.table_torque = p.table_force * shape.mean_radius
    p.table_speed = TABLE_SPEED
    p.table_spin = TABLE_SPEED / shape.mean_radius
    # One finger alone can't hold anything: the object is then fixed to the bench.
    p.object_held = (
        shape.kind == NO_OBJECT
        or len(settings.scene.fingers) == 1
        or (settings.servos.backend == "none" and simulation.compression_speed > 0.0)
    )


def _joints(p: Parameters, settings: Settings) -> None:
    simulation, servos = settings.simulation, settings.servos
    model = by_name(servos.model)
    inertia, constant = simulation.joint_inertia, settings.control.torque_constant
    p.joint_inertia = inertia
    p.joint_damping = simulation.joint_damping
    p.joint_friction = simulation.joint_friction
    p.joint_speed = JOINT_SPEED
    p.torque_constant = constant
    p.electric_time = ELECTRIC_TIME
    p.current_limit = model.stall_current
    p.stall_current = model.stall_current
    p.no_load_speed = model.no_load_speed / servos.gear_ratio
    p.position_gain = model.stall_current / FULL_EFFORT_ERROR
    # Critical damping of the joint on its position loop.
    p.rate_gain = 2.0 * math.sqrt(p.position_gain * constant * inertia) / constant
    p.stop_low[:] = np.subtract(settings.hand.q_min, STOP_CLEARANCE)
    p.stop_high[:] = np.add(settings.hand.q_max, STOP_CLEARANCE)
    p.stop_stiffness = STOP_STIFFNESS
    p.joints_held = servos.backend == "none"


def _script(p: Parameters, settings: Settings) -> None:
    simulation = settings.simulation
    p.script_x = simulation.object_position[0]
    if settings.servos.backend != "none":
        return
    p.script_speed = simulation.compression_speed
    pose = (*simulation.object_position, simulation.object_angle)
    width = 2.0 * shape_of(settings).half_width
    contacts = geometry_of(settings).contacts(settings.hand.open_angle, pose, width)
    ways = COMPRESSION_DEPTH * settings.tip.radius - contacts.d
    ways = np.maximum(ways / max(math.cos(simulation.object_angle), 0.1), 0.0)
    p.script_travel[:] = ways * p.present
