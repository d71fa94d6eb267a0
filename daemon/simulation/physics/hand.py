"""The simulated hand: the plant's state, what the servos tell it and what its tips feel.

Time moves only by :meth:`SimulatedHand.advance`; the state depends on nothing but the settings and
on when which command came, so that two runs are the same to the bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.profile.factory import make_material, make_table
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics import layout, plant
from softfinger.daemon.simulation.physics.parameters import set_parameters, stiff_step
from softfinger.kinematics.contact.table import ContactTable

FloatArray = NDArray[np.float64]

SPARE_SAMPLES = 8
LONGEST_ADVANCE = 10.0  # s of simulated time in one kernel call

_ROWS = tuple(
    row + finger * layout.TIP_ROW for row in (layout.TIP, layout.MUTUAL) for finger in range(2)
)
_MODES = (
    layout.CURRENT_MODE,
    layout.POSITION_MODE,
    layout.CURRENT_BASED_POSITION_MODE,
)


class SimulatedHand:
    """Two jointed fingers with soft tips and the object between them, in one plane.

    Tips touch the object, or each other where it isn't between them; what a tip tells is the
    contact that presses more. The object may lie on the palm.

    Which tips take part is ``settings.scene.fingers``. With one finger the object is fixed to the
    bench, as in a compression test. Without servos (``settings.servos.backend`` is ``none``) the
    joints stay at ``settings.hand.open_angle``, and with ``simulation.compression_speed`` above 0
    the object is moved to and fro, onto the left tip and onto the right one, 0.4 radii deep.

    The arrays given out are views of the state, (2,) left first: valid until the next ``advance``.
    """

    def __init__(
        self,
        settings: Settings,
        start: float = 0.0,
        table: ContactTable | None = None,
        step: float | None = None,
    ) -> None:
        """Build the plant at rest, torque off, at time ``start`` [s].

        ``table`` is the contact table of the settings' tip and material, built when not given;
        ``step`` [s] the sub-step, chosen from the stiffness when not given. Raises SettingsError
        for settings that no plant can be built from.
        """
        if table is None:
            table = make_table(settings, make_material(settings.material), None)
        self.table = table
        self.step = stiff_step(settings, table) if step is None else step
        self.start = start
        self.memory = np.zeros(layout.MEMORY)
        set_parameters(self.memory, settings, table, self.step)
        memory, simulation = self.memory, settings.simulation
        memory[layout.POSITION : layout.POSITION + 2] = settings.hand.open_angle
        memory[layout.POSITION + 2 : layout.POSITION + 4] = simulation.object_position
        memory[layout.POSITION + 4] = simulation.object_angle
        memory[layout.MODE : layout.MODE + 2] = layout.CURRENT_BASED_POSITION_MODE
        # As many as may be on their way to a sensor's reader.
        latest = simulation.tactile_delay + simulation.tactile_jitter
        kept = math.ceil(latest * settings.tactile.rate) + SPARE_SAMPLES
        self._ring = np.full((kept, layout.SAMPLE), -1.0)
        self._done = 0
        self._torque_until = math.inf
        self._per_step = 1.0 / self.step
        self.q = self._pair(layout.POSITION)  # rad
        self.dq = self._pair(layout.VELOCITY)  # rad/s
        self.current = self._pair(layout.CURRENT)  # A
        self.object_pose = memory[layout.POSITION + 2 : layout.POSITION + 5]  # x, y, φ
        self.object_velocity = memory[layout.VELOCITY + 2 : layout.VELOCITY + 5]
        self.d = self._pair(layout.CONTACT_D)  # m, negative: a gap
        self.theta = self._pair(layout.CONTACT_THETA)  # rad
        self.force = self._pair(layout.CONTACT_FORCE)  # F on the tip's base [N]
        self.normal = self._pair(layout.CONTACT_NORMAL)  # N [N]
        self.tangential = self._pair(layout.CONTACT_TANGENTIAL)  # T [N]
        self.shear = self._pair(layout.SHEAR)  # d_t [m]
        # How far the backing plate's rim is pressed into the object: > 0 is past the tip's limit.
        self.rim = self._pair(layout.CONTACT_RIM)  # m
        self.mutual = self._pair(layout.CONTACT_MUTUAL)  # 1 where the other tip is felt
        self._run(0)

    @property
    def t(self) -> float:
        """Time the state belongs to [s]."""
        return self.start + self._done * self.step

    def advance(self, t: float) -> None:
        """Step to the last sub-step at or before ``t`` [s]; nothing when that has passed."""
        if t > self._torque_until:
            self._advance(self._torque_until)
            self.memory[layout.TORQUE_ON : layout.TORQUE_ON + 2] = 0.0
            self._torque_until = math.inf
        self._advance(t)

    def _advance(self, t: float) -> None:
        # The small addend keeps ticks that are multiples of the sub-step on their sub-step.
        behind = int((t - self.start) * self._per_step + 1e-6) - self._done
        most = int(LONGEST_ADVANCE * self._per_step)
        while behind > 0:
            count = min(behind, most)
            self._run(count)
            behind -= count

    def refresh(self) -> None:
        """Bring the tips' truth up to a state that was written by hand; time stays."""
        self._run(0)

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """Tell a servo its mode, torque, goal angle [rad] and goal current [A], from now on.

        Modes have Dynamixel's numbers: 0 current, 3 position, 5 current-based position. Raises
        ValueError for another mode or a goal that is not finite.
        """
        if mode not in _MODES:
            raise ValueError(f"operating mode {mode} is not simulated; {_MODES} are")
        if not (math.isfinite(goal_q) and math.isfinite(goal_current)):
            raise ValueError(f"goals must be finite, not {goal_q!r} rad, {goal_current!r} A")
        memory = self.memory
        memory[layout.MODE + joint] = mode
        memory[layout.TORQUE_ON + joint] = 1.0 if torque_on else 0.0
        memory[layout.GOAL_Q + joint] = goal_q
        memory[layout.GOAL_CURRENT + joint] = goal_current

    def hold_torque_until(self, t: float) -> None:
        """Let both servos drop their torque by themselves at ``t`` [s]; infinity ends it."""
        self._torque_until = t

    def push(self, force_x: float, force_y: float, torque: float = 0.0) -> None:
        """Push the object with this force [N] and torque [N·m] from now on; zeros end it."""
        self.memory[layout.PUSH : layout.PUSH + 3] = force_x, force_y, torque

    @property
    def samples(self) -> int:
        """Contact samples taken so far; number k was taken at ``start`` + k / tactile.rate."""
        return int(self.memory[layout.SAMPLES])

    @property
    def kept_samples(self) -> int:
        """How many of the newest samples are kept."""
        return len(self._ring)

    def sample(self, number: int) -> FloatArray:
        """Row of layout.SAMPLE columns: seq, t since start, d, θ, gain and curvature of both tips.

        The gain is the force's over that on a plane at d and θ; the curvature [1/m] is that of what
        is touched, across the hand's plane.

        Raises LookupError for one that is not taken yet or has left the ring.
        """
        row: FloatArray = self._ring[number % len(self._ring)]
        if row[layout.SAMPLE_SEQ] != number:
            raise LookupError(f"sample {number} is not kept; {self.samples} were taken")
        return row

    def energy(self) -> float:
        """Kinetic, elastic and gravitational energy of joints, tips and object [J]."""
        m = self.memory
        rates = m[layout.VELOCITY : layout.VELOCITY + 5]
        joint, mass = m[layout.JOINT_INERTIA], m[layout.MASS]
        inertia = np.array([joint, joint, mass, mass, m[layout.INERTIA]])
        low, high = self._pair(layout.STOP_LOW), self._pair(layout.STOP_HIGH)
        beyond = np.minimum(self.q - low, 0.0) + np.maximum(self.q - high, 0.0)
        return float(
            0.5 * inertia @ rates**2
            - mass * self._pair(layout.GRAVITY) @ self.object_pose[:2]
            + 0.5 * m[layout.STOP_STIFFNESS] * beyond @ beyond
            + sum(m[row + layout.ENERGY] for row in _ROWS)
            + m[layout.PALM_ENERGY]
        )

    def _pair(self, place: int) -> FloatArray:
        return self.memory[place : place + 2]

    def _run(self, count: int) -> None:
        plant.step(self.memory, self.table.data, self._ring, count)
        self._done += count
