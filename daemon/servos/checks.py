"""What is looked at before the servos are used: every finding in one list, with what mends it.

Pure functions over what was read; they send nothing. The reading itself belongs to
:mod:`servos.examine`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from softfinger.daemon.profile.settings import ServoSettings, Settings
from softfinger.daemon.servos import registers as reg
from softfinger.daemon.servos.models import ServoModel, by_number
from softfinger.daemon.servos.modes import mode_number
from softfinger.daemon.servos.units import JointScale

# Return delays of both servos pass within one read; above 50 µs each they eat a 500 Hz tick.
RETURN_DELAY_MAX = 25
# Drive mode: a second servo follows this one's; any goal that is written switches the torque on.
DRIVE_UNFIT = 0b1010
DRIVE_REVERSE = 0b0001
MEND = "`softfinger doctor --fix`"
WATCHDOG_FIRMWARE = 38
_LONG = 0.5  # s of silence that are told
# rad beyond the hand's limits at which a joint's angle is not believed: a wrong zero, or a servo
# that forgot its turns when it was switched off.
ANGLE_MARGIN = 0.25


@dataclass(frozen=True, slots=True)
class Findings:
    """``errors`` keep the servos from being used, ``notices`` don't."""

    errors: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()


def check_model(model: ServoModel, mode: int) -> str:
    """What is wrong with running this model in an operating mode; empty when it can."""
    if mode in model.modes:
        return ""
    return (
        f"an {model.name} has no {reg.MODE_NAMES[mode]} mode: use a model that senses current, or "
        'set servos.mode = "position"'
    )


def check_servo(
    name: str, model: ServoModel, table: bytes, settings: Settings, finger: int
) -> Findings:
    """Judge one servo by the bytes of its registers 0 … 146.

    Args:
        name: how the servo is called in the report.
        model: the model that the settings name.
        table: its control table from address 0, at least up to the present temperature.
        settings: what is wanted of it.
        finger: 0 left, 1 right.
    """
    watchdog, current_max = settings.servos.watchdog, settings.safety.current_max
    wanted = mode_number(settings.servos)
    number = _word(table, reg.MODEL_NUMBER)
    firmware = table[reg.FIRMWARE_VERSION]
    errors: list[str] = []
    notices: list[str] = []
    if number != model.number:
        other = by_number(number)
        found = other.name if other else f"model number {number}"
        errors.append(f"{name}: is an {found}, not an {model.name}: set servos.model")
        return Findings(tuple(errors))
    mode = table[reg.OPERATING_MODE]
    unfit = check_model(model, wanted)
    if unfit:
        errors.append(f"{name}: {unfit}")
    elif mode != wanted:
        errors.append(
            f"{name}: operating mode is {reg.MODE_NAMES.get(mode, str(mode))} ({mode}), not "
            f"{reg.MODE_NAMES[wanted]} ({wanted}): {MEND}"
        )
    drive = table[reg.DRIVE_MODE]
    if drive & DRIVE_UNFIT:
        errors.append(
            f"{name}: drive mode {drive} switches torque on with any goal, or has it follow "
            f"another servo: {MEND}"
        )
    delay = table[reg.RETURN_DELAY_TIME]
    if delay > RETURN_DELAY_MAX:
        errors.append(
            f"{name}: return delay is {2 * delay} µs, more than {2 * RETURN_DELAY_MAX} µs: {MEND}"
        )
    if table[reg.STATUS_RETURN_LEVEL] == 0:
        errors.append(f"{name}: status return level is 0, so reads stay unanswered: {MEND}")
    status = table[reg.HARDWARE_ERROR_STATUS]
    if status:
        errors.append(
            f"{name}: hardware error: {reg.hardware_error_names(status)}: "
            "remove the cause, then `softfinger doctor --fix` reboots it"
        )
    volts = _word(table, reg.PRESENT_INPUT_VOLTAGE) * reg.VOLTAGE_UNIT
    low = _word(table, reg.MIN_VOLTAGE_LIMIT) * reg.VOLTAGE_UNIT
    high = _word(table, reg.MAX_VOLTAGE_LIMIT) * reg.VOLTAGE_UNIT
    if not low <= volts <= high:
        errors.append(
            f"{name}: supply is {volts:.1f} V, not in {low:.1f} … {high:.1f} V: mend the supply"
        )
    if watchdog > 0.0 and not model.small and firmware < WATCHDOG_FIRMWARE:
        errors.append(
            f"{name}: firmware {firmware} has no bus watchdog: update it to {WATCHDOG_FIRMWARE} "
            "or later, or set servos.watchdog = 0"
        )
    limit = _word(table, reg.CURRENT_LIMIT) * model.current_unit
    if wanted == reg.POSITION_MODE:
        notices.append(f"{name}: in position mode nothing bounds its current")
        errors += _check_range(name, model, table, settings, finger)
    elif model.senses_current and limit < current_max:
        errors.append(
            f"{name}: current limit is {limit:.3f} A, below safety.current_max {current_max:g} A: "
            f"lower safety.current_max or raise the limit"
        )
    notices += _notices(name, model, table, firmware, settings.servos)
    return Findings(tuple(errors), tuple(notices))


