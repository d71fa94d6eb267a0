"""From settings to the plant's parameters, and the physical constants that no setting names.

The defaults are this project's own choice of a plausible hand; they come from no publication.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.simulation.physics import layout
from softfinger.daemon.simulation.physics.energy_guard import LOSSLESS_TOLERANCE
from softfinger.daemon.simulation.physics.shapes import shape_of
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.hand.geometry import HandGeometry

FloatArray = NDArray[np.float64]

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
    """The hand's lengths as the settings have them."""
    hand = settings.hand
    return HandGeometry(
        hand.pivot_separation, hand.finger_length, hand.finger_offset, settings.tip.radius
    )


def stiff_step(settings: Settings, table: ContactTable) -> float:
    """Sub-step [s] from the stiffest oscillation of the object on the tips, deeply grasped."""
    simulation = settings.simulation
    d = min(settings.safety.d_max, 0.6 * settings.tip.radius)
    c = table(d, 0.0)
    # Normal stiffness ∂F/∂d and shear stiffness 2F/d are of one size; both tips push.
    stiffness = 2.0 * simulation.modulus_scale * max(float(c.force_d), 2.0 * float(c.force) / d)
    shape = shape_of(simulation)
    if shape.kind == layout.NO_OBJECT:
        fastest = geometry_of(settings).reach * math.sqrt(stiffness / simulation.joint_inertia)
    else:
        turning = (shape.half_width / shape.gyration) ** 2
        fastest = math.sqrt(stiffness / simulation.object_mass * max(1.0, turning))
    step = min(max(PHASE_A_STEP / fastest, SHORTEST_STEP), LONGEST_STEP)
    # A whole number of sub-steps to the millisecond keeps ticks and frames on the grid.
    return 1e-3 / math.ceil(1e-3 / step - 1e-9)


def set_parameters(p: FloatArray, settings: Settings, table: ContactTable, step: float) -> None:
    """Set the parameters in the plant's memory. Raises SettingsError for an unknown servo."""
    simulation = settings.simulation
    radius = settings.tip.radius
    modulus = float(table.data[3])
    p[layout.RADIUS] = radius
    p[layout.SCALE] = simulation.modulus_scale
    p[layout.FRICTION] = simulation.tip_friction
    p[layout.LOSS] = simulation.tip_loss
    p[layout.MODULUS] = modulus * simulation.modulus_scale
    p[layout.TOLERANCE] = LOSSLESS_TOLERANCE if simulation.tip_loss == 0.0 else 0.0
    p[layout.RIM_STIFFNESS] = RIM_STIFFNESS

    p[layout.STEP] = step
    p[layout.HALF_SEPARATION] = 0.5 * settings.hand.pivot_separation
    p[layout.LENGTH] = settings.hand.finger_length
    p[layout.OFFSET] = settings.hand.finger_offset
    _object(p, settings)
    _joints(p, settings)
    for name in settings.scene.fingers:
        p[layout.PRESENT + FINGERS.index(name)] = 1.0
    _script(p, settings)
    p[layout.SAMPLE_PERIOD] = 1.0 / settings.tactile.rate


def _object(p: FloatArray, settings: Settings) -> None:
    simulation = settings.simulation
    shape, mass = shape_of(simulation), simulation.object_mass
    p[layout.PALM] = simulation.palm
    p[layout.PALM_FRICTION] = simulation.palm_friction
    p[layout.SHAPE] = shape.kind
    p[layout.HALF_WIDTH] = 0.5 * simulation.object_width
    p[layout.HALF_HEIGHT] = 0.5 * simulation.object_height
    p[layout.ROUNDNESS] = shape.roundness
    p[layout.EXTENT] = shape.extent
    p[layout.OUTLINE : layout.OUTLINE + 4 * layout.EDGE] = shape.edges().ravel()
    # κ of a face with that radius, see tip.py.
    curved = shape.roundness
    p[layout.SHARE] = math.sqrt(curved / (curved + settings.tip.radius)) if curved else 1.0
    p[layout.MASS] = mass
    p[layout.INERTIA] = mass * shape.gyration**2
    p[layout.GRAVITY : layout.GRAVITY + 2] = simulation.gravity
    # What gravity doesn't pull along the plane presses the object on the table.
    pressing = math.sqrt(max(STANDARD_GRAVITY**2 - math.hypot(*simulation.gravity) ** 2, 0.0))
    p[layout.TABLE_FORCE] = simulation.table_friction * mass * pressing
    p[layout.TABLE_TORQUE] = p[layout.TABLE_FORCE] * shape.lever
    p[layout.TABLE_SPEED] = TABLE_SPEED
    p[layout.TABLE_SPIN] = TABLE_SPEED / shape.lever
    # One finger alone can't hold anything: the object is then fixed to the bench.
    p[layout.OBJECT_HELD] = float(
        shape.kind == layout.NO_OBJECT
        or len(settings.scene.fingers) == 1
        or (settings.servos.backend == "none" and simulation.compression_speed > 0.0)
    )


def _joints(p: FloatArray, settings: Settings) -> None:
    simulation, servos = settings.simulation, settings.servos
    model = by_name(servos.model)
    inertia, constant = simulation.joint_inertia, settings.control.torque_constant
    p[layout.JOINT_INERTIA] = inertia
    p[layout.JOINT_DAMPING] = simulation.joint_damping
    p[layout.JOINT_FRICTION] = simulation.joint_friction
    p[layout.JOINT_SPEED] = JOINT_SPEED
    p[layout.TORQUE_CONSTANT] = constant
    p[layout.ELECTRIC_TIME] = ELECTRIC_TIME
    p[layout.CURRENT_LIMIT] = model.stall_current
    p[layout.STALL_CURRENT] = model.stall_current
    p[layout.NO_LOAD_SPEED] = model.no_load_speed / servos.gear_ratio
    gain = model.stall_current / FULL_EFFORT_ERROR
    p[layout.POSITION_GAIN] = gain
    # Critical damping of the joint on its position loop.
    p[layout.RATE_GAIN] = 2.0 * math.sqrt(gain * constant * inertia) / constant
    for joint in range(2):
        p[layout.STOP_LOW + joint] = settings.hand.q_min[joint] - STOP_CLEARANCE
        p[layout.STOP_HIGH + joint] = settings.hand.q_max[joint] + STOP_CLEARANCE
    p[layout.STOP_STIFFNESS] = STOP_STIFFNESS
    p[layout.JOINTS_HELD] = float(servos.backend == "none")


def _script(p: FloatArray, settings: Settings) -> None:
    simulation = settings.simulation
    p[layout.SCRIPT_X] = simulation.object_position[0]
    if settings.servos.backend != "none":
        return
    p[layout.SCRIPT_SPEED] = simulation.compression_speed
    pose = (*simulation.object_position, simulation.object_angle)
    width = 2.0 * shape_of(simulation).half_width
    contacts = geometry_of(settings).contacts(settings.hand.open_angle, pose, width)
    ways = COMPRESSION_DEPTH * settings.tip.radius - contacts.d
    ways = np.maximum(ways / max(math.cos(simulation.object_angle), 0.1), 0.0)
    for finger, place in enumerate((layout.SCRIPT_LEFT, layout.SCRIPT_RIGHT)):
        if FINGERS[finger] in settings.scene.fingers:
            p[place] = ways[finger]
