"""The plant's record: its state, parameters, goals and scratch, one block that all kernels share.

Pairs are (left, right). Coordinates are the joint angles q1, q2 and the object's x, y, φ.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.compiled.layout import Pair, Record, Records

FloatArray = NDArray[np.float64]

Three = Annotated[FloatArray, 3]
Five = Annotated[FloatArray, 5]
Flags = Annotated[NDArray[np.int64], 2]  # 0 or 1 for each finger

# Shapes of the object.
NO_OBJECT = 0
POLYGON = 1  # convex
DISC = 2

# Rows of a tip's contact.
ALONG_D = 0
ALONG_THETA = 1
ALONG_SHEAR = 2

LAYERS = 8  # of a footprint, from its edge inwards, that slip one after the other
CORNERS = 8  # that an object may have
SHEARS = CORNERS + 2  # of the palm under each corner, then of each tip on the other
PALM_ROWS = 2 * CORNERS  # of the extra ones: height and slide of each corner
EXTRA_ROWS = PALM_ROWS + 6  # and d, θ and d_t of each tip on the other

Shears = Annotated[FloatArray, SHEARS]


class Motion(Record):
    """Coordinates, velocities, shears and currents: of a state, or their rates of change.

    The bristles' rates are those of their joints.
    """

    position: Five  # [rad], [rad], [m], [m], [rad]
    velocity: Five
    shear: Pair  # d_t of the tips on the object [m]
    extra_shear: Shears  # [m]
    bristles: Pair  # deflection of those of the joints' gears [rad]
    current: Pair  # [A]


class Sample(Record):
    """Contact of the tips at a frame's instant; fields as in :class:`TipContact`."""

    number: int  # -1: none
    t: float  # since the start [s]
    d: Pair
    theta: Pair
    gain: Pair
    firmness: Pair
    curvature: Pair
    tangential: Pair


class Edge(Record):
    """An edge of the object's outline, in the object's frame."""

    x: float  # where it starts [m]
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
    deepest: float  # d up to which their law holds [m]
    scale: float  # real modulus over the table's
    friction: float
    loss: float  # damping over stiffness [s]
    shear_stiffness: float  # over that of the springs
    shear_coupling: float  # of d_t with d and θ: 1 by springs, 0 by bristles
    creep: float  # share of a stuck shear that relaxes in a sub-step
    micro_slip: bool  # the footprint's edge slips before all of it does
    remembers: bool  # the tips relax
    relaxation: Three  # stiffness of each Prony term over the lasting one
    relaxed: Three  # share of it that relaxes in a sub-step
    rim_stiffness: float  # [N/m]
    tolerance: float  # share of the energy that smooth steps may gain
    half_separation: float  # of the pivots [m]
    length: float  # of a finger [m]
    offset: float  # of the tip from the finger's axis [m]
    present: Flags  # the tip takes part
    shape: int  # of the object
    half_width: float  # [m]
    half_height: float  # [m]
    roundness: float  # radius of a disc [m]
    factor: float  # stiffness of a tip on the object over that on a plane
    extent: float  # farthest point from the object's centre [m]
    corners: int  # that it has
    outline: Annotated[Records[Edge], CORNERS]  # counter-clockwise
    mass: float  # of the object [kg]
    inertia: float  # of the object [kg·m²]
    gravity: Pair  # x, y [m/s²]
    table_force: float  # Coulomb friction of the table on the object [N]
    table_torque: float  # likewise when it spins [N·m]
    table_speed: float  # below it table friction is viscous [m/s]
    table_spin: float  # [rad/s]
    palm: float  # y of the palm [m]
    palm_friction: float
    joint_inertia: float  # [kg·m²]
    joint_damping: float  # [N·m·s/rad]
    joint_friction: float  # [N·m]
    stribeck: float  # more at rest [N·m]
    load_friction: Pair  # share of the gears' torque, and more of it at rest
    stribeck_speed: float  # over which what is more at rest falls to 1/e [rad/s]
    presliding: float  # deflection at which the bristles' friction is fully built up [rad]
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
    script_speed: float  # of a held object's to and fro; 0 leaves it still [m/s]
    script_travel: Pair  # how far it goes to the left and to the right [m]
    script_x: float  # where it starts [m]


class Goals(Record):
    """Commands to the servos and loads on the object."""

    mode: Annotated[NDArray[np.int64], 2]
    torque_on: Flags
    q: Pair  # [rad]
    current: Pair  # [A]
    stiffness: Pair  # of the servos' position loops, over the factory's
    damping: Pair  # that they have more than the factory's [s of its stiffness]
    duty: Pair  # share of the supply that their motors may get
    load: Three  # external force x, y [N] and torque [N·m] on the object


