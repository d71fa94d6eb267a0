"""Find servos on a port, and set the IDs, baud rates and registers of the hand's servos.

Only :func:`provision` writes a servo's EEPROM. `provision` runs only on request (`softfinger doctor
--fix`) and with torque off. IDs and baud rates are written only to servos that :func:`plan`
identifies unambiguously.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace

from dynamixel_sdk.robotis_def import BROADCAST_ID, COMM_RX_TIMEOUT

from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import GeometrySettings, Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.servos.checks import (
    CHECKED,
    LOST_TURN_FIX,
    OLD_PROTOCOL,
    Registers,
    check_position,
    other_model,
)
from softfinger.daemon.servos.control_table import ServoModel, by_name
from softfinger.daemon.servos.joint import Joint, servo_name
from softfinger.daemon.servos.protocol import ServoLine, open_line
from softfinger.daemon.servos.register_table import required_registers
from softfinger.daemon.types import FINGERS

SEARCH_TIME = 0.8  # listening time per baud rate [s], enough for 253 servos at 1 Mbaud
FACTORY_ID = 1
ONE_SERVO_ONLY = (
    "connect only one servo and run `softfinger doctor --fix`; then connect the next servo as "
    "well, and run the command again"
)
_TORQUE_OFF = "torque switched off, because the EEPROM is locked while torque is on"
_TORQUE_STAYS_ON = "torque could not be switched off"
_READ_COUNT = 8  # number of full-table reads
_REBOOT_TIMEOUT = 2.0  # maximum time from a reboot until the servo responds [s]
_WRITE_TIME = 0.05  # time for sending a packet and storing its data in the EEPROM [s]


# --- finding servos ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FoundServo:
    """Servo found by a search."""

    id: int
    baud: int
    number: int
    firmware: int

    def __str__(self) -> str:
        return self.describe(str(self.baud))

    def describe(self, rates: str) -> str:
        """Describe in one line a servo and the baud rates at which it replies."""
        name = reg.name_of(self.number)
        return f"ID {self.id} at {rates} baud: {name}, firmware {self.firmware}"


@dataclass(frozen=True, slots=True)
class Garbled:
    """ID with corrupted replies; either several servos share the ID, or the line is faulty."""

    id: int
    baud: int

    def __str__(self) -> str:
        factory = " (the factory setting)" if self.id == FACTORY_ID else ""
        return (
            f"replies from ID {self.id} at {self.baud} baud are corrupted: several servos have "
            f"this ID{factory}, or the line is faulty"
        )


@dataclass(frozen=True, slots=True)
class Found:
    """Result of a search. An ID can appear in both ``servos`` and ``garbled``."""

    servos: tuple[FoundServo, ...]
    garbled: tuple[Garbled, ...]
    old: tuple[int, ...] = ()  # baud rates at which a servo replies in Protocol 1.0

    def old_protocol(self) -> list[Finding]:
        """Return a finding for each baud rate at which a servo uses Protocol 1.0."""
        problem, fix = OLD_PROTOCOL
        return [Finding("FAIL", f"a servo at {baud} baud", problem, fix) for baud in self.old]


def search(
    path: str,
    bauds: Iterable[int] = reg.BAUD_RATES,
    wait: float = SEARCH_TIME,
    ids: Iterable[int] = (FACTORY_ID,),
) -> Found:
    """Search a port for servos, and wait ``wait`` seconds for replies at each baud rate.

    Baud rates that the adapter does not support are skipped. If corrupted bytes arrive, each of the
    ``ids`` is probed individually.

    Raises ServoError if the port can't be opened at any of the rates.
    """
    found: list[FoundServo] = []
    garbled: list[Garbled] = []
    old: list[int] = []
    opened, refusal = False, None
    for baud in bauds:
        with contextlib.ExitStack() as stack:
            try:
                line = stack.enter_context(open_line(path, baud))
            except ServoError as error:
                refusal = refusal or error
                continue
            opened = True
            replies = line.ping_all(wait)
            ids_asked = {*replies, *(ids if line.handler.damaged else ())}
            found += [FoundServo(each, baud, *what) for each, what in replies.items()]
            garbled += [Garbled(i, baud) for i in sorted(ids_asked) if is_garbled(line, i)]
            if not replies and line.ping_old(BROADCAST_ID):
                old.append(baud)
    if refusal is not None and not opened:
        raise refusal
    return Found(tuple(found), tuple(garbled), tuple(old))


def is_garbled(line: ServoLine, servo_id: int) -> bool:
    """Return True if several servos with different register values reply to this ID.

    Two servos with one ID may send identical ping replies. The replies to a read differ, for
    example in supply voltage, position and running time, so the replies corrupt each other.
    """
    handler, damaged, silent = line.handler, 0, 0
    for _ in range(_READ_COUNT):
        before = handler.damaged
        result = handler.readTxRx(line.port, servo_id, 0, CHECKED)[1]
        damaged += handler.damaged > before
        silent += result == COMM_RX_TIMEOUT
        if silent > 1 and not damaged:
            break  # The ID is unused.
    return damaged > 1  # A single corrupted reply may be due to interference.


# --- identifying servos --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Change:
    """Assignment of a finger's ID and baud rate to a servo."""

    servo: FoundServo
    finger: int
    id: int
    baud: int

    @property
    def name(self) -> str:
        """Name of the servo in reports, with the new ID."""
        return servo_name(self.id, self.finger)

    def __str__(self) -> str:
        changes = []
        if self.servo.id != self.id:
            changes.append(f"ID {self.servo.id} → {self.id}")
        if self.servo.baud != self.baud:
            changes.append(f"{self.servo.baud} → {self.baud} baud")
        return ", ".join(changes)


