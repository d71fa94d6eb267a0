"""Simulate the hand's motion and tip contacts in response to servo commands.

Only :meth:`SimulatedHand.advance` advances time. The state depends only on the settings, the
commands and their times, so runs are reproducible bit for bit. Physical constants that are not
settings have plausible values, but no published source.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from softfinger.daemon.profile.factory import make_table
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import CURRENT_BASED_POSITION_MODE, by_name
from softfinger.daemon.simulation.faults import (
    ALL,
    MEASUREMENT_FAULTS,
    OBJECT,
    WELL,
    FaultEvent,
    MeasurementFaults,
)
from softfinger.daemon.simulation.physics import plant
from softfinger.daemon.simulation.physics.forces import TABLE_SPEED
from softfinger.daemon.simulation.physics.plant_state import NO_OBJECT, Parameters, Plant, Sample
from softfinger.daemon.simulation.physics.shapes import shape_of
from softfinger.daemon.simulation.servo_model.servo_joint import ServoHeat
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.hand.geometry import HandGeometry

SPARE_SAMPLE_COUNT = 8
ADVANCE_MAX = 10.0  # maximum simulated time per kernel call [s]

STANDARD_GRAVITY = 9.80665  # m/s²
STEP_MAX = 0.25e-3  # s
STEP_MIN = 0.05e-3  # s
PHASE_MAX = 0.25  # maximum phase advance of the fastest oscillation per sub-step [rad]
FULL_EFFORT_ERROR = 0.27  # error at which the position loop commands the stall current [rad]
STOP_CLEARANCE = 0.05  # distance from the commanded range to the mechanical end stops [rad]
COMPRESSION_DEPTH = 0.4  # depth of the scripted compression as a fraction of the tip radius


def geometry_of(settings: Settings) -> HandGeometry:
    """Return the hand geometry defined by the settings."""
    hand = settings.hand
    return HandGeometry(
        hand.pivot_separation, hand.finger_length, hand.finger_offset, settings.tip.radius
    )


def stiff_step(settings: Settings, table: ContactTable) -> float:
    """Return a sub-step [s] that resolves the fastest oscillation on compressed tips."""
    simulation = settings.simulation
    d = min(settings.safety.d_max, 0.6 * settings.tip.radius, table.header.deepest)
    c = table(d, 0.0)
    # Use the larger of the normal stiffness ∂F/∂d and the shear stiffness 2F/d. The factor 2
    # accounts for the two tips.
    stiffness = 2.0 * simulation.modulus_scale * max(float(c.force_d), 2.0 * float(c.force) / d)
    stiffness *= 1.0 + sum(simulation.tip_relaxation)
    shape = shape_of(settings)
    if shape.kind == NO_OBJECT:
        fastest = geometry_of(settings).reach * math.sqrt(stiffness / simulation.joint_inertia)
    else:
        turning = (shape.half_width / shape.gyration) ** 2
        fastest = math.sqrt(stiffness / simulation.object_mass * max(1.0, turning))
    step = min(max(PHASE_MAX / fastest, STEP_MIN), STEP_MAX)
    # An integer number of sub-steps per millisecond keeps ticks and frames aligned with sub-steps.
    return 1e-3 / math.ceil(1e-3 / step - 1e-9)


def set_parameters(p: Parameters, settings: Settings, table: ContactTable, step: float) -> None:
    """Set the plant parameters. Raises SettingsError if the servo is unknown."""
    simulation, hand = settings.simulation, settings.hand
    for name in Parameters.__annotations__.keys() & type(simulation).model_fields.keys():
        setattr(p, name, getattr(simulation, name))
    p.step = step
    p.sample_period = 1.0 / settings.tactile.rate
    p.modulus = table.header.modulus * simulation.modulus_scale
    p.radius = settings.tip.radius
    p.deepest = table.header.deepest
    p.shear_coupling = float(simulation.tip_law == "springs")
    if simulation.tip_creep_time > 0.0:
        p.creep = -math.expm1(-step / simulation.tip_creep_time)
    p.tips_relax = any(simulation.tip_relaxation)
    p.relaxation_step[:] = [-math.expm1(-step / each) for each in simulation.tip_relaxation_times]
    p.half_separation = 0.5 * hand.pivot_separation
    p.length = hand.finger_length
    p.offset = hand.finger_offset
    p.finger_present[:] = [name in settings.scene.fingers for name in FINGERS]
    p.stop_low[:] = np.subtract(hand.q_min, STOP_CLEARANCE)
    p.stop_high[:] = np.add(hand.q_max, STOP_CLEARANCE)
    _set_motors(p, settings)
    _set_object(p, settings)


def _set_motors(p: Parameters, settings: Settings) -> None:
    servos = settings.servos
    model, constant = by_name(servos.model), settings.control.torque_constant
    p.torque_constant = constant
    p.stall_current = model.stall_current
    p.no_load_speed = model.no_load_speed / servos.gear_ratio
    p.position_gain = model.stall_current / FULL_EFFORT_ERROR
    # This gain makes the position loop critically damped.
    p.rate_gain = 2.0 * math.sqrt(p.position_gain * constant * p.joint_inertia) / constant
    p.joints_held = servos.backend == "none"


def _set_object(p: Parameters, settings: Settings) -> None:
    simulation, shape = settings.simulation, shape_of(settings)
    mass, radius = simulation.object_mass, settings.tip.radius
    p.shape = shape.kind
    p.roundness = shape.roundness
    p.extent = shape.extent
    p.corners = len(shape.corners)
    for k, values in enumerate(shape.edges().tolist()):
        edge = p.outline[k]
        edge.x, edge.y, edge.normal_x, edge.normal_y, edge.length = values
    # Factor κ for a face of this radius; see tip.py.
    curved = shape.roundness
    p.factor = math.sqrt(curved / (curved + radius)) if curved else 1.0
    if settings.tip.physics == "solid":
        p.factor = math.sqrt(p.factor)
    p.mass = mass
    p.inertia = mass * shape.gyration**2
    # The gravity component normal to the plane presses the object onto the table.
    pressing = math.sqrt(max(STANDARD_GRAVITY**2 - math.hypot(*simulation.gravity) ** 2, 0.0))
    p.table_force = simulation.table_friction * mass * pressing
    p.table_torque = p.table_force * shape.mean_radius
    p.table_spin = TABLE_SPEED / shape.mean_radius
    # A single finger cannot hold an object, so a one-finger scene fixes the object to the test
    # bench.
    scripted = p.joints_held and simulation.compression_speed > 0.0
    p.object_held = shape.kind == NO_OBJECT or len(settings.scene.fingers) == 1 or scripted
    p.script_x = simulation.object_position[0]
    if not scripted:
        return
    p.script_speed = simulation.compression_speed
    pose = (*simulation.object_position, simulation.object_angle)
    width = 2.0 * shape.half_width
    contacts = geometry_of(settings).contacts(settings.hand.open_angle, pose, width)
    ways = COMPRESSION_DEPTH * radius - contacts.d
    ways = np.maximum(ways / max(math.cos(simulation.object_angle), 0.1), 0.0)
    p.script_travel[:] = ways * p.finger_present


class SimulatedHand:
    """Planar hand that consists of two fingers with soft tips and an object between the fingers.

    The tips touch the object, or each other if there is no object between them. If a tip has two
    contacts, its sensor measures the stronger contact. The object may lie on the palm.

    ``settings.scene.fingers`` selects the tips. If only one finger is selected, the object is fixed
    to the test bench, as in a compression test. If ``settings.servos.backend`` is ``none``, the
    joints stay at ``settings.hand.open_angle``. With this backend, a
    ``simulation.compression_speed`` above 0 moves the object back and forth between the tips. The
    object compresses each tip by 0.4 times the tip radius.

    The array attributes are views of the state. Arrays of shape (2,) contain the value of the left
    finger first. The views are valid until the next call to ``advance``.
    """

    def __init__(
        self,
        settings: Settings,
        start: float = 0.0,
        table: ContactTable | None = None,
        step: float | None = None,
    ) -> None:
        """Create the hand at standstill at the time ``start`` [s], with torque off.

        If ``table`` is None, the contact table is computed. If ``step`` [s] is None, the sub-step
        is derived from the stiffness. Raises SettingsError if the settings can't be simulated.
        """
        if table is None:
            table = make_table(settings)
        self.settings = settings
        self.table = table
        self.step = stiff_step(settings, table) if step is None else step
        self.start = start
        self.plant = Plant()
        set_parameters(self.plant.parameters, settings, table, self.step)
        self.plant.relaxation_factor[:] = 1.0 + sum(settings.simulation.tip_relaxation)
        state, simulation = self.plant.state, settings.simulation
        state.position[:2] = settings.hand.open_angle
        self._first_pose = *simulation.object_position, simulation.object_angle
        state.position[2:] = self._first_pose
        goals = self.plant.goals
        goals.mode[:] = CURRENT_BASED_POSITION_MODE
        goals.stiffness[:] = goals.duty[:] = 1.0
        # The buffer stores all samples that a sensor may still need.
        latest = simulation.tactile_delay + simulation.tactile_jitter
        stored = math.ceil(latest * settings.tactile.rate) + SPARE_SAMPLE_COUNT
        self._ring = np.zeros(stored, Sample.dtype)
        self._ring["number"] = -1
        self._rows = [Sample(self._ring[k : k + 1]) for k in range(stored)]
        self._torque_until = math.inf
        self._per_step = 1.0 / self.step
        self.q = state.position[:2]  # rad
        self.dq = state.velocity[:2]  # rad/s
        self.current = state.current  # A
        self.object_pose = state.position[2:]  # x, y, φ
        self.object_velocity = state.velocity[2:]
        felt: Any = self.plant.sensed_contact
        self.d = felt.array["d"]  # normal displacement, negative for a gap [m]
        self.theta = felt.array["theta"]  # rad
        self.force = felt.array["force"]  # force F on the tip base [N]
        self.normal = felt.array["normal"]  # N [N]
        self.tangential = felt.array["tangential"]  # T [N]
        self.shear = state.shear  # d_t [m]
        self.on_other_tip = self.plant.on_other_tip  # 1 if the contact is with the other tip
        self.torque_on = goals.torque_on  # 1 if the servo's torque is on
        self._goals = goals
        # Measurement faults of the left and the right finger. These faults do not change the
        # physics.
        self.measurement_faults = MeasurementFaults(), MeasurementFaults()
        self.servo_heat = ServoHeat.of(settings), ServoHeat.of(settings)
        self._run(0)

    @property
    def t(self) -> float:
        """Time of the state [s]."""
        return self.start + self.plant.step_count * self.step

    def advance(self, t: float) -> None:
        """Advance to the last sub-step at or before ``t`` [s], but never go back in time."""
        if t > self._torque_until:
            self._advance(self._torque_until)
            self.torque_on[:] = 0
            self._torque_until = math.inf
        self._advance(t)

    def _advance(self, t: float) -> None:
        # Adding 1e-6 prevents rounding down if t is a multiple of the sub-step.
        remaining = int((t - self.start) * self._per_step + 1e-6) - self.plant.step_count
        steps_max = int(ADVANCE_MAX * self._per_step)
        while remaining > 0:
            count = min(remaining, steps_max)
            self._run(count)
            remaining -= count

    def refresh(self) -> None:
        """Recompute the contacts for a changed state, without advancing time."""
        self._run(0)

    def place_object(self) -> None:
        """Move the object back to its start pose, stop it, and remove its load."""
        self.object_pose[:], self.object_velocity[:] = self._first_pose, 0.0
        self.load()
        self.refresh()

    def drive(
        self, joint: int, mode: int, torque_on: bool, goal_q: float, goal_current: float
    ) -> None:
        """Set a servo's mode, goal angle [rad] and goal current [A]; switch its torque on or off.

        The Dynamixel mode numbers are 0 (current), 3 (position) and 5 (current-based position).
        """
        goals = self._goals
        goals.mode[joint], goals.torque_on[joint] = mode, torque_on
        goals.q[joint], goals.current[joint] = goal_q, goal_current

    def tune(self, joint: int, stiffness: float, damping: float, duty: float) -> None:
        """Set a servo's position gains and its voltage limit, a fraction of the supply voltage."""
        goals = self._goals
        goals.stiffness[joint], goals.damping[joint] = stiffness, damping
        goals.duty[joint] = duty

    def measured_current(self, joint: int) -> float:
        """Return the motor current [A] measured by the servo's sensor."""
        scale = self.measurement_faults[joint]("current", self.t)
        return scale * self.current.item(joint)

    def hold_torque_until(self, t: float) -> None:
        """Switch the torque of both servos off at ``t`` [s]; infinity cancels the command."""
        self._torque_until = t

    def apply_load(self, force_x: float, force_y: float, torque: float = 0.0) -> None:
        """Apply a permanent force [N] and torque [N·m] to the object; zeros remove the load."""
        self.plant.goals.load[:] = force_x, force_y, torque

    def load(self, push: float = 0.0, twist: float = 0.0) -> None:
        """Apply a permanent ``push`` [N] and ``twist`` [N·m] to the object; zeros remove the load.

        The push acts along the faces and away from the palm. The direction of the push does not
        change when the object rotates.
        """
        angle = self.object_pose.item(2)
        self.apply_load(-push * math.sin(angle), push * math.cos(angle), twist)

    def apply_fault(self, event: FaultEvent) -> bool:
        """Change an object load or a measurement fault; return False for other faults."""
        kind, part = event.kind, event.part
        if part == OBJECT:
            self.load(**{kind: event.value})
        elif kind in MEASUREMENT_FAULTS:
            faults = self.measurement_faults[FINGERS.index(part)]
            faults.begin(kind, event.value, event.after, event.over)
        elif kind == WELL:
            for finger, faults in zip(FINGERS, self.measurement_faults, strict=True):
                if part in (ALL, finger):
                    faults.clear()
        else:
            return False
        return True

    def sample(self, number: int) -> Sample | None:
        """Return sample ``number``, which is valid until a newer sample replaces it.

        Returns None if the sample has not been taken yet or has been overwritten.
        """
        row = self._rows[number % len(self._rows)]
        return row if row.number == number else None

    def _run(self, count: int) -> None:
        plant.step(self.plant.array, self.table.data, self._ring, count)
