"""Define the record that all plant kernels share.

Pairs are (left, right). The coordinates are the joint angles q1 and q2 and the object pose x, y, φ.
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

STOP_STIFFNESS = 500.0  # stiffness of the joints' end stops [N·m/rad]
LAYERS = 8  # number of footprint layers, which slip one after another from the edge inwards
CORNERS = 8  # maximum number of corners of an object
SHEARS = CORNERS + 2  # palm shear of each corner, then tip-to-tip shear of each tip
PALM_ROWS = 2 * CORNERS  # two rows for each corner: height and slip
EXTRA_ROWS = PALM_ROWS + 6  # palm rows, plus tip-to-tip rows d, θ and d_t of each tip

Shears = Annotated[FloatArray, SHEARS]


class Motion(Record):
    """Coordinates, velocities, shears and currents, or their rates of change.

    The bristle deflections change at the same rates as the joint angles.
    """

    position: FloatFive  # joint angles [rad], object x and y [m], object angle [rad]
    velocity: FloatFive
    shear: Pair  # d_t of each tip on the object [m]
    extra_shear: Shears  # [m]
    bristles: Pair  # gear bristle deflection [rad]
    current: Pair  # [A]


class Sample(Record):
    """Tip contacts at the time when a frame is sampled; see :class:`TipContact`."""

    number: int  # sample k is taken k / tactile.rate after the start; -1 for an empty entry
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
    """Plant parameters. Those with the name of a simulation setting are copies of the setting."""

    step: float  # sub-step [s]
    sample_period: float  # [s]
    modulus: float  # modulus of the real tip at zero strain [Pa]
    radius: float  # tip radius [m]
    deepest: float  # maximum d at which the contact law is valid [m]
    modulus_scale: float  # ratio of the real modulus to the modulus of the contact table
    tip_friction: float
    tip_loss: float  # ratio of damping to stiffness [s]
    tip_shear_stiffness: float  # ratio of the shear stiffness to that of the spring model
    shear_coupling: float  # 1 if d_t is coupled with d and θ (springs), else 0 (bristles)
    creep: float  # fraction of the shear that relaxes per sub-step while the tip sticks
    tip_micro_slip: bool  # True if the edge of the footprint slips first
    tips_relax: bool
    tip_relaxation: FloatTriple  # stiffness of each Prony term relative to the long-term stiffness
    relaxation_step: FloatTriple  # fraction of each Prony term that relaxes per sub-step
    half_separation: float  # half the distance between the pivots [m]
    length: float  # finger length [m]
    offset: float  # tip offset from the finger axis [m]
    finger_present: Flags  # True if the finger is in the scene
    shape: int  # object shape
    roundness: float  # radius of a disc [m]
    factor: float  # stiffness of a tip on the object relative to its stiffness on a plane
    extent: float  # maximum distance from the object centre to the outline [m]
    corners: int  # number of corners in ``outline``
    outline: Annotated[Records[Edge], CORNERS]  # counter-clockwise
    mass: float  # object mass [kg]
    inertia: float  # moment of inertia of the object [kg·m²]
    gravity: Pair  # x, y [m/s²]
    table_force: float  # Coulomb friction between table and object [N]
    table_torque: float  # Coulomb friction torque between table and object [N·m]
    table_spin: float  # angular speed below which table friction is viscous [rad/s]
    palm: float  # y coordinate of the palm [m]
    palm_friction: float
    joint_inertia: float  # [kg·m²]
    joint_damping: float  # [N·m·s/rad]
    joint_friction: float  # [N·m]
    joint_stribeck: float  # additional friction at standstill [N·m]
    joint_load_friction: Pair  # ratio of friction to gear torque, and its increase at standstill
    joint_stribeck_speed: float  # speed at which the additional friction has fallen to 1/e [rad/s]
    joint_presliding: float  # bristle deflection at which the gears slip [rad]
    torque_constant: float  # [N·m/A]
    stall_current: float  # [A]
    no_load_speed: float  # [rad/s]
    position_gain: float  # [A/rad]
    rate_gain: float  # [A·s/rad]
    stop_low: Pair  # end stops [rad]
    stop_high: Pair
    joints_held: bool
    object_held: bool
    script_speed: float  # speed at which a held object moves back and forth [m/s]
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
    """Position of a finger's tip centre in the hand frame."""

    cosine: float  # cosine of the joint angle
    sine: float
    x: float  # [m]
    y: float
    x_q: float  # derivative of ``x`` with respect to the joint angle [m/rad]
    y_q: float


