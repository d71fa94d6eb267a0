"""List the servo registers that affect the hand, with their required values.

:func:`required_registers` returns the table in the order of the e-Manual's control table. EEPROM
values are permanent. RAM values persist until a reboot or a power failure. EEPROM and RAM may
therefore contain values from another program. `connect` checks the EEPROM, and only `softfinger
doctor --fix` writes the EEPROM. `arm` writes the RAM registers of :func:`armed_registers`.

The table omits registers that do not affect goal tracking, limits or bus replies in the hand's
operating modes. ID and baud rate are also omitted, because a search finds them. The registers for
moving threshold, LED and external ports have no effect on the motion. Velocity gains and goal
velocity apply only to velocity mode. `servos.torque` writes goal current, goal position, bus
watchdog and indirect addresses on each `arm`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container
from typing import Final, NamedTuple

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Status
from softfinger.daemon.servos.control_table import ServoModel
from softfinger.daemon.servos.joint import JointScale

# The duration of a read includes the return delays of both servos. With delays above 50 µs, a read
# would take longer than a tick at 500 Hz.
RETURN_DELAY_MAX: Final = 25
# Drive mode bits that must be 0. One bit makes a servo follow another servo. The other bit switches
# torque on when a goal is written.
DRIVE_UNFIT: Final = 0b1010
PWM_FULL: Final = 885
_STARTUP_FIRMWARE = 45
_POSITION_MAX = reg.COUNTS_PER_TURN - 1
_NO_LIMIT = 1 << 32


class Register(NamedTuple):
    """Writable register with its name from the e-Manual."""

    name: str
    address: int
    size: int
    signed: bool = False

    def value_in(self, table: bytes, start: int = 0) -> int:
        """Return the register's value in ``table``, which begins at address ``start``."""
        at = self.address - start
        return int.from_bytes(table[at : at + self.size], "little", signed=self.signed)

    def packed(self, value: int) -> bytes:
        """Convert a value to the bytes of the register."""
        return value.to_bytes(self.size, "little", signed=value < 0)


# Registers that `doctor --save` stores so that they can be restored later. ID, baud rate and
# protocol are excluded, because changing them would make the servo unreachable.
REGISTERS: Final = (
    Register("return delay", reg.RETURN_DELAY_TIME, 1),
    Register("drive mode", reg.DRIVE_MODE, 1),
    Register("operating mode", reg.OPERATING_MODE, 1),
    Register("shadow ID", reg.SHADOW_ID, 1),
    Register("homing offset", reg.HOMING_OFFSET, 4, True),
    Register("moving threshold", reg.MOVING_THRESHOLD, 4),
    Register("temperature limit", reg.TEMPERATURE_LIMIT, 1),
    Register("max voltage limit", reg.MAX_VOLTAGE_LIMIT, 2),
    Register("min voltage limit", reg.MIN_VOLTAGE_LIMIT, 2),
    Register("PWM limit", reg.PWM_LIMIT, 2),
    Register("current limit", reg.CURRENT_LIMIT, 2),
    Register("velocity limit", reg.VELOCITY_LIMIT, 4),
    Register("max position limit", reg.MAX_POSITION_LIMIT, 4),
    Register("min position limit", reg.MIN_POSITION_LIMIT, 4),
    Register("startup configuration", reg.STARTUP_CONFIGURATION, 1),
    Register("PWM slope", reg.PWM_SLOPE, 1),
    Register("shutdown", reg.SHUTDOWN, 1),
    Register("LED", reg.LED, 1),
    Register("status return level", reg.STATUS_RETURN_LEVEL, 1),
    Register("velocity I gain", reg.VELOCITY_I_GAIN, 2),
    Register("velocity P gain", reg.VELOCITY_P_GAIN, 2),
    Register("position D gain", reg.POSITION_D_GAIN, 2),
    Register("position I gain", reg.POSITION_I_GAIN, 2),
    Register("position P gain", reg.POSITION_P_GAIN, 2),
    Register("feedforward 2nd gain", reg.FEEDFORWARD_2ND_GAIN, 2),
    Register("feedforward 1st gain", reg.FEEDFORWARD_1ST_GAIN, 2),
    Register("goal PWM", reg.GOAL_PWM, 2, True),
    Register("profile acceleration", reg.PROFILE_ACCELERATION, 4),
    Register("profile velocity", reg.PROFILE_VELOCITY, 4),
)
_AT: Final = {register.address: register for register in REGISTERS}


