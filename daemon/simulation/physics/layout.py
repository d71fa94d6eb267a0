"""Where the plant keeps what: places in its one block of memory, and the numbers of its choices.

The plant's kernels work on one float64 array, since every array that a compiled function hands to
another costs time. It holds state, parameters, goals and scratch, in this order.
"""

from __future__ import annotations

import numpy as np

# State.
POSITION = 0  # q1, q2, x, y, φ
VELOCITY = 5
SHEAR = 10  # d_t of both tips on the object [m]
CURRENT = 12  # [A]
PALM_SHEAR = 14  # of the palm under each corner of the object [m]
MUTUAL_SHEAR = 18  # d_t of both tips on each other [m]
STEPS = 20  # sub-steps done
SAMPLES = 21  # contact samples taken
TOTAL = 22  # kinetic, elastic and gravitational energy [J]
LEDGER = 23  # the most that it may be by the work done on the hand [J]
GUARDED = 24  # sub-steps whose energy had to be brought down to that
CONTACT_D = 25  # truth at the state's instant, both tips each
CONTACT_THETA = 27
CONTACT_GAIN = 29
CONTACT_FORCE = 31
CONTACT_NORMAL = 33
CONTACT_TANGENTIAL = 35
CONTACT_RIM = 37
CONTACT_BEND = 39  # curvature of what is touched [1/m]
CONTACT_MUTUAL = 41  # 1 where the other tip is felt, not the object
STATE = 43  # length of the state

# Parameters of the tips.
MODULUS = 43  # of the real tip at zero strain [Pa]
RADIUS = 44
SCALE = 45  # real modulus over the table's
FRICTION = 46
LOSS = 47  # damping over stiffness [s]
RIM_STIFFNESS = 48
TOLERANCE = 49  # share of the energy that smooth steps may gain

# Parameters of hand and object.
STEP = 50  # sub-step [s]
HALF_SEPARATION = 51
LENGTH = 52
OFFSET = 53
SHAPE = 54  # of the object, by the numbers below
HALF_WIDTH = 55
HALF_HEIGHT = 56
ROUNDNESS = 57  # radius of a disc [m]
SHARE = 58  # stiffness of a tip on the object over that on a plane
EXTENT = 59  # farthest point from the object's centre [m]
OUTLINE = 60  # five places for each edge, see below
MASS = 80
INERTIA = 81  # of the object [kg·m²]
GRAVITY = 82  # x, y [m/s²]
TABLE_FORCE = 84  # Coulomb friction of the table on the object [N]
TABLE_TORQUE = 85  # likewise when it spins [N·m]
TABLE_SPEED = 86  # below it table friction is viscous [m/s]
TABLE_SPIN = 87  # [rad/s]
PALM = 88  # y of the palm [m]
PALM_FRICTION = 89
JOINT_INERTIA = 90
JOINT_DAMPING = 91
JOINT_FRICTION = 92
JOINT_SPEED = 93  # below it joint friction is viscous [rad/s]
TORQUE_CONSTANT = 94
ELECTRIC_TIME = 95  # lag of the current [s]
CURRENT_LIMIT = 96
STALL_CURRENT = 97
NO_LOAD_SPEED = 98
POSITION_GAIN = 99  # A/rad
RATE_GAIN = 100  # A·s/rad
STOP_LOW = 101  # end stops of both joints [rad]
STOP_HIGH = 103
STOP_STIFFNESS = 105
PRESENT = 106  # 1 where the tip takes part
JOINTS_HELD = 108
OBJECT_HELD = 109
SCRIPT_SPEED = 110  # m/s of a held object's to and fro; 0 leaves it still
SCRIPT_LEFT = 111  # how far it goes to the left [m], then to the right
SCRIPT_RIGHT = 112
SCRIPT_X = 113  # where it starts
SAMPLE_PERIOD = 114
PUSH = 115  # external force x, y [N] and torque [N·m] on the object

# Goals, one value for each joint.
MODE = 118
TORQUE_ON = 120
GOAL_Q = 122
GOAL_CURRENT = 124

