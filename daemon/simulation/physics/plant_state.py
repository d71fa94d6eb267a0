"""Define the plant record shared by all kernels: state, parameters, goals and work data.

Pairs are (left, right). Coordinates are the joint angles q1, q2 and the object pose x, y, φ.
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

# Object shapes.
NO_OBJECT = 0
POLYGON = 1  # convex
DISC = 2

# Rows of a tip contact.
ALONG_D = 0
ALONG_THETA = 1
ALONG_SHEAR = 2

LAYERS = 8  # number of footprint layers that slip successively from the edge inwards
CORNERS = 8  # maximum number of corners of an object
SHEARS = CORNERS + 2  # palm shear at each corner, followed by the tip-on-tip shear of each tip
PALM_ROWS = 2 * CORNERS  # height and slip of each corner
EXTRA_ROWS = PALM_ROWS + 6  # adds d, θ and d_t of each tip's contact with the other tip

Shears = Annotated[FloatArray, SHEARS]


class Motion(Record):
    """Coordinates, velocities, shears and currents, or their rates of change.

    The bristle deflections change at the joint velocities.
    """

    position: FloatFive  # joint angles [rad], object x and y [m], object angle [rad]
    velocity: FloatFive
    shear: Pair  # d_t of each tip on the object [m]
    extra_shear: Shears  # [m]
    bristles: Pair  # gear bristle deflection [rad]
    current: Pair  # [A]


class Sample(Record):
    """Tip contacts at a frame's sample time; fields as in :class:`TipContact`."""

    number: int  # -1 for an empty entry
    t: float  # time since the start [s]
    d: Pair
    theta: Pair
    gain: Pair
    relaxation_factor: Pair
    curvature: Pair
    tangential: Pair


class Edge(Record):
    """Edge of the object outline in the object frame."""

    x: float  # start point [m]
    y: float
    normal_x: float  # outward
    normal_y: float
    length: float  # [m]


class Parameters(Record):
    """Parameters that the settings define."""

    step: float  # sub-step [s]
    sample_period: float  # [s]
    modulus: float  # zero-strain modulus of the real tip [Pa]
    radius: float  # tip radius [m]
    deepest: float  # maximum d for which the contact law is valid [m]
    scale: float  # ratio of the real modulus to the table modulus
    friction: float
    loss: float  # ratio of damping to stiffness [s]
    shear_stiffness: float  # ratio of shear stiffness to that of the spring model
    shear_coupling: float  # coupling of d_t with d and θ: 1 for springs, 0 for bristles
    creep: float  # fraction of a sticking shear that relaxes per sub-step
    micro_slip: bool  # True if the edge of the footprint slips first
    tips_relax: bool
    relaxation: FloatTriple  # Prony term stiffnesses relative to the long-term stiffness
    relaxation_step: FloatTriple  # fraction of each Prony term that relaxes per sub-step
    rim_stiffness: float  # [N/m]
    tolerance: float  # relative energy gain that is allowed in smooth steps
    half_separation: float  # half the pivot separation [m]
    length: float  # finger length [m]
    offset: float  # tip offset from the finger axis [m]
    finger_present: Flags  # True if the finger is in the scene
    shape: int  # object shape
    half_width: float  # [m]
    half_height: float  # [m]
    roundness: float  # radius of a disc [m]
    factor: float  # ratio of tip stiffness on the object to tip stiffness on a plane
    extent: float  # maximum distance of an outline point from the object centre [m]
    corners: int  # used entries of the outline
    outline: Annotated[Records[Edge], CORNERS]  # counter-clockwise
    mass: float  # object mass [kg]
    inertia: float  # object moment of inertia [kg·m²]
    gravity: Pair  # x, y [m/s²]
    table_force: float  # Coulomb friction between table and object [N]
    table_torque: float  # Coulomb friction torque between table and object [N·m]
    table_speed: float  # speed below which table friction is viscous [m/s]
    table_spin: float  # angular speed below which table friction is viscous [rad/s]
    palm: float  # y coordinate of the palm [m]
    palm_friction: float
    joint_inertia: float  # [kg·m²]
    joint_damping: float  # [N·m·s/rad]
    joint_friction: float  # [N·m]
    stribeck: float  # additional friction at standstill [N·m]
    load_friction: Pair  # ratio of friction to gear torque, and the additional ratio at standstill
    stribeck_speed: float  # speed at which the additional friction has decreased to 1/e [rad/s]
    presliding: float  # bristle deflection at which the gears slip [rad]
    torque_constant: float  # [N·m/A]
    electric_time: float  # time constant of the current [s]
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
    script_speed: float  # speed of a held object that moves back and forth [m/s]
    script_travel: Pair  # travel to the left and to the right [m]
    script_x: float  # start position [m]


class Goals(Record):
    """Servo commands and object loads."""

    mode: Annotated[NDArray[np.int64], 2]
    torque_on: Flags
    q: Pair  # [rad]
    current: Pair  # [A]
    stiffness: Pair  # position-loop stiffness relative to the factory setting
    damping: Pair  # ratio of additional damping to the factory stiffness [s]
    duty: Pair  # motor voltage limit as a fraction of the supply voltage
    load: FloatTriple  # external force x, y [N] and external torque [N·m] on the object