class Requirement(NamedTuple):
    """Required value of a register. A wrong value results in a finding with this ``status``.

    The status is ``note`` for the RAM registers that `arm` writes. Only the bits of ``mask`` are
    compared and corrected.
    """

    register: Register
    accepted: Container[int]
    value: int  # correct value
    told: Callable[[int], str]  # function that describes a wrong value and the expected value
    status: Status = "FAIL"
    then: str = ""  # action required after the value is corrected
    mask: int = -1

    def wrong_in(self, table: bytes, start: int = 0) -> int | None:
        """Return the value if it is wrong, otherwise None.

        ``table`` contains the registers from address ``start`` on.
        """
        value = self.register.value_in(table, start)
        return None if value & self.mask in self.accepted else value

    def corrected(self, wrong: int) -> int:
        """Return the correct value of a register that contains ``wrong``."""
        return wrong & ~self.mask | self.value


def _exactly(address: int, value: int, why: str, status: Status = "FAIL") -> Requirement:
    register = _AT[address]
    return Requirement(
        register,
        (value,),
        value,
        lambda found: f"{register.name} is {found}, expected {value}: {why}",
        status,
    )


def _within(address: int, low: int, high: int, unit: str) -> Requirement:
    """Require a shutdown limit between ``low`` and the factory value ``high``."""
    register = _AT[address]
    expected = f"{low}" if low == high else f"{low} to {high}"
    return Requirement(
        register,
        range(low, high + 1),
        high,
        lambda found: f"{register.name} is {found} {unit}, expected {expected} {unit}",
        "warn",
    )


