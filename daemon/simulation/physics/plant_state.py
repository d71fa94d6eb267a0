"""Record of the plant: state, parameters, goals and work data, shared by all kernels.

Pairs are (left, right). Coordinates are the joint angles q1, q2 and the object's x, y, φ.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.layout import Pair, Record, Records

FloatArray = NDArray[np.float64]

FloatTriple = Annotated[FloatArray, 3]
FloatFive = Annotated[FloatArray, 5]
Flags = Annotated[NDArray[np.int64], 2]  # 0 or 1 for each finger

# Shapes of the object.
NO_OBJECT = 0
POLYGON = 1  # convex
DISC = 2

# Rows of a tip's contact.
ALONG_D = 0
ALONG_THETA = 1
ALONG_SHEAR = 2

LAYERS = 8  # layers of a footprint, from its edge inwards, that slip one after the other
CORNERS = 8  # largest number of corners of an object
SHEARS = CORNERS + 2  # shear of the palm at each corner, then of each tip on the other
PALM_ROWS = 2 * CORNERS  # height and slide of each corner
EXTRA_ROWS = PALM_ROWS + 6  # additionally d, θ and d_t of each tip on the other

Shears = Annotated[FloatArray, SHEARS]


class Motion(Record):
    """Coordinates, velocities, shears and currents of a state, or their rates of change.

    The rates of the bristles are those of the joints.
    """

    position: FloatFive  # [rad], [rad], [m], [m], [rad]
    velocity: FloatFive
    shear: Pair  # d_t of the tips on the object [m]
    extra_shear: Shears  # [m]
    bristles: Pair  # deflection of the gear bristles [rad]
    current: Pair  # [A]


class Sample(Record):
    """Contacts of the tips at the time of a frame; fields as in :class:`TipContact`."""

    number: int  # -1: none
    t: float  # since the start [s]
    d: Pair
    theta: Pair
    gain: Pair
    relaxation_factor: Pair
    curvature: Pair
    tangential: Pair


class Edge(Record):
    """Edge of the object's outline, in the object's frame."""

    x: float  # start point [m]
    y: float
    normal_x: float  # outward
    normal_y: float
    length: float  # [m]


class Parameters(Record):
    """Parameters fixed by the settings."""

    step: float  # sub-step [s]
    sample_period: float  # [s]
    modulus: float  # of the real tip at zero strain [Pa]
    radius: float  # of the tips [m]
    deepest: float  # largest d for which their law is valid [m]
    scale: float  # ratio of the real modulus to that of the table
    friction: float
    loss: float  # damping over stiffness [s]
    shear_stiffness: float  # relative to the springs
    shear_coupling: float  # of d_t with d and θ: 1 for springs, 0 for bristles
    creep: float  # fraction of a stuck shear that relaxes in a sub-step
    micro_slip: bool  # the edge of the footprint slips before the rest
    tips_relax: bool
    relaxation: FloatTriple  # stiffness of each Prony term relative to the long-term stiffness
    relaxation_step: FloatTriple  # fraction of each term that relaxes in a sub-step
    rim_stiffness: float  # [N/m]
    tolerance: float  # relative energy gain allowed in smooth steps
    half_separation: float  # of the pivots [m]
    length: float  # of a finger [m]
    offset: float  # of the tip from the finger's axis [m]
    finger_present: Flags  # the tip takes part
    shape: int  # of the object
    half_width: float  # [m]
    half_height: float  # [m]
    roundness: float  # radius of a disc [m]
    factor: float  # stiffness of a tip on the object relative to a plane
    extent: float  # distance of the farthest point from the object's centre [m]
    corners: int  # number of corners
    outline: Annotated[Records[Edge], CORNERS]  # counter-clockwise
    mass: float  # of the object [kg]
    inertia: float  # of the object [kg·m²]
    gravity: Pair  # x, y [m/s²]
    table_force: float  # Coulomb friction of the table on the object [N]
    table_torque: float  # Coulomb friction torque of the table on the object [N·m]
    table_speed: float  # below which table friction is viscous [m/s]
    table_spin: float  # likewise for rotation [rad/s]
    palm: float  # y of the palm [m]
    palm_friction: float
    joint_inertia: float  # [kg·m²]
    joint_damping: float  # [N·m·s/rad]
    joint_friction: float  # [N·m]
    stribeck: float  # additional friction at rest [N·m]
    load_friction: Pair  # friction per gear torque, and additional part at rest
    stribeck_speed: float  # at which the additional friction has decreased to 1/e [rad/s]
    presliding: float  # deflection at which the bristles slip [rad]
    torque_constant: float  # [N·m/A]
    electric_time: float  # lag of the current [s]
    current_limit: float  # [A]
    stall_current: float  # [A]
    no_load_speed: float  # [rad/s]
    position_gain: float  # [A/rad]
    rate_gain: float  # [A·s/rad]
    stop_low: Pair  # end stops [rad]
    stop_high: Pair
    stop_stiffness: float  # [N·m/rad]
    joints_held: bool
    object_held: bool
    script_speed: float  # of a held object that moves back and forth; 0: at rest [m/s]
    script_travel: Pair  # distance to the left and to the right [m]
    script_x: float  # start position [m]


class Goals(Record):
    """Commands to the servos and loads on the object."""

    mode: Annotated[NDArray[np.int64], 2]
    torque_on: Flags
    q: Pair  # [rad]
    current: Pair  # [A]
    stiffness: Pair  # of the servos' position loops, relative to the factory setting
    damping: Pair  # in excess of the factory setting, relative to its stiffness [s]
    duty: Pair  # limit of the motor voltage as a fraction of the supply
    load: FloatTriple  # external force x, y [N] and torque [N·m] on the object


class Finger(Record):
    """Position of a finger: centre of its tip in the hand's frame."""

    cosine: float  # of the joint angle
    sine: float
    x: float  # [m]
    y: float
    x_q: float  # derivatives by the joint angle [m/rad]
    y_q: float


