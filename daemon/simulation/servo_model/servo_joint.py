"""Connect the registers of an emulated servo to a joint of the plant.

`ServoJoint` converts counts to angles, follows the motion profile, and drives the plant in the
selected operating mode. `ServoJoint` also writes the measured values to the control table.
"""

from __future__ import annotations

import math
import struct
from typing import Self

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import JointPlant
from softfinger.daemon.servos.control_table import ServoModel, by_name
from softfinger.daemon.servos.joint import JointScale
from softfinger.daemon.simulation.servo_model.registers import ControlTable

STEP_TIME = 0.001  # time step for trajectories and velocity mode [s]
POSITION_MODES = (
    reg.POSITION_MODE,
    reg.EXTENDED_POSITION_MODE,
    reg.CURRENT_BASED_POSITION_MODE,
)
# Counts/s per register unit.
_PER_VELOCITY = reg.VELOCITY_UNIT * reg.COUNTS_PER_TURN / (2.0 * math.pi)
_PER_ACCELERATION = reg.ACCELERATION_UNIT * reg.COUNTS_PER_TURN / (2.0 * math.pi)
_ARRIVAL_COUNTS = 20  # maximum distance from a goal that counts as reached [counts]
_PRESENT = struct.Struct("<HBBhhiiiiHB")  # registers 120 … 146