def required_registers(
    model: ServoModel, settings: Settings, finger: int, firmware: int
) -> list[Requirement]:
    """Return the requirements for finger 0 (left) or 1 (right), sorted by address."""
    servos, safety = settings.servos, settings.safety
    scale = JointScale.of(servos, finger, model)
    mode = reg.MODE_NUMBERS[servos.mode]
    hot = min(math.ceil(safety.temperature_max), model.temperature_limit)
    slow = min(math.ceil(safety.goal_speed / scale.velocity), model.velocity_limit)
    rows = [
        Requirement(
            _AT[reg.RETURN_DELAY_TIME],
            range(RETURN_DELAY_MAX + 1),
            0,
            lambda found: (
                f"return delay is {2 * found} µs, expected at most {2 * RETURN_DELAY_MAX} µs"
            ),
        ),
        Requirement(
            _AT[reg.DRIVE_MODE],
            (0,),
            0,
            lambda found: (
                f"drive mode {found} switches torque on with any goal, or makes the servo follow "
                "another servo"
            ),
            mask=DRIVE_UNFIT,
        ),
        Requirement(
            _AT[reg.SHADOW_ID],
            set(range(256)) - set(servos.ids),
            255,
            lambda found: (
                f"shadow ID is {found}: the servo also executes commands for the servo with this ID"
            ),
        ),
        Requirement(
            _AT[reg.HOMING_OFFSET],
            (0,),
            0,
            lambda found: (
                f"homing offset is {found} counts, expected 0: it shifts this joint's zero by "
                f"{math.degrees(abs(found) * scale.radian):.1f}°"
            ),
            then="run `softfinger calibrate joints`, unless servos.zero was determined without "
            "the offset",
        ),
        _within(reg.TEMPERATURE_LIMIT, hot, model.temperature_limit, "°C"),
        _within(reg.MAX_VOLTAGE_LIMIT, model.voltage_max, model.voltage_max, "× 0.1 V"),
        _within(reg.MIN_VOLTAGE_LIMIT, 0, model.voltage_min, "× 0.1 V"),
        _exactly(reg.PWM_LIMIT, PWM_FULL, "the motor does not get the full supply voltage"),
        Requirement(
            _AT[reg.VELOCITY_LIMIT],
            range(slow, _NO_LIMIT),
            model.velocity_limit,
            lambda found: (
                f"velocity limit is {found * scale.velocity:.2g} rad/s at the joint, expected at "
                f"least {slow * scale.velocity:.2g} rad/s"
            ),
            "warn",
        ),
        Requirement(
            _AT[reg.SHUTDOWN],
            (model.shutdown,),
            model.shutdown,
            lambda found: (
                f"shutdown is {found}, expected {model.shutdown}: the servo does not switch "
                f"torque off after {reg.hardware_error_names(model.shutdown & ~found)}"
            ),
            "warn",
            mask=model.shutdown,
        ),
    ]
    if mode in model.modes:
        told = reg.MODE_NAMES
        rows.append(
            Requirement(
                _AT[reg.OPERATING_MODE],
                (mode,),
                mode,
                lambda found: (
                    f"operating mode is {told.get(found, str(found))} ({found}), expected "
                    f"{told[mode]} ({mode})"
                ),
            )
        )
    if mode == reg.POSITION_MODE:
        rows += _position_limits(scale, settings, finger)
    elif model.senses_current and safety.current_max <= model.stall_current:
        unit = model.current_unit
        needed = math.ceil(safety.current_max / unit - 1e-9)
        rows.append(
            Requirement(
                _AT[reg.CURRENT_LIMIT],
                range(needed, _NO_LIMIT),
                needed,
                lambda found: (
                    f"current limit is {found * unit:.3f} A, expected at least "
                    f"safety.current_max = {safety.current_max:g} A"
                ),
            )
        )
    if firmware >= _STARTUP_FIRMWARE:
        why = "at power-up the servo switches torque on (1) or restores a backup of its RAM (2)"
        rows.append(_exactly(reg.STARTUP_CONFIGURATION, 0, why))
    if model.pwm_slope is not None:
        why = "the motor voltage ramps at a different rate"
        row = _exactly(reg.PWM_SLOPE, model.pwm_slope, why, "warn")
        # The register reads 0 if the firmware does not implement it.
        rows.append(row._replace(accepted=(0, model.pwm_slope)))
    rows += armed_registers(model)
    return sorted(rows, key=lambda row: row.register.address)


def armed_registers(model: ServoModel) -> list[Requirement]:
    """Return the requirements for the RAM registers that `arm` writes."""
    why = "set by another program; `arm` corrects it"
    d, i, p = model.position_gains
    values = {
        reg.POSITION_D_GAIN: d,
        reg.POSITION_I_GAIN: i,
        reg.POSITION_P_GAIN: p,
        reg.FEEDFORWARD_2ND_GAIN: 0,
        reg.FEEDFORWARD_1ST_GAIN: 0,
        reg.GOAL_PWM: PWM_FULL,
        reg.PROFILE_ACCELERATION: 0,
        reg.PROFILE_VELOCITY: 0,
    }
    return [_exactly(address, value, why, "note") for address, value in values.items()]


def _position_limits(scale: JointScale, settings: Settings, finger: int) -> list[Requirement]:
    """Return the position limit requirements. Servos silently reject goals outside the limits."""
    ends = (settings.hand.q_min[finger], settings.hand.q_max[finger])
    first, last = sorted(scale.position_counts(q) for q in ends)
    needed = f"the joint requires {first} to {last}"
    if not 0 <= first <= last <= _POSITION_MAX:
        needed += (
            ", which exceeds one turn: run `softfinger calibrate joints` to determine zero and "
            "range"
        )
    return [
        Requirement(
            _AT[reg.MIN_POSITION_LIMIT],
            range(first + 1),
            0,
            lambda found: f"min position limit is {found}, {needed}",
        ),
        Requirement(
            _AT[reg.MAX_POSITION_LIMIT],
            range(last, _NO_LIMIT),
            _POSITION_MAX,
            lambda found: f"max position limit is {found}, {needed}",
        ),
    ]