class Gears(Record):
    """Friction of a joint's gears, modelled by elastic bristles between the teeth."""

    deflection: float  # of the bristles at the begin of the step [rad]
    level: float  # friction level at the begin of the step [N·m]
    limited_deflection: float  # last evaluated deflection, within its limits [rad]
    friction: float  # last evaluated friction level [N·m]
    stiffness: float  # of the bristles, in the matrix of the step [N·m/rad]


class TipContact(Record):
    """Contact of one tip with the object or with the other tip.

    Rows are d, θ, d_t; columns are q, x, y, φ, or q1, q2 for tip on tip.
    """

    d: float  # normal displacement, negative for a gap [m]
    theta: float  # tilt of the object relative to the tip [rad]
    sine: float  # of θ
    cosine: float
    tangent: float  # tan θ; 0 for bristles and beyond the soft hemisphere
    gain: float  # force relative to a plane: w(θ) and the curvature of the face
    curvature: float  # of the touched surface [1/m]
    travel: float  # possible increase of d in this step [m]
    rate_d: float  # [m/s]
    rate_theta: float  # [rad/s]
    slip_rate: float  # velocity of the touched surface minus that of the tip, along t [m/s]
    shear: float  # d_t within its limits [m]
    shear_variance: float  # variance of the shears of its layers [m²]
    shear_rate: float  # rate of d_t without slip [m/s]
    force: float  # total force on the base of the tip, the sum of a pressure grid [N]
    energy: float  # elastic [J]
    normal: float  # N [N]
    tangential: float  # T [N]
    rim: float  # depth of the rim in the object, 0 without contact [m]
    rim_energy: float  # of the rim alone, set if ``rim`` is above 0 [J]
    rim_d: float  # its derivatives by d [N] and by θ [N·m]
    rim_theta: float
    rows: Annotated[FloatArray, 3, 4]  # ∂d, ∂θ and the increments of d_t by the coordinates
    stiffness: FloatTriple  # along each row
    damping: FloatTriple
    along: FloatTriple  # forces along the rows, with losses
    forces: Annotated[FloatArray, 4]  # generalised forces on the coordinates


class Stage(Record):
    """All contacts in one of the two evaluations of a step."""

    on_object: Annotated[Records[TipContact], 2]
    on_tip: Annotated[Records[TipContact], 2]
    extra_rate: Shears  # rates of the extra shears without slip [m/s]


class ExtraRow(Record):
    """Row over the coordinates for a contact that occurs only in some scenes."""

    row: FloatFive
    stiffness: float
    damping: float
    shear: int  # 1 + index of its extra shear, 0 for none


class Factors(Record):
    """Matrix of the step over all coordinates, factorised as L D Lᵀ."""

    inverse: FloatFive  # inverse pivots
    lower: Annotated[FloatArray, 5, 5]


class Plant(Record):
    """All data of the simulated hand."""

    parameters: Parameters
    goals: Goals
    state: Motion
    # Present contact of each tip, the stronger of two
    sensed_contact: Annotated[Records[TipContact], 2]
    on_other_tip: Flags  # this contact is with the other tip
    step_count: int  # sub-steps done
    sample_count: int  # number of samples taken
    energy: float  # kinetic, elastic and gravitational [J]
    energy_limit: float  # upper limit of the energy, from the work done on the hand [J]
    limited_step_count: int  # sub-steps whose energy was reduced to this limit
    last_state: Motion  # state before the step
    stage_state: Motion  # state of the second stage
    first: Motion  # k1 of the step
    second: Motion  # k2 of the step
    stages: Annotated[Records[Stage], 2]
    fingers: Annotated[Records[Finger], 2]
    gears: Annotated[Records[Gears], 2]
    forces: FloatFive  # on the coordinates, except those of the motors
    drag: FloatFive  # friction over velocity
    external: Pair  # last evaluated torque of the contacts on each joint [N·m]
    load: FloatFive  # right-hand side of the equations of the step
    motor_by_q: Pair  # slopes of the motor torques, for the matrix
    motor_by_rate: Pair
    layers: Annotated[FloatArray, 2, LAYERS]  # shear of each tip's layers [m]
    last_layers: Annotated[FloatArray, 2, LAYERS]  # before the step
    shear_variance: Pair  # their variance [m²]
    relaxation_state: Annotated[FloatArray, 2, 3]  # of each tip and Prony term [N]
    relaxation_factor: Pair  # force of each tip relative to the long-term force
    palm_energy: float  # [J]
    tips_may_touch: bool  # the contact of both tips was evaluated
    has_extra_rows: bool  # an extra row may be active in this step
    extra: Annotated[Records[ExtraRow], EXTRA_ROWS]
    factors: Factors