def _check_range(
    name: str, model: ServoModel, table: bytes, settings: Settings, finger: int
) -> list[str]:
    """In position mode a goal beyond the servo's position limits is refused without a word."""
    scale = JointScale.of(settings.servos, finger, model)
    ends = (settings.hand.q_min[finger], settings.hand.q_max[finger])
    wanted = sorted(scale.position_counts(q) for q in ends)
    low, high = (
        int.from_bytes(table[at : at + 4], "little", signed=True)
        for at in (reg.MIN_POSITION_LIMIT, reg.MAX_POSITION_LIMIT)
    )
    if low <= wanted[0] and wanted[1] <= high:
        return []
    return [
        f"{name}: position limits are {low} … {high}, the joint needs {wanted[0]} … {wanted[1]}: "
        "widen the limits, or correct servos.zero, hand.q_min and hand.q_max"
    ]


def _notices(
    name: str, model: ServoModel, table: bytes, firmware: int, servos: ServoSettings
) -> list[str]:
    notices = []
    if not servos.watchdog:
        notices.append(f"{name}: servos.watchdog = 0: nothing stops it if daemon or line fail")
    if servos.fault_after > _LONG:
        held = f"servos.fault_after = {servos.fault_after:g} s"
        notices.append(f"{name}: {held}: without an answer its last reading counts for so long")
    if table[reg.DRIVE_MODE] & DRIVE_REVERSE:
        notices.append(f"{name}: its drive mode is reversed; servos.direction comes on top of that")
    if table[reg.TORQUE_ENABLE]:
        notices.append(f"{name}: torque is on already; it stays so until disarm or arm")
    if table[reg.BUS_WATCHDOG] == reg.WATCHDOG_ERROR:
        notices.append(f"{name}: its bus watchdog had stopped it; arming clears that")
    if not model.fast_read(firmware):
        notices.append(
            f"{name}: firmware {firmware} has no fast sync read (needs "
            f"{model.fast_read_firmware}); the slower sync read is used"
        )
    hot = table[reg.TEMPERATURE_LIMIT] - 10
    if table[reg.PRESENT_TEMPERATURE] >= hot:
        notices.append(f"{name}: {table[reg.PRESENT_TEMPERATURE]} °C, near its limit")
    return notices


def check_angle(name: str, q: float, q_min: float, q_max: float) -> str:
    """What is wrong with a joint's angle [rad]; empty when it lies near the hand's limits."""
    if q_min - ANGLE_MARGIN <= q <= q_max + ANGLE_MARGIN:
        return ""
    return (
        f"{name}: the joint is at {math.degrees(q):.0f}°, not in {math.degrees(q_min):.0f}° … "
        f"{math.degrees(q_max):.0f}°: turn it there by hand, or correct servos.zero"
    )


def check_latency(path: str, latency: float, reply_timeout: float) -> Findings:
    """Judge a USB adapter's latency timer [s]; 0 means there is none."""
    if latency <= 0.001:
        return Findings()
    line = (
        f"{path}: the adapter's latency timer is {latency * 1e3:.0f} ms, so a read takes that "
        f"long: {MEND} sets it to 1 ms"
    )
    return Findings(errors=(line,)) if latency >= reply_timeout else Findings(notices=(line,))


def _word(table: bytes, at: int) -> int:
    return table[at] | table[at + 1] << 8