@dataclass(frozen=True, slots=True)
class Plan:
    """Unambiguous ``changes``, and the servos that remain missing or unassigned."""

    changes: tuple[Change, ...]
    missing: tuple[int, ...]  # fingers whose servo could not be identified
    strangers: tuple[FoundServo, ...]  # servos that reply but are not assigned to a finger


def plan(found: Found, settings: Settings, model: ServoModel) -> Plan:
    """Assign the found servos to the joints.

    A servo that replies with the ID of a missing servo at another baud rate counts as the missing
    servo. If exactly one servo is missing and exactly one servo is unassigned, the unassigned servo
    counts as the missing servo. Servos of another model or with corrupted replies are not assigned.
    """
    servos = settings.servos
    ids = {servos.ids[FINGERS.index(name)]: FINGERS.index(name) for name in settings.scene.fingers}
    seen = Counter(each.id for each in found.servos)
    # An emulator that does not simulate line timing replies at every baud rate.
    anywhere = {each for each, count in seen.items() if 1 < count == len(model.baud_rates)}
    home = {each.id for each in found.servos if each.baud == servos.baud and each.id in ids}
    bad = {(each.id, each.baud) for each in found.garbled}
    strangers = [
        each
        for each in found.servos
        if (each.baud != servos.baud or each.id not in ids)
        and not (each.id in anywhere and each.baud != servos.baud)
        and (each.id, each.baud) not in bad
    ]
    # A servo with a finger's configured ID and baud rate belongs to that finger. The scene need not
    # contain the finger.
    others = {each for each in strangers if each.baud == servos.baud and each.id in servos.ids}
    fit = [each for each in strangers if each.number == model.number and each not in others]
    missing = [servo_id for servo_id in ids if servo_id not in home]
    changes = []
    for servo_id in list(missing):
        same = [each for each in fit if each.id == servo_id]
        if len(same) == 1 and (servo_id, servos.baud) not in bad:
            changes.append(Change(same[0], ids[servo_id], servo_id, servos.baud))
            fit.remove(same[0])
            missing.remove(servo_id)
    if len(fit) == len(missing) == 1 and (missing[0], servos.baud) not in bad:
        changes.append(Change(fit[0], ids[missing[0]], missing[0], servos.baud))
        missing.clear()
    taken = [change.servo for change in changes]
    return Plan(
        tuple(changes),
        tuple(ids[servo_id] for servo_id in missing),
        tuple(each for each in strangers if each not in taken),
    )