class ServoJoint:
    """Joint number ``joint`` of ``plant``, driven by a servo with the control table ``table``."""

    def __init__(
        self,
        model: ServoModel,
        table: ControlTable,
        plant: JointPlant,
        joint: int,
        scale: JointScale,
    ) -> None:
        self.profile = Profile()
        self._model = model
        self._table = table
        self._memory = table.memory
        self._plant = plant
        self._joint = joint
        self._scale = scale
        self.stuck: int | None = None  # reading of a stuck encoder [counts]
        self.shift = 0  # encoder zero error [counts]
        self._turns = 0  # full turns subtracted from the position
        self._load = scale.direction / model.stall_current  # load per ampere, with the servo's sign
        self._speed = scale.direction * reg.VELOCITY_UNIT / scale.velocity / model.no_load_speed

    @property
    def sign(self) -> int:
        """Sign of the servo's counts: -1 in reverse drive mode, otherwise 1."""
        return -1 if self._memory[reg.DRIVE_MODE] & 1 else 1

    @property
    def current(self) -> float:
        """Magnitude of the motor current [A]."""
        return abs(float(self._plant.current[self._joint]))

    @property
    def current_limit(self) -> float:
        """Current limit [A] according to the registers."""
        if not self._model.senses_current:
            return self._model.stall_current
        return self._table.get(reg.CURRENT_LIMIT) * self._model.current_unit

    # --- position ----------------------------------------------------------------------------

    def encoder(self) -> int:
        """Return the multi-turn encoder count."""
        if self.stuck is not None:
            return self.stuck
        return self._scale.position_counts(self._plant.q.item(self._joint)) + self.shift

    def forget_turns(self) -> int:
        """Reset the position to a single turn; return the decrease in position [counts]."""
        before = self._turns
        self._turns = self.encoder() // reg.COUNTS_PER_TURN
        return self.sign * (self._turns - before) * reg.COUNTS_PER_TURN

    def position(self) -> int:
        """Return the present position in counts, as in register 132."""
        within = self.encoder() - self._turns * reg.COUNTS_PER_TURN
        return self.sign * within + self._table.get(reg.HOMING_OFFSET)

    def goal_angle(self, counts: float) -> float:
        """Return the joint angle [rad] for a goal position."""
        within = self.sign * (counts - self._table.get(reg.HOMING_OFFSET))
        return self._scale.angle(within + self._turns * reg.COUNTS_PER_TURN)

    def goal_current(self, counts: int) -> float:
        """Convert a goal current from counts to A; positive currents close the finger."""
        return self._scale.amperes(self.sign * counts)

    # --- trajectory --------------------------------------------------------------------------

    def hold(self) -> None:
        """End the trajectory at the present position."""
        self.profile.hold(self.position())

    def aim(self) -> None:
        """Start a trajectory to the goal position with the limits in the profile registers."""
        memory, table, profile = self._memory, self._table, self.profile
        if memory[reg.OPERATING_MODE] not in POSITION_MODES:
            return
        target = float(table.get(reg.GOAL_POSITION))
        acceleration, speed = table.get(reg.PROFILE_ACCELERATION), table.get(reg.PROFILE_VELOCITY)
        if not speed:
            profile.hold(target)  # A profile velocity of 0 disables the profile.
        elif memory[reg.DRIVE_MODE] & 4:
            profile.aim_in(target, speed / 1000.0, acceleration / 1000.0)
        elif not (limit := table.get(reg.VELOCITY_LIMIT)):
            self.hold()
        else:
            speed = min(speed, limit)
            profile.aim(target, speed * _PER_VELOCITY, acceleration * _PER_ACCELERATION)

    def moves_by_itself(self) -> bool:
        """Return True if :meth:`follow` must be called while torque is on."""
        mode = self._memory[reg.OPERATING_MODE]
        if mode in POSITION_MODES:
            return self.profile.busy
        return mode == reg.VELOCITY_MODE

    def follow(self) -> None:
        """Advance the trajectory by STEP_TIME; in velocity mode, advance the position."""
        mode = self._memory[reg.OPERATING_MODE]
        if mode in POSITION_MODES:
            self.profile.step(STEP_TIME)
        elif mode == reg.VELOCITY_MODE:
            limit = self._table.get(reg.VELOCITY_LIMIT)
            speed = min(max(self._table.get(reg.GOAL_VELOCITY), -limit), limit)
            self.profile.velocity = speed * _PER_VELOCITY
            self.profile.position += self.profile.velocity * STEP_TIME
        self.drive()

    # --- plant -------------------------------------------------------------------------------

    def drive(self) -> None:
        """Drive the plant according to the registers, except for the integral gain.

        The servo torque is K_P·error − K_D·Δposition, where Δposition is the change per
        millisecond. According to the e-Manual (position PID gain), K_P = P / 128 and K_D = D / 16.
        """
        memory, get, drive = self._memory, self._table.get, self._plant.drive
        d, _, p = self._model.position_gains
        stiffness = get(reg.POSITION_P_GAIN) / p
        damping = (get(reg.POSITION_D_GAIN) - d) / 16.0 / (p / 128.0) * STEP_TIME
        duty = min(abs(get(reg.GOAL_PWM)), get(reg.PWM_LIMIT)) / 885.0
        self._plant.tune(self._joint, stiffness, damping, duty)
        mode, goal = memory[reg.OPERATING_MODE], self.goal_angle(self.profile.position)
        if not memory[reg.TORQUE_ENABLE]:
            drive(self._joint, reg.CURRENT_MODE, False, 0.0, 0.0)
        elif mode == reg.CURRENT_BASED_POSITION_MODE:
            bound = abs(get(reg.GOAL_CURRENT)) * self._model.current_unit
            drive(self._joint, mode, True, goal, bound)
        elif mode == reg.CURRENT_MODE:
            drive(self._joint, mode, True, 0.0, self.goal_current(get(reg.GOAL_CURRENT)))
        else:
            drive(self._joint, reg.POSITION_MODE, True, goal, self.current_limit)

    def refresh(self, seconds: float, voltage: float, temperature: float) -> None:
        """Update registers 120 to 146 at the time ``seconds`` after power-up."""
        profile, memory, position = self.profile, self._memory, self.position()
        plant, joint, scale = self._plant, self._joint, self._scale
        current = velocity = pwm = 0
        if self.stuck is None:
            ampere = plant.measured_current(joint)
            if self._model.senses_current:
                current = scale.current_counts(ampere)
            else:  # The register contains the present load in units of 0.1 %.
                current = round(1000.0 * self._load * ampere)
            current = max(-32768, min(32767, self.sign * current))
            velocity = self.sign * scale.velocity_counts(plant.dq.item(joint))
        if memory[reg.TORQUE_ENABLE]:
            duty = self._load * plant.current.item(joint) + self._speed * plant.dq.item(joint)
            pwm = max(-885, min(885, round(self.sign * 885.0 * duty)))
        busy = profile.busy
        arrived = not busy and abs(profile.target - position) <= _ARRIVAL_COUNTS
        _PRESENT.pack_into(
            memory,
            reg.REALTIME_TICK,
            int(seconds * 1000.0 + 1e-6) & 0x7FFF,
            abs(velocity) > self._table.get(reg.MOVING_THRESHOLD),
            arrived | busy << 1,
            pwm,
            current,
            velocity,
            position,
            round(profile.velocity / _PER_VELOCITY),
            round(profile.position),
            max(0, round(voltage / reg.VOLTAGE_UNIT)),
            max(0, min(255, round(temperature))),
        )


ROOM_TEMPERATURE = 25.0  # °C
_THERMOMETER_LAG = 4.0  # s
_CONVECTION = 0.006  # relative increase in cooling per kelvin of temperature difference [1/K]
_STEP_MAX = 1.0  # maximum step [s]
# Arrival tolerance in counts. Without a tolerance, rounding of the square root would keep the
# trajectory from reaching its target.
_ARRIVAL_TOLERANCE = 1e-6