class Finger(Record):
    """Position of a finger: its tip's centre from the hand's origin."""

    cosine: float  # of the joint angle
    sine: float
    x: float  # [m]
    y: float
    x_q: float  # derivatives by the joint angle [m/rad]
    y_q: float


class Gears(Record):
    """Friction of a joint's gears, carried by elastic bristles between the teeth."""

    deflection: float  # of the bristles when the step began [rad]
    level: float  # friction level then [N·m]
    bent: float  # deflection as last evaluated, within its limits [rad]
    friction: float  # friction level, likewise [N·m]
    stiffness: float  # of the bristles in the step's matrix [N·m/rad]


class TipContact(Record):
    """One tip on the object or on the other tip.

    Rows are d, θ, d_t; columns q, x, y, φ, or q1, q2 for tip on tip.
    """

    d: float  # normal displacement [m], negative: a gap
    theta: float  # tilt of the object against the tip [rad]
    sine: float  # of θ
    cosine: float
    tangent: float  # tan θ, 0 where nothing soft is left and for bristles
    gain: float  # of the force against a plane: w(θ) and the face's curvature
    curvature: float  # curvature of what is touched [1/m]
    travel: float  # how much deeper the step may lead [m]
    rate_d: float  # [m/s]
    rate_theta: float  # [rad/s]
    slip_rate: float  # velocity of what is touched less the tip's, along t [m/s]
    shear: float  # d_t within its limits [m]
    shear_variance: float  # variance of its layers' shears [m²]
    shear_rate: float  # stick rate of d_t [m/s]
    force: float  # total force on the tip's base, what a pressure grid sums to [N]
    energy: float  # elastic [J]
    normal: float  # N [N]
    tangential: float  # T [N]
    rim: float  # how far the rim is pressed into the object [m], 0 when free
    rim_energy: float  # of the rim alone, set where ``rim`` is above 0 [J]
    rim_d: float  # its derivatives by d [N] and by θ [N·m]
    rim_theta: float
    rows: Annotated[FloatArray, 3, 4]  # ∂d, ∂θ and the increments of d_t by the coordinates
    stiffness: Three  # along each row
    damping: Three
    along: Three  # forces along the rows, with losses
    forces: Annotated[FloatArray, 4]  # generalised, on the coordinates


class Stage(Record):
    """All contacts as one of a step's two evaluations finds them."""

    on_object: Annotated[Records[TipContact], 2]
    on_tip: Annotated[Records[TipContact], 2]
    extra_rate: Shears  # stick rates of the extra shears [m/s]


class ExtraRow(Record):
    """A row over the coordinates, of a contact that only some scenes have."""

    row: Five
    stiffness: float
    damping: float
    shear: int  # 1 + the place of its shear among the extra ones, 0: none


class Factors(Record):
    """The step's matrix over all coordinates, factorised as L D Lᵀ."""

    inverse: Five  # pivots
    lower: Annotated[FloatArray, 5, 5]


class Plant(Record):
    """The simulated hand."""

    parameters: Parameters
    goals: Goals
    state: Motion
    felt: Annotated[Records[TipContact], 2]  # by each tip now, of two contacts the firmer one
    on_other_tip: Flags  # that is on the other tip
    steps: int  # sub-steps done
    samples: int  # taken
    energy: float  # kinetic, elastic and gravitational [J]
    allowed: float  # the most that it may be by the work done on the hand [J]
    guarded: int  # sub-steps whose energy had to be brought down to that
    earlier: Motion  # the state before the step
    later: Motion  # where the second stage is evaluated
    first: Motion  # k1 of the step
    second: Motion  # k2
    stages: Annotated[Records[Stage], 2]
    fingers: Annotated[Records[Finger], 2]
    gears: Annotated[Records[Gears], 2]
    forces: Five  # on the coordinates, but for the motors'
    drag: Five  # friction over velocity
    external: Pair  # contacts' torque on each joint, as last evaluated [N·m]
    load: Five  # right-hand side of the step's equations
    motor_by_q: Pair  # slopes of the motors' torques for the matrix
    motor_by_rate: Pair
    layers: Annotated[FloatArray, 2, LAYERS]  # shear of each tip's layers [m]
    earlier_layers: Annotated[FloatArray, 2, LAYERS]  # before the step
    shear_variance: Pair  # their variance [m²]
    memory: Annotated[FloatArray, 2, 3]  # each tip's lasting force, followed by each term [N]
    firmness: Pair  # of each tip on the object, over the lasting one
    palm_energy: float  # [J]
    tips_near: bool  # the tips on each other were evaluated
    coupled: bool  # an extra row may act in this step
    extra: Annotated[Records[ExtraRow], EXTRA_ROWS]
    factors: Factors
