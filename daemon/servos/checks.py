"""Check the replies, registers and limits of the servos before use.

The checks read registers but do not change them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from softfinger.daemon.profile.settings import GeometrySettings, Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Finding, Status
from softfinger.daemon.servos.control_table import ServoModel
from softfinger.daemon.servos.joint import Joint
from softfinger.daemon.servos.protocol import ServoLine
from softfinger.daemon.servos.register_table import required_registers

CHECKED = reg.BACKUP_READY  # number of registers to read (addresses 0 to 146)
DRIVE_REVERSE = 0b0001
FIX = "`softfinger doctor --fix`"
REBOOT_FIX = "remove the cause, then reboot the servo with `softfinger doctor --fix`"
LOST_TURN_FIX = (
    "reboot the servo: switch its supply off and on again, or run `softfinger doctor --fix`"
)
OLD_PROTOCOL = (
    "replies in Protocol 1.0, expected Protocol 2.0",
    "select Protocol 2.0 with the manufacturer's DYNAMIXEL Wizard (register 13; MX servos "
    "require firmware for Protocol 2.0), or use another servo",
)
_SYSFS = Path("/sys/class/tty")
_WATCHDOG_FIRMWARE = 38
_FAULT_AFTER_LONG = 0.5  # value of servos.fault_after above which a notice is issued [s]
_CONSTANT_RATIO_MAX = 1.3  # maximum ratio of a torque constant to its data sheet value
_TEMPERATURE_MARGIN = 10  # margin below the temperature limit at which a notice is issued [°C]
# Tolerance beyond the joint limits [rad]. Outside this tolerance, the zero offset is wrong or the
# servo has lost its turn count while switched off.
ANGLE_MARGIN = 0.25


class Registers(bytes):
    """Registers of a servo, starting at address 0. The object is empty after a failed read."""

    @classmethod
    def read(cls, line: ServoLine, servo_id: int) -> Registers:
        """Read the registers of a servo up to the present temperature."""
        return cls(line.read(servo_id, 0, CHECKED) or b"")

    def word(self, address: int) -> int:
        """Return the unsigned 2-byte register at ``address``."""
        return int.from_bytes(self[address : address + 2], "little")

    def long(self, address: int) -> int:
        """Return the signed 4-byte register at ``address``."""
        return int.from_bytes(self[address : address + 4], "little", signed=True)


@dataclass(frozen=True, slots=True)
class Examined:
    """Result of checking one servo."""

    joint: Joint
    table: Registers
    findings: list[Finding]  # problems in order of severity
    misplaced: Finding | None = None  # finding that reports an implausible joint angle, or None

    @property
    def replies(self) -> bool:
        """True if the servo responds to a ping; then it has registers or an error."""
        return bool(self.table or self.findings)

    @property
    def errors(self) -> list[Finding]:
        """Findings that make the servo unusable."""
        return [each for each in self.findings if each.status == "FAIL"]


def examine(line: ServoLine, settings: Settings, model: ServoModel) -> list[Examined]:
    """Ping, read and check each servo in the order of ``scene.fingers``."""
    found = []
    for finger in settings.scene.indices:
        joint = Joint.of(settings.servos, finger, model)
        table, misplaced = Registers(), None
        findings: list[Finding] = []
        if line.ping(joint.id) is not None:
            table = Registers.read(line, joint.id)
            findings = check_servo(joint, model, table, settings)
        elif line.ping_old(joint.id):
            findings = [Finding("FAIL", joint.name, *OLD_PROTOCOL)]
        if table:
            misplaced = check_position(joint, table, settings.hand)
        found.append(Examined(joint, table, findings, misplaced))
    return found


def check_model(name: str, model: ServoModel, mode: int) -> Finding | None:
    """Return a finding if the model does not support an operating mode, otherwise None."""
    if mode in model.modes:
        return None
    problem = f"an {model.name} does not support {reg.MODE_NAMES[mode]} mode"
    fix = 'use a model that measures its current, or set servos.mode = "position"'
    return Finding("FAIL", name, problem, fix)


def check_servo(
    joint: Joint, model: ServoModel, table: Registers, settings: Settings
) -> list[Finding]:
    """Return the problems of a servo that replies, in order of severity.

    ``model`` is the model in the settings.
    """
    name = joint.name
    if not table:
        why = (
            "replies to a ping but not to a read: the status return level is 0, two servos have "
            "this ID, or the line is faulty"
        )
        return [Finding("FAIL", name, why, FIX)]
    number = table.word(reg.MODEL_NUMBER)
    if number != model.number:
        return [Finding("FAIL", name, *other_model(number, model))]
    found = []
    for row in required_registers(model, settings, joint.finger, table[reg.FIRMWARE_VERSION]):
        if (wrong := row.wrong_in(table)) is not None:
            fix = f"{FIX}, then {row.then}" if row.then else "" if row.status == "note" else FIX
            found.append(Finding(row.status, name, row.told(wrong), fix))
    found += _check_state(name, model, table, settings)
    found += _notice_servo(name, model, table, settings)
    found += notice_strength(name, model, settings)
    severity: tuple[Status, ...] = ("FAIL", "warn", "note")
    return sorted(found, key=lambda each: severity.index(each.status))


def other_model(number: int, model: ServoModel) -> tuple[str, str]:
    """Return the problem and the fix for a servo whose model differs from the settings."""
    if number in (each.number for each in reg.MODELS.values()):
        return f"is an {reg.name_of(number)}, expected an {model.name}", "set servos.model"
    return (
        f"has unknown model number {number}, expected {model.number} ({model.name})",
        f"use one of the known models: {', '.join(reg.MODELS)}",
    )


def _check_state(
    name: str, model: ServoModel, table: Registers, settings: Settings
) -> Iterator[Finding]:
    """Yield the findings, apart from register values, that prevent the use of a servo."""
    unfit = check_model(name, model, reg.MODE_NUMBERS[settings.servos.mode])
    if unfit is not None:
        yield unfit
    if status := table[reg.HARDWARE_ERROR_STATUS]:
        error = reg.hardware_error_names(status)
        yield Finding("FAIL", name, f"hardware error: {error}", REBOOT_FIX)
    volts, low, high = (
        table.word(at) * reg.VOLTAGE_UNIT
        for at in (reg.PRESENT_INPUT_VOLTAGE, reg.MIN_VOLTAGE_LIMIT, reg.MAX_VOLTAGE_LIMIT)
    )
    if not low <= volts <= high:
        fits = model.voltage_min <= table.word(reg.PRESENT_INPUT_VOLTAGE) <= model.voltage_max
        # If the supply voltage suits the model, the limits stored in the servo are too narrow.
        fix = FIX if fits else "check the power supply"
        problem = f"supply voltage is {volts:.1f} V, expected {low:.1f} to {high:.1f} V"
        yield Finding("FAIL", name, problem, fix)
    firmware = table[reg.FIRMWARE_VERSION]
    if settings.servos.watchdog > 0.0 and not model.is_x330 and firmware < _WATCHDOG_FIRMWARE:
        problem = f"firmware {firmware} does not support the bus watchdog"
        fix = (
            f"update the firmware to version {_WATCHDOG_FIRMWARE} or later, or set "
            "servos.watchdog = 0"
        )
        yield Finding("FAIL", name, problem, fix)
    current_max, greatest = settings.safety.current_max, model.stall_current
    if model.senses_current and settings.servos.mode != "position" and greatest < current_max:
        problem = (
            f"safety.current_max is {current_max:g} A, above this model's stall current of "
            f"{greatest:.3g} A"
        )
        yield Finding("FAIL", name, problem, "lower safety.current_max")


def _notice_servo(
    name: str, model: ServoModel, table: Registers, settings: Settings
) -> list[Finding]:
    """Return notices about a usable servo."""
    servos, firmware = settings.servos, table[reg.FIRMWARE_VERSION]
    limit, present = table[reg.TEMPERATURE_LIMIT], table[reg.PRESENT_TEMPERATURE]
    notices = (
        (
            servos.mode == "position",
            'servos.mode = "position" does not limit the current of the servo',
        ),
        (
            not servos.watchdog,
            "servos.watchdog = 0: the servo keeps moving if the daemon or the bus fails",
        ),
        (
            servos.fault_after > _FAULT_AFTER_LONG,
            f"servos.fault_after = {servos.fault_after:g} s: if replies are missing, the daemon "
            "uses the last reading for up to this time",
        ),
        (
            table[reg.DRIVE_MODE] & DRIVE_REVERSE,
            "the drive mode is reversed in addition to the reversal by servos.direction",
        ),
        (table[reg.TORQUE_ENABLE], "torque is already on and stays on until `disarm` or `arm`"),
        (
            table[reg.BUS_WATCHDOG] == reg.WATCHDOG_ERROR,
            "the bus watchdog has stopped the servo; `arm` clears the watchdog",
        ),
        (
            not model.fast_read(firmware),
            f"firmware {firmware} does not support fast sync reads, which require version "
            f"{model.fast_read_firmware} or later; the daemon uses slower normal sync reads",
        ),
        (present >= limit - _TEMPERATURE_MARGIN, f"{present} °C, close to its limit of {limit} °C"),
    )
    return [Finding("warn", name, text) for true, text in notices if true]


def notice_strength(name: str, model: ServoModel, settings: Settings) -> list[Finding]:
    """Return warnings if the configured torque constant or friction does not match the servo model.

    `profile.validation.plausibility_warnings` compares the configured forces with the model.
    """
    constant = settings.servos.gear_ratio * model.torque_constant
    found = []
    given = settings.control.torque_constant
    if constant and not 1.0 / _CONSTANT_RATIO_MAX < given / constant < _CONSTANT_RATIO_MAX:
        text = (
            f"control.torque_constant is {given:g} N·m/A, but the servo's data sheet states "
            f"{constant:.3g}"
        )
        found.append(Finding("warn", name, text, f"control.torque_constant = {constant:.3g}"))
    if model.gear_loss and not settings.control.joint_load_friction:
        text = (
            f"gear friction consumes {model.gear_loss:.0%} of the transmitted torque, so a grip "
            "may never settle"
        )
        fix = f"control.joint_load_friction = {model.gear_loss:g}"
        found.append(Finding("warn", name, text, fix))
    return found


def check_angle(
    joint: Joint, counts: int, hand: GeometrySettings, is_reversed: bool = False
) -> Finding | None:
    """Return a finding if a joint is far outside the hand's limits, otherwise None.

    If torque were switched on, a joint outside the limits would immediately move back. A reboot
    resets the servo's turn count and thus corrects a lost turn. If ``is_reversed``, the servo
    counts down from 0 even after a reboot, so a reboot does not help.
    """
    low, high = hand.q_min[joint.finger], hand.q_max[joint.finger]
    name, scale = joint.name, joint.scale

    def is_inside(position: int) -> bool:
        return low - ANGLE_MARGIN <= scale.angle(position) <= high + ANGLE_MARGIN

    if is_inside(counts):
        return None
    found, lowest, highest = (
        f"{math.degrees(angle):.0f}°" for angle in (scale.angle(counts), low, high)
    )
    problem = f"the joint is at {found}, expected {lowest} to {highest}"
    turns = counts // reg.COUNTS_PER_TURN
    if turns and is_inside(counts - turns * reg.COUNTS_PER_TURN):
        if is_reversed:
            fix = "run `softfinger calibrate joints`, because the drive mode is reversed"
            return Finding("FAIL", name, problem, fix)
        problem += f": the servo has counted {turns} turn{'' if turns in (1, -1) else 's'} too many"
        return Finding("FAIL", name, problem, LOST_TURN_FIX)
    cure = (
        "turn the joint into this range by hand, or correct servos.zero with `softfinger "
        "calibrate joints`"
    )
    return Finding("FAIL", name, problem, cure)


def check_position(joint: Joint, table: Registers, hand: GeometrySettings) -> Finding | None:
    """Check the joint angle in the registers of a servo."""
    counts = table.long(reg.PRESENT_POSITION)
    counts_down = bool(table[reg.DRIVE_MODE] & DRIVE_REVERSE)
    is_reversed = counts_down and -reg.COUNTS_PER_TURN < counts <= 0
    return check_angle(joint, counts, hand, is_reversed)


def latency_file(path: str, sysfs: Path = _SYSFS) -> Path | None:
    """Return the kernel file of an adapter's latency timer [ms], or None if it has no timer."""
    place = sysfs / Path(os.path.realpath(path)).name / "device" / "latency_timer"
    return place if place.exists() else None


def check_latency_timer(path: str, reply_timeout: float, *sysfs: Path) -> Finding | None:
    """Compare an adapter's latency timer with the reply timeout; return None if it has no timer.

    The adapter delays a reply until the timer expires. A timer of 16 ms limits the read rate to 60
    Hz.
    """
    place = latency_file(path, *sysfs)
    if place is None:
        return None
    subject = f"{path} latency timer"
    try:
        latency = int(place.read_text())
    except (OSError, ValueError) as error:
        return Finding("warn", subject, f"can't be read: {error}")
    if latency <= 1:
        return Finding("pass", subject, f"{latency} ms")
    status: Status = "FAIL" if latency * 1e-3 >= reply_timeout else "warn"
    fix = f"softfinger doctor --fix, or: echo 1 | sudo tee {place}"
    return Finding(
        status, subject, f"{latency} ms, expected 1 ms: every read waits for this timer", fix
    )
