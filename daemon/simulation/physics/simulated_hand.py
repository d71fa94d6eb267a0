"""The simulated hand: what its servos are commanded, where it is, what its tips feel.

Time moves only by :meth:`SimulatedHand.advance`; the state depends on nothing but the settings and
on when which command came, so that two runs are the same to the bit.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from softfinger.daemon.profile.factory import make_material, make_table
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.measurement_faults import MeasurementFaults
from softfinger.daemon.simulation.physics import plant
from softfinger.daemon.simulation.physics.parameters import set_parameters, stiff_step
from softfinger.daemon.simulation.physics.plant_state import (
    CURRENT_BASED_POSITION_MODE,
    CURRENT_MODE,
    POSITION_MODE,
    Plant,
    Sample,
)
from softfinger.kinematics.contact.table import ContactTable

SPARE_SAMPLES = 8
LONGEST_ADVANCE = 10.0  # s of simulated time in one kernel call

_MODES = (CURRENT_MODE, POSITION_MODE, CURRENT_BASED_POSITION_MODE)


class SimulatedHand:
    """Two jointed fingers with soft tips and the object between them, in one plane.

    Tips touch the object, or each other where it isn't between them; of two contacts a tip
    feels the one that presses more. The object may lie on the palm.

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
        self.plant = Plant()
        set_parameters(self.plant.parameters, settings, table, self.step)
        state, simulation = self.plant.state, settings.simulation
        state.position[:2] = settings.hand.open_angle
        state.position[2:4] = simulation.object_position
        state.position[4] = simulation.object_angle
        self._first_pose = state.position[2:].copy()
        goals = self.plant.goals
        goals.mode[:] = CURRENT_BASED_POSITION_MODE
        # As many as may be on their way to a sensor's reader.
        latest = simulation.tactile_delay + simulation.tactile_jitter
        stored = math.ceil(latest * settings.tactile.rate) + SPARE_SAMPLES
        self._ring = np.zeros(stored, Sample.dtype)
        self._ring["number"] = -1
        self._rows = [Sample(self._ring[k : k + 1]) for k in range(stored)]
        self._done = 0
        self._torque_until = math.inf
        self._per_step = 1.0 / self.step
        self.q = state.position[:2]  # rad
        self.dq = state.velocity[:2]  # rad/s
        self.current = state.current  # A
        self.object_pose = state.position[2:]  # x, y, φ
        self.object_velocity = state.velocity[2:]
        felt: Any = self.plant.felt
        self.d = felt.array["d"]  # m, negative: a gap
        self.theta = felt.array["theta"]  # rad
        self.force = felt.array["force"]  # F on the tip's base [N]
        self.normal = felt.array["normal"]  # N [N]
        self.tangential = felt.array["tangential"]  # T [N]
        self.shear = state.shear  # d_t [m]
        # How far the backing plate's rim is pressed into the object: > 0 is past the tip's limit.
        self.rim = felt.array["rim"]  # m
        self.on_other_tip = self.plant.on_other_tip  # 1: the other tip is felt, not the object
        self.torque_on = goals.torque_on  # 1 where a servo has torque
        self._mode, self._goal_q, self._goal_current = goals.mode, goals.q, goals.current
        # Of each finger's tactile sensor and servo, left first; the hand itself is as it was.
        self.measurement_faults = MeasurementFaults(), MeasurementFaults()
        self._run(0)

    @property
    def t(self) -> float:
        """Time the state belongs to [s]."""
        return self.start + self._done * self.step

    def advance(self, t: float) -> None:
        """Step to the last sub-step at or before ``t`` [s]; nothing when that has passed."""
        if t > self._torque_until:
            self._advance(self._torque_until)
            self.torque_on[:] = 0
            self._torque_until = math.inf
        self._advance(t)

    def _advance(self, t: float) -> None:
        # The small addend keeps ticks that are multiples of the sub-step on their sub-step.
        remaining = int((t - self.start) * self._per_step + 1e-6) - self._done
        steps_max = int(LONGEST_ADVANCE * self._per_step)
        while remaining > 0:
            count = min(remaining, steps_max)
            self._run(count)
            remaining -= count

    def refresh(self) -> None:
        """Evaluate the contacts of a state that was written from outside; time stays."""
        self._run(0)

    def place_object(self) -> None:
        """Put the object back where it was at the start, at rest and without a load."""
        self.object_pose[:], self.object_velocity[:] = self._first_pose, 0.0
        self.load()
        self.refresh()

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """Set a servo's mode, torque, goal angle [rad] and goal current [A].

        Modes have Dynamixel's numbers: 0 current, 3 position, 5 current-based position. Raises
        ValueError for another mode or a goal that is not finite.
        """
        if mode not in _MODES:
            raise ValueError(f"operating mode {mode} is not simulated; {_MODES} are")
        if not (math.isfinite(goal_q) and math.isfinite(goal_current)):
            raise ValueError(f"goals must be finite, not {goal_q!r} rad, {goal_current!r} A")
        self._mode[joint] = mode
        self.torque_on[joint] = torque_on
        self._goal_q[joint] = goal_q
        self._goal_current[joint] = goal_current

    def measured_current(self, joint: int) -> float:
        """Return the motor current [A] that a servo's own sensor shows."""
        scale = self.measurement_faults[joint]("current", self.t)
        return scale * self.current.item(joint)

    def hold_torque_until(self, t: float) -> None:
        """End both servos' torque at ``t`` [s]; infinity: don't."""
        self._torque_until = t

    def apply_load(self, force_x: float, force_y: float, torque: float = 0.0) -> None:
        """Push the object with this force [N] and torque [N·m] from now on; zeros end it."""
        self.plant.goals.load[:] = force_x, force_y, torque

    def load(self, push: float = 0.0, twist: float = 0.0) -> None:
        """Load the object from now on: along its faces, away from the palm [N], and round [N·m].

        The force keeps its direction when the object turns; zeros end it.
        """
        angle = self.object_pose.item(2)
        self.apply_load(-push * math.sin(angle), push * math.cos(angle), twist)

    @property
    def samples(self) -> int:
        """Contact samples taken so far; number k was taken at ``start`` + k / tactile.rate."""
        return self.plant.samples

    @property
    def stored_samples(self) -> int:
        """Number of newest samples that are stored."""
        return len(self._rows)

    def sample(self, number: int) -> Sample:
        """Return sample ``number``, valid until a newer one replaces it.

        Raises LookupError for one that is not taken yet or is overwritten.
        """
        row = self._rows[number % len(self._rows)]
        if row.number != number:
            raise LookupError(f"sample {number} is not kept; {self.samples} were taken")
        return row

    def energy(self) -> float:
        """Return kinetic, elastic and gravitational energy of joints, tips and object [J]."""
        return self.plant.energy

    def _run(self, count: int) -> None:
        plant.step(self.plant.array, self.table.data, self._ring, count)
        self._done += count