class Gears(Record):
    """Gear friction of a joint, modelled by elastic bristles between the teeth."""

    deflection: float  # bristle deflection at the start of the step [rad]
    level: float  # friction level at the start of the step [N·m]
    limited_deflection: float  # limited deflection in the last evaluation [rad]
    friction: float  # friction level in the last evaluation [N·m]
    stiffness: float  # bristle stiffness in the step matrix [N·m/rad]


class TipContact(Record):
    """Contact of one tip with the object or with the other tip."""

    d: float  # normal displacement, negative for a gap [m]
    theta: float  # tilt of the object relative to the tip [rad]
    sine: float  # sin θ
    cosine: float
    tangent: float  # tan θ, or 0 for bristles and beyond the soft hemisphere
    gain: float  # ratio of the force to the force on a plane, due to w(θ) and curvature
    curvature: float  # curvature of the touched surface [1/m]
    travel: float  # largest possible increase in d during this step [m]
    rate_d: float  # [m/s]
    rate_theta: float  # [rad/s]
    slip_rate: float  # tangential velocity of the surface relative to the tip [m/s]
    shear: float  # d_t, limited by friction [m]
    shear_variance: float  # variance of the layer shears [m²]
    shear_rate: float  # rate of d_t without slip [m/s]
    force: float  # force on the tip base, equal to the sum over a pressure grid [N]
    energy: float  # elastic energy [J]
    normal: float  # N [N]
    tangential: float  # T [N]
    rim: float  # rim penetration depth, negative for a gap [m]
    rim_energy: float  # rim energy [J], valid only if ``rim`` is above 0
    rim_d: float  # derivatives of the rim energy with respect to d [N] and θ [N·m]
    rim_theta: float
    rows: Annotated[FloatArray, 3, 5]  # derivatives of d, θ and d_t with respect to the coordinates
    stiffness: FloatTriple  # stiffness along each row
    damping: FloatTriple
    along: FloatTriple  # forces along d, θ and d_t, including damping


class Stage(Record):
    """All contacts in one of the two evaluations of a step."""

    on_object: Annotated[Records[TipContact], 2]
    on_tip: Annotated[Records[TipContact], 2]
    extra_rate: Shears  # rates of the extra shears without slip [m/s]


class ExtraRow(Record):
    """Row of the step matrix for a contact that occurs only in some scenes."""

    row: FloatFive
    stiffness: float
    damping: float
    shear: int  # 1 + index of the row's extra shear, or 0 without an extra shear


class Plant(Record):
    """All data of the simulated hand."""

    parameters: Parameters
    goals: Goals
    state: Motion
    # Current contact of each tip, or the stronger contact if a tip has two.
    sensed_contact: Annotated[Records[TipContact], 2]
    on_other_tip: Flags  # 1 if the contact is with the other tip
    step_count: int  # number of completed sub-steps
    sample_count: int  # number of samples taken
    energy: float  # kinetic, elastic and gravitational energy [J]
    energy_limit: float  # upper limit of the energy, including the work of motors and loads [J]
    limited_step_count: int  # number of sub-steps that the energy guard has limited
    last_state: Motion  # state before the step
    stage_state: Motion  # state of the second stage
    no_motion: Motion  # zeros
    first: Motion  # k1 of the step
    second: Motion  # k2 of the step
    stages: Annotated[Records[Stage], 2]
    fingers: Annotated[Records[Finger], 2]
    gears: Annotated[Records[Gears], 2]
    forces: FloatFive  # generalised forces without the motor torques
    drag: FloatFive  # ratio of viscous friction to velocity
    external: Pair  # contact torque on each joint in the last evaluation [N·m]
    load: FloatFive  # right-hand side of the step equations
    motor_by_q: Pair  # derivatives of the motor torques, for the step matrix
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
    # Factorisation L D Lᵀ of the step matrix: L below the diagonal, and D⁻¹ on the diagonal.
    factors: Annotated[FloatArray, 5, 5]
