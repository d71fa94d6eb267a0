"""Where the plant keeps what: places in its state, parameters, goals and samples. Numbers only."""

from __future__ import annotations

# Places in the state.
POSITION = 0  # q1, q2, x, y, φ
VELOCITY = 5
SHEAR = 10  # d_t of both tips [m]
CURRENT = 12  # [A]
FACE = 14  # face that each tip works on
STEPS = 16  # sub-steps done
SAMPLES = 17  # contact samples taken
CONTACT_D = 18  # truth at the state's instant, both tips each
CONTACT_THETA = 20
CONTACT_GAIN = 22
CONTACT_FORCE = 24
CONTACT_NORMAL = 26
CONTACT_TANGENTIAL = 28
CONTACT_RIM = 30
STATE = 32

# Places in the parameters; the first six are the tips' (daemon/simulation/tip.py).
STEP = 6  # sub-step [s]
HALF_SEPARATION = 7
LENGTH = 8
OFFSET = 9
HALF_WIDTH = 10
HALF_HEIGHT = 11
MASS = 12
INERTIA = 13  # of the object [kg·m²]
GRAVITY = 14  # x, y [m/s²]
TABLE_FORCE = 16  # Coulomb friction of the table on the object [N]
TABLE_TORQUE = 17  # likewise when it spins [N·m]
TABLE_SPEED = 18  # below it table friction is viscous [m/s]
TABLE_SPIN = 19  # [rad/s]
JOINT_INERTIA = 20
JOINT_DAMPING = 21
JOINT_FRICTION = 22
JOINT_SPEED = 23  # below it joint friction is viscous [rad/s]
TORQUE_CONSTANT = 24
ELECTRIC_TIME = 25  # lag of the current [s]
CURRENT_LIMIT = 26
STALL_CURRENT = 27
NO_LOAD_SPEED = 28
POSITION_GAIN = 29  # A/rad
RATE_GAIN = 30  # A·s/rad
STOP_LOW = 31  # end stops of both joints [rad]
STOP_HIGH = 33
STOP_STIFFNESS = 35
PRESENT = 36  # 1 where the tip takes part
JOINTS_HELD = 38
OBJECT_HELD = 39
SCRIPT_SPEED = 40  # m/s of a held object's to and fro; 0 leaves it still
SCRIPT_LEFT = 41  # how far it goes to the left [m], then to the right
SCRIPT_RIGHT = 42
SCRIPT_X = 43  # where it starts
SAMPLE_PERIOD = 44
PUSH = 45  # external force x, y [N] and torque [N·m] on the object
PARAMETERS = 48

# Columns of the goals (2, GOALS).
MODE = 0
TORQUE_ON = 1
GOAL_Q = 2
GOAL_CURRENT = 3
GOALS = 4

CURRENT_MODE = 0
POSITION_MODE = 3
CURRENT_BASED_POSITION_MODE = 5

# Columns of the ring of samples.
SAMPLE_SEQ = 0
SAMPLE_T = 1  # [s] since the start
SAMPLE_D = 2  # both tips each
SAMPLE_THETA = 4
SAMPLE_GAIN = 6
SAMPLE = 8

# Rows of the work array (WORK_ROWS, tip.WORK): tips of both stages, then vectors.
WORK_ROWS = 12
FORCES = 4
DRAG = 5
FIRST_X = 6
FIRST_V = 7
SECOND_X = 8
SECOND_V = 9
MATRIX = 10
RIGHT = 11
