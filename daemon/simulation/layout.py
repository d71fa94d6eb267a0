"""Where the plant keeps what: places in its one block of memory, and the numbers of servo modes.

The plant's kernels work on one float64 array, since every array that a compiled function hands to
another costs time. It holds state, parameters, goals and scratch, in this order.
"""

from __future__ import annotations

# State.
POSITION = 0  # q1, q2, x, y, φ
VELOCITY = 5
SHEAR = 10  # d_t of both tips [m]
CURRENT = 12  # [A]
STEPS = 14  # sub-steps done
SAMPLES = 15  # contact samples taken
CONTACT_D = 16  # truth at the state's instant, both tips each
CONTACT_THETA = 18
CONTACT_GAIN = 20
CONTACT_FORCE = 22
CONTACT_NORMAL = 24
CONTACT_TANGENTIAL = 26
CONTACT_RIM = 28
CONTACT_ENERGY = 30
PALM_ENERGY = 32
STATE = 33  # length of the state

# Parameters of the tips.
MODULUS = 33  # of the real tip at zero strain [Pa]
RADIUS = 34
SCALE = 35  # real modulus over the table's
FRICTION = 36
LOSS = 37  # damping over stiffness [s]
RIM_STIFFNESS = 38
D_MAX = 39  # largest d the table answers [m]
# Parameters of hand and object.
STEP = 40  # sub-step [s]
HALF_SEPARATION = 41
LENGTH = 42
OFFSET = 43
HALF_WIDTH = 44
HALF_HEIGHT = 45
MASS = 46
INERTIA = 47  # of the object [kg·m²]
GRAVITY = 48  # x, y [m/s²]
TABLE_FORCE = 50  # Coulomb friction of the table on the object [N]
TABLE_TORQUE = 51  # likewise when it spins [N·m]
TABLE_SPEED = 52  # below it table friction is viscous [m/s]
TABLE_SPIN = 53  # [rad/s]
JOINT_INERTIA = 54
JOINT_DAMPING = 55
JOINT_FRICTION = 56
JOINT_SPEED = 57  # below it joint friction is viscous [rad/s]
TORQUE_CONSTANT = 58
ELECTRIC_TIME = 59  # lag of the current [s]
CURRENT_LIMIT = 60
STALL_CURRENT = 61
NO_LOAD_SPEED = 62
POSITION_GAIN = 63  # A/rad
RATE_GAIN = 64  # A·s/rad
STOP_LOW = 65  # end stops of both joints [rad]
STOP_HIGH = 67
STOP_STIFFNESS = 69
PRESENT = 70  # 1 where the tip takes part
JOINTS_HELD = 72
OBJECT_HELD = 73
SCRIPT_SPEED = 74  # m/s of a held object's to and fro; 0 leaves it still
SCRIPT_LEFT = 75  # how far it goes to the left [m], then to the right
SCRIPT_RIGHT = 76
SCRIPT_X = 77  # where it starts
SAMPLE_PERIOD = 78
PUSH = 79  # external force x, y [N] and torque [N·m] on the object

# Goals, one value for each joint.
MODE = 82
TORQUE_ON = 84
GOAL_Q = 86
GOAL_CURRENT = 88

# Scratch: a row for each tip in both stages, then vectors.
TIP = 90
TIP_ROW = 32
FORCES = 218  # on the five coordinates
DRAG = 223
LOAD = 228
MATRIX = 233
FIRST_X = 247  # and the currents' changes
FIRST_V = 254
SECOND_X = 259
SECOND_V = 264
MOTOR = 269  # slopes of both currents by angle, then by velocity
CHANGE = 273  # of both currents
PALM_STIFFNESS = 275  # over (y, φ): yy, yφ, φφ
PALM = 278  # y of the palm [m], a parameter
MEMORY = 279  # length of the block

# Places in a tip's row.
D = 0  # normal displacement [m], negative is a gap
THETA = 1  # tilt of the object against the tip [rad]
GAIN = 2  # w(θ), 1 where the tip is soft
FORCE = 3  # total force on the tip's base, what a pressure grid sums to [N]
ENERGY = 4  # elastic energy [J]
RIM = 5  # how far the rim is pressed into the object [m], 0 when free
NORMAL = 6  # N [N]
TANGENTIAL = 7  # T [N]
TIP_SHEAR = 8  # d_t within its limits [m]
SHEAR_RATE = 9  # stick rate of d_t [m/s]
JD = 10  # row of ∂d over (q, x, y, φ)
JTHETA = 14  # row of ∂θ over (q, x, y, φ)
JT = 18  # row of d_t's increments over (q, x, y, φ)
Q = 22  # generalised forces on (q, x, y, φ)
K_D = 26  # stiffness of the three rows d, θ, d_t
K_THETA = 27
K_T = 28
C_D = 29  # damping of the three rows
C_THETA = 30
C_T = 31

# Columns of the ring of samples.
SAMPLE_SEQ = 0
SAMPLE_T = 1  # [s] since the start
SAMPLE_D = 2  # both tips each
SAMPLE_THETA = 4
SAMPLE_GAIN = 6
SAMPLE = 8

# Operating modes, by the servos' own numbers.
CURRENT_MODE = 0
POSITION_MODE = 3
CURRENT_BASED_POSITION_MODE = 5