class Profile:
    """Velocity-based or time-based trajectory to a goal.

    The profile stores the present position and velocity of the trajectory. A velocity or
    acceleration limit of 0 means no limit.
    """

    def __init__(self) -> None:
        self.position = 0.0  # counts
        self.velocity = 0.0  # counts/s
        self.target = 0.0
        self.speed = 0.0  # velocity limit, 0 for none [counts/s]
        self.acceleration = 0.0  # acceleration limit, 0 for none [counts/s²]

    @property
    def busy(self) -> bool:
        """True while the trajectory has not reached its target."""
        return self.position != self.target or self.velocity != 0.0

    def hold(self, position: float) -> None:
        """Stop at ``position``."""
        self.position = self.target = position
        self.velocity = 0.0

    def aim(self, target: float, speed: float, acceleration: float) -> None:
        """Set a target with velocity and acceleration limits (velocity-based profile)."""
        self.target, self.speed, self.acceleration = target, speed, acceleration
        if speed == 0.0 and acceleration == 0.0:
            self.hold(target)

    def aim_in(self, target: float, duration: float, ramp: float) -> None:
        """Set a target for a time-based profile of ``duration`` [s] with ramps of ``ramp`` [s]."""
        if duration <= 0.0:
            self.hold(target)
            return
        ramp = min(ramp, duration / 2.0)
        speed = abs(target - self.position) / (duration - ramp)
        self.aim(target, speed, speed / ramp if ramp > 0.0 else 0.0)

    def step(self, dt: float) -> None:
        """Advance by dt [s] on a trapezoidal profile that does not overshoot."""
        distance = self.target - self.position
        if abs(distance) < _ARRIVAL_TOLERANCE and abs(self.velocity) <= max(
            self.acceleration * dt, _ARRIVAL_TOLERANCE
        ):
            self.hold(self.target)
            return
        limit = self.speed if self.speed > 0.0 else math.inf
        if self.acceleration > 0.0:
            # Maximum speed in this step at which the trajectory can still stop at the target.
            a = self.acceleration
            stop = math.sqrt(2.0 * a * abs(distance) + (a * dt / 2.0) ** 2) - a * dt / 2.0
            speed = math.copysign(min(limit, stop), distance)
            change = max(-a * dt, min(a * dt, speed - self.velocity))
            velocity = self.velocity + change
        else:
            velocity = math.copysign(min(limit, abs(distance) / dt), distance)
        move = velocity * dt
        if distance * move >= 0.0 and abs(move) >= abs(distance):
            self.hold(self.target)
            return
        self.position += move
        self.velocity = velocity


class ServoHeat:
    """Thermal model of one servo. ``ambient`` [°C] may be changed at any time.

    `ServoHeat` is independent of the daemon's model (`kinematics.hand.servo_heat`) and uses
    different constants. Copper resistance increases with temperature, and convection at the case
    increases with the temperature difference. The thermometer lags behind the case temperature.
    ``heating``, ``cooling`` and ``capacity`` are factors applied to the servo model's values.
    """

    def __init__(
        self, model: ServoModel, heating: float = 1.0, cooling: float = 1.0, capacity: float = 1.0
    ) -> None:
        self.ambient = self.winding = self.case = self.sensed = ROOM_TEMPERATURE
        self._resistance = 1.08 * heating * model.resistance
        self._winding = 0.05 * capacity * model.heat_capacity  # J/K
        self._case = 0.93 * capacity * model.heat_capacity
        self._coupling = 1.0 / (0.35 * model.case_resistance)  # W/K
        self._cooling = 0.85 * cooling / model.case_resistance

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """Create the thermal model of the configured servo at ambient temperature."""
        simulation = settings.simulation
        heat = cls(by_name(settings.servos.model), *simulation.servo_heat)
        heat.ambient = simulation.ambient
        heat.warm(heat.ambient)
        return heat

    def warm(self, temperature: float) -> None:
        """Set all temperatures to ``temperature`` [°C]."""
        self.winding = self.case = self.sensed = temperature

    def step(self, current: float, seconds: float) -> None:
        """Advance by ``seconds`` with a constant ``current`` [A]."""
        while seconds > 0.0:
            dt = min(seconds, _STEP_MAX)
            seconds -= dt
            copper = 1.0 + 0.0039 * (self.winding - ROOM_TEMPERATURE)
            inward = self._coupling * (self.winding - self.case)
            over = self.case - self.ambient
            outward = self._cooling * (1.0 + _CONVECTION * max(over, 0.0)) * over
            heat = self._resistance * copper * current * current
            self.winding += (heat - inward) * dt / self._winding
            self.sensed += (self.case - self.sensed) * dt / _THERMOMETER_LAG
            self.case += (inward - outward) * dt / self._case