# --- configuring servos --------------------------------------------------------------------------


def provision(settings: Settings) -> list[Finding]:
    """Set the ID, baud rate and required registers of each servo in the scene, and clear errors.

    Returns
    -------
    One finding for each change (status ``fixed``) and for each failure (status ``warn``).

    Raises ServoError if the port can't be opened.
    """
    servos = settings.servos
    result: list[Finding] = []
    model = by_name(servos.model)
    fingers = {servos.ids[f]: f for f in map(FINGERS.index, settings.scene.fingers)}
    with open_line(servos.port, servos.baud, low_latency=True) as line:
        missing = line.wait_for(fingers, servos.open_timeout)
    if missing:
        found = search(servos.port, model.baud_rates, SEARCH_TIME, {FACTORY_ID, *servos.ids})
        what = plan(found, settings, model)
        for change in what.changes:
            result += _identify(servos.port, change, model)
        result += _unknown(settings, found, what)
    with open_line(servos.port, servos.baud) as line:
        line.wait_for(fingers, servos.open_timeout)
        for servo_id, finger in fingers.items():
            name, number = servo_name(servo_id, finger), line.ping(servo_id)
            if number is None:
                if name not in [each.subject for each in result if each.status == "warn"]:
                    result.append(Finding("warn", name, f"no reply at {servos.baud} baud"))
            elif number != model.number:
                result.append(Finding("warn", name, *other_model(number, model)))
            elif is_garbled(line, servo_id):
                result.append(Finding("warn", name, "the replies are corrupted", ONE_SERVO_ONLY))
            else:
                result += _set_up(line, settings, finger, model)
    return result


def _unknown(settings: Settings, found: Found, what: Plan) -> list[Finding]:
    """Explain why the missing servos could not be identified."""
    if found.garbled or found.old:
        garbled = [Finding("warn", "servos", str(each), ONE_SERVO_ONLY) for each in found.garbled]
        return garbled + [replace(each, status="warn") for each in found.old_protocol()]
    names = [servo_name(settings.servos.ids[finger], finger) for finger in what.missing]
    fit = ", ".join(f"ID {each.id} at {each.baud} baud" for each in what.strangers)
    if not fit:
        fix = "check the power supply and the cable"
        return [Finding("warn", name, "no reply at any baud rate", fix) for name in names]
    return [
        Finding("warn", name, f"could be any of these servos: {fit}", ONE_SERVO_ONLY)
        for name in names
    ]


def _identify(path: str, change: Change, model: ServoModel) -> list[Finding]:
    """Set the ID and baud rate of a servo."""
    old, new, name = change.servo.id, change.id, change.name
    found: list[Finding] = []

    def failed(problem: str, fix: str = "") -> list[Finding]:
        return [*found, Finding("warn", name, problem, fix)]

    if change.baud not in model.baud_rates:
        return failed(f"an {model.name} does not support {change.baud} baud", "set servos.baud")
    with open_line(path, change.servo.baud) as line:
        if line.store(reg.STATUS_RETURN_LEVEL, {old: b"\x02"}):
            return failed("replies to a ping but not to a read")
        if new != old and line.ping(new) is not None:
            return failed(f"ID {new} at {change.servo.baud} baud is used by another servo")
        if line.read(old, reg.TORQUE_ENABLE, 1) != b"\x00":
            if line.store(reg.TORQUE_ENABLE, {old: b"\x00"}):
                return failed(_TORQUE_STAYS_ON)
            found.append(Finding("fixed", name, _TORQUE_OFF))
        if new != old:
            line.write(reg.ID, {old: bytes((new,))})
            if line.ping(new) != model.number:
                return failed(f"ID {old} could not be set to {new}")
        if change.baud != change.servo.baud:
            index = model.baud_rates.index(change.baud)
            line.write(reg.BAUD_RATE, {new: bytes((index,))})
            time.sleep(_WRITE_TIME)
    with open_line(path, change.baud) as line:
        if line.ping(new) != model.number:
            return failed(f"no reply after its baud rate was set to {change.baud} baud")
    return [*found, Finding("fixed", name, str(change))]