# Scratch: a row for each tip on the object in both stages, likewise on each other; then vectors.
TIP = 128
MUTUAL = 288
TIP_ROW = 40
FORCES = 448  # on the five coordinates
DRAG = 453
LOAD = 458
MATRIX = 463
FIRST_X = 477  # and the currents' changes
FIRST_V = 484
SECOND_X = 489
SECOND_V = 494
MOTOR = 499  # slopes of both currents by angle, then by velocity
CHANGE = 503  # of both currents
TIP_PLACE = 505  # both tips' centres from the hand's origin, then their derivatives by the joint
PALM_ENERGY = 513
MUTUAL_NEAR = 514  # 1 where the tips on each other were looked at
EARLIER = 515  # positions, velocities, shears and currents before the step

# Rows of contacts that only some scenes have, over all five coordinates: for each corner on the
# palm its height and its slide, for each tip on the other one d, θ and d_t.
COUPLED = 535  # 1 where any of them may act in this step
EXTRA = 536
EXTRA_ROW = 8  # the row itself, its stiffness, its damping, and 1 + the place of its shear
EXTRA_ROWS = 14
PALM_ROWS = 8  # of them, two for each corner
EXTRA_RATE = 648  # stick rates of the palm's and the tips' mutual shears, in both stages
EXTRA_FIRST = 660  # their k1
EXTRA_SHEAR = 666  # the shears themselves as the second stage has them
FULL = 672  # the coupled matrix, factorised, and inverse pivots
MEMORY = 702  # length of the block

# Places in a tip's row.
D = 0  # normal displacement [m], negative is a gap
THETA = 1  # tilt of the object against the tip [rad]
GAIN = 2  # of the force against a plane: w(θ) and the face's curvature
FORCE = 3  # total force on the tip's base, what a pressure grid sums to [N]
ENERGY = 4  # elastic energy [J]
RIM = 5  # how far the rim is pressed into the object [m], 0 when free
NORMAL = 6  # N [N]
TANGENTIAL = 7  # T [N]
TIP_SHEAR = 8  # d_t within its limits [m]
SHEAR_RATE = 9  # stick rate of d_t [m/s]
BEND = 10  # curvature of what is touched [1/m]
JD = 11  # row of ∂d over (q, x, y, φ); of mutual contacts over (q1, q2)
JTHETA = 15  # likewise ∂θ
JT = 19  # row of d_t's increments
Q = 23  # generalised forces on (q, x, y, φ)
K_D = 27  # stiffness of the three rows d, θ, d_t
K_THETA = 28
K_T = 29
C_D = 30  # damping of the three rows
C_THETA = 31
C_T = 32
ALONG_D = 33  # forces along the three rows, with losses
ALONG_THETA = 34
ALONG_T = 35
RIM_ENERGY = 36  # of the rim alone, set where RIM is above 0
RIM_D = 37  # its derivatives by d and by θ
RIM_THETA = 38
TANGENT = 39  # tan θ, 0 where nothing soft is left

# Places of an edge of the object's outline, in the object's frame, edges counter-clockwise.
EDGE = 5
EDGE_X = 0  # where it starts [m]
EDGE_Y = 1
EDGE_NORMAL_X = 2  # outward
EDGE_NORMAL_Y = 3
EDGE_LENGTH = 4

# Columns of the ring of samples.
SAMPLE_SEQ = 0
SAMPLE_T = 1  # [s] since the start
SAMPLE_D = 2  # both tips each
SAMPLE_THETA = 4
SAMPLE_GAIN = 6
SAMPLE_BEND = 8
SAMPLE = 10

# A step's two evaluations. As numbers of NumPy's they don't make Numba compile a version for each.
FIRST_STAGE = np.int64(0)
SECOND_STAGE = np.int64(1)

# Shapes of the object.
NO_OBJECT = 0
RECTANGLE = 1
POLYGON = 2  # four edges
DISC = 3

# Operating modes, by the servos' own numbers.
CURRENT_MODE = 0
POSITION_MODE = 3
CURRENT_BASED_POSITION_MODE = 5