class Finger(Record):
    """Finger position: tip centre in the hand frame."""

    cosine: float  # cosine of the joint angle
    sine: float
    x: float  # [m]
    y: float
    x_q: float  # derivative with respect to the joint angle [m/rad]
    y_q: float


class Gears(Record):
    """Gear friction of a joint, modelled by elastic bristles between the teeth."""

    deflection: float  # bristle deflection at the start of the step [rad]
    level: float  # friction level at the start of the step [N·m]
    limited_deflection: float  # deflection in the last evaluation, after it was limited [rad]
    friction: float  # friction level in the last evaluation [N·m]
    stiffness: float  # bristle stiffness in the step matrix [N·m/rad]


class TipContact(Record):
    """Contact of one tip with the object or the other tip.

    The rows are d, θ, d_t. The columns are q, x, y, φ, or q1, q2 for a tip-to-tip contact.
    """

    d: float  # normal displacement, negative for a gap [m]
    theta: float  # tilt of the object relative to the tip [rad]
    sine: float  # sin θ
    cosine: float
    tangent: float  # tan θ, or 0 for bristles and beyond the soft hemisphere
    gain: float  # force divided by the force on a plane; includes w(θ) and face curvature
    curvature: float  # curvature of the touched surface [1/m]
    travel: float  # largest possible increase in d during this step [m]
    rate_d: float  # [m/s]
    rate_theta: float  # [rad/s]
    slip_rate: float  # tangential velocity of the surface relative to the tip [m/s]
    shear: float  # d_t after it was limited [m]
    shear_variance: float  # shear variance of the layers [m²]
    shear_rate: float  # rate of d_t without slip [m/s]
    force: float  # total force on the tip base, equal to the sum over a pressure grid [N]
    energy: float  # elastic energy [J]
    normal: float  # N [N]
    tangential: float  # T [N]
    rim: float  # rim penetration depth, or 0 without contact [m]
    rim_energy: float  # rim energy [J], which is valid only if ``rim`` is above 0
    rim_d: float  # derivatives of the rim energy with respect to d [N] and θ [N·m]
    rim_theta: float
    rows: Annotated[FloatArray, 3, 4]  # derivatives of d, θ and d_t with respect to the coordinates
    stiffness: FloatTriple  # stiffness along each row
    damping: FloatTriple
    along: FloatTriple  # forces along the rows, including damping
    forces: Annotated[FloatArray, 4]  # generalised forces on the coordinates


class Stage(Record):
    """All contacts for one of the two evaluations in a step."""

    on_object: Annotated[Records[TipContact], 2]
    on_tip: Annotated[Records[TipContact], 2]
    extra_rate: Shears  # extra shear rates without slip [m/s]


class ExtraRow(Record):
    """Matrix row over all coordinates, for a contact that occurs only in some scenes."""

    row: FloatFive
    stiffness: float
    damping: float
    shear: int  # index of the row's extra shear plus 1, or 0 if the row has none


class Factors(Record):
    """Step matrix over all coordinates, factorised as L D Lᵀ."""

    inverse: FloatFive  # inverse pivots
    lower: Annotated[FloatArray, 5, 5]


class Plant(Record):
    """All data of the simulated hand."""

    parameters: Parameters
    goals: Goals
    state: Motion
    # Current contact of each tip: the stronger contact if a tip has two.
    sensed_contact: Annotated[Records[TipContact], 2]
    on_other_tip: Flags  # 1 if the contact is with the other tip
    step_count: int  # number of completed sub-steps
    sample_count: int  # number of samples taken
    energy: float  # kinetic, elastic and gravitational energy [J]
    energy_limit: float  # maximum energy, given the work done on the hand [J]
    limited_step_count: int  # number of sub-steps that the energy guard has limited
    last_state: Motion  # state before the step
    stage_state: Motion  # state of the second stage
    first: Motion  # k1 of the step
    second: Motion  # k2 of the step
    stages: Annotated[Records[Stage], 2]
    fingers: Annotated[Records[Finger], 2]
    gears: Annotated[Records[Gears], 2]
    forces: FloatFive  # generalised forces, excluding the motors
    drag: FloatFive  # ratio of friction to velocity
    external: Pair  # contact torque on each joint in the last evaluation [N·m]
    load: FloatFive  # right-hand side of the step equations
    motor_by_q: Pair  # motor torque derivatives for the matrix
    motor_by_rate: Pair
    layers: Annotated[FloatArray, 2, LAYERS]  # layer shears of each tip [m]
    last_layers: Annotated[FloatArray, 2, LAYERS]  # layer shears before the step [m]
    shear_variance: Pair  # variance of the layer shears [m²]
    relaxation_state: Annotated[FloatArray, 2, 3]  # state of each tip's Prony terms [N]
    relaxation_factor: Pair  # ratio of tip force to long-term tip force
    palm_energy: float  # [J]
    tips_may_touch: bool  # True if the tip-to-tip contact was evaluated
    has_extra_rows: bool  # True if extra rows may be active in this step
    extra: Annotated[Records[ExtraRow], EXTRA_ROWS]
    factors: Factors