def _set_up(line: ServoLine, settings: Settings, finger: int, model: ServoModel) -> list[Finding]:
    """Write all registers required by `register_table`, and reboot the servo if needed."""
    joint = Joint.of(settings.servos, finger, model)
    servo_id, name = joint.id, joint.name
    found: list[Finding] = []

    def failed(problem: str) -> list[Finding]:
        return [*found, Finding("warn", name, problem)]

    # At status return level 0, servos do not reply to reads, so set the level before the first
    # read.
    if line.read(servo_id, reg.STATUS_RETURN_LEVEL, 1) is None:
        if line.store(reg.STATUS_RETURN_LEVEL, {servo_id: b"\x02"}):
            return failed("replies to a ping but not to a read")
        found.append(Finding("fixed", name, "status return level 0 → 2"))
    table = Registers.read(line, servo_id)
    if not table:
        return failed("the registers could not be read")
    if table[reg.TORQUE_ENABLE]:
        if line.store(reg.TORQUE_ENABLE, {servo_id: b"\x00"}):
            return failed(_TORQUE_STAYS_ON)
        found.append(Finding("fixed", name, _TORQUE_OFF))
    # After a watchdog stop, goals are read-only until 0 is written to the watchdog register.
    line.store(reg.BUS_WATCHDOG, {servo_id: b"\x00"})
    rows = required_registers(model, settings, finger, table[reg.FIRMWARE_VERSION])
    # Write the operating mode first, because this write resets gains, profiles and goals.
    for row in sorted(rows, key=lambda row: row.register.address != reg.OPERATING_MODE):
        raw = line.read(servo_id, row.register.address, row.register.size) or b""
        wrong = row.wrong_in(raw, row.register.address) if raw else None
        if wrong is None:
            continue
        what, value = row.register.name, row.corrected(wrong)
        if value == wrong:  # Only a change of the settings can correct this register.
            found.append(Finding("warn", name, row.told(wrong)))
        elif line.store(row.register.address, {servo_id: row.register.packed(value)}):
            found.append(Finding("warn", name, f"{what} {wrong} could not be set to {value}"))
        else:
            found.append(Finding("fixed", name, f"{what} {wrong} → {value}", row.then))
    rebooted = _reboot_if_needed(line, joint, settings.hand)
    return [*found, rebooted] if rebooted else found


def _reboot_if_needed(line: ServoLine, joint: Joint, hand: GeometrySettings) -> Finding | None:
    """Reboot a servo that has a hardware error or has lost a turn, and check it again.

    The caller must correct the servo's limits before the reboot.
    """
    name = joint.name

    def reason(table: Registers) -> str:
        if error := table[reg.HARDWARE_ERROR_STATUS]:
            return f"hardware error: {reg.hardware_error_names(error)}"
        misplaced = check_position(joint, table, hand)
        if misplaced is None or misplaced.fix != LOST_TURN_FIX:
            return ""
        return f"position wrong by at least one turn: {table.long(reg.PRESENT_POSITION)} counts"

    table = Registers.read(line, joint.id)
    if not table:
        return Finding("warn", name, "the registers could not be read")
    if not (why := reason(table)):
        return None
    table = _reboot(line, joint.id)
    if not table:
        return Finding("warn", name, f"no reply after a reboot ({why})")
    if still := reason(table):
        fix = "remove the cause, and run the command again"
        return Finding("warn", name, f"{still}, even after a reboot", fix)
    return Finding("fixed", name, f"rebooted ({why})")


def _reboot(line: ServoLine, servo_id: int) -> Registers:
    """Reboot a servo and return its registers, or an empty object if it does not reply in time."""
    line.handler.reboot(line.port, servo_id)
    end = time.monotonic() + _REBOOT_TIMEOUT
    while time.monotonic() < end:
        # A ping without a reply waits for its deadline, so this loop does not need its own pause.
        if line.ping(servo_id, tries=1) is not None:
            return Registers.read(line, servo_id)
    return Registers()
