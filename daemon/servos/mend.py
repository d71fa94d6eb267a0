"""Set the servos of the settings up as the backend needs them: ID, rate, mode, return delay.

The one place that writes a servo's EEPROM, and only when it is asked to (`softfinger doctor
--fix`); the hand lets go meanwhile. IDs and rates are written where there is no doubt which servo
is meant (:mod:`servos.identity`).
"""

from __future__ import annotations

import time

from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import registers as reg
from softfinger.daemon.servos.checks import DRIVE_UNFIT, RETURN_DELAY_MAX
from softfinger.daemon.servos.examine import servo_name
from softfinger.daemon.servos.identity import Change, Plan, plan
from softfinger.daemon.servos.line import ServoLine
from softfinger.daemon.servos.models import ServoModel, by_name
from softfinger.daemon.servos.modes import mode_number
from softfinger.daemon.servos.packets import PacketHandler
from softfinger.daemon.servos.port import SerialPort
from softfinger.daemon.servos.scanning import ALONE, PING_TIMEOUT, Found, search, talks_garbled
from softfinger.daemon.types import FINGERS

_REBOOT_LIMIT = 2.0  # s that a servo may take to answer again
_WRITTEN = 0.05  # s in which a packet has left an adapter and is in a servo's EEPROM
_SEARCH = 0.8  # s that each rate is listened to


def mend(settings: Settings) -> list[str]:
    """Set each servo of the scene up: ID, rate, mode, no return delay, reads answered, no errors.

    Returns one line for each thing that was done; none when all was well already.

    Raises:
        ServoError: the port can't be opened, or a servo that is missing, of another model, or
            that would not take a value, one line each; what could be done was done.
    """
    servos = settings.servos
    model = by_name(servos.model)
    done: list[str] = []
    problems: list[str] = []
    if not _all_at_home(settings):
        _settle_identities(settings, model, done, problems)
    port = SerialPort(servos.port, servos.baud, PING_TIMEOUT)
    port.openPort()
    try:
        line = ServoLine(port, PacketHandler())
        for name in settings.scene.fingers:
            servo_id = servos.ids[FINGERS.index(name)]
            title = servo_name(servo_id, FINGERS.index(name))
            number = line.ping(servo_id)
            if number is None:
                if not any(text.startswith(title) for text in problems):
                    problems.append(f"{title}: no answer at {port.baudrate} baud")
            elif number != model.number:
                problems.append(f"{title}: is not an {model.name}: set servos.model")
            elif talks_garbled(line, servo_id):
                problems.append(f"{title}: its replies come damaged: {ALONE}")
            else:
                mode = mode_number(servos)
                wanted = mode if mode in model.modes else None
                _mend_one(line, servo_id, title, wanted, done, problems)
    finally:
        port.closePort()
    if problems:
        raise ServoError("\n".join(problems + [f"(done: {text})" for text in done]))
    return done


def _all_at_home(settings: Settings) -> bool:
    """Whether every servo of the scene answers under its ID at the settings' rate."""
    servos = settings.servos
    port = SerialPort(servos.port, servos.baud, PING_TIMEOUT)
    port.openPort()
    try:
        line = ServoLine(port, PacketHandler())
        ids = [servos.ids[FINGERS.index(name)] for name in settings.scene.fingers]
        return all(line.ping(servo_id) is not None for servo_id in ids)
    finally:
        port.closePort()


# --- ID and rate ---------------------------------------------------------------------------------


def _settle_identities(
    settings: Settings, model: ServoModel, done: list[str], problems: list[str]
) -> None:
    servos = settings.servos
    found = search(servos.port, model.baud_rates, _SEARCH, {1, *servos.ids})
    what = plan(found, settings, model, model.baud_rates)
    for change in what.changes:
        title = servo_name(change.id, change.finger)
        problem = _identify(servos.port, change, model, title, done)
        if problem:
            problems.append(f"{title}: {problem}")
        else:
            done.append(f"{title}: {change}")
    problems += why_missing(settings, found, what)


def why_missing(settings: Settings, found: Found, what: Plan) -> list[str]:
    """What keeps servos that are still missing from being known, one line each."""
    lines = [f"{each}: {ALONE}" for each in found.garbled]
    if lines or not what.missing:
        return lines
    names = [servo_name(settings.servos.ids[finger], finger) for finger in what.missing]
    fit = ", ".join(f"ID {each.id} at {each.baud} baud" for each in what.strangers)
    if not fit:
        return [f"{name}: no answer at any rate: check its power and cable" for name in names]
    return [f"{name}: which one is it of {fit}? {ALONE}" for name in names]


def _identify(path: str, change: Change, model: ServoModel, title: str, done: list[str]) -> str:
    """Give a servo its ID and rate; what stands against it, empty when it was done."""
    if change.baud not in model.baud_rates:
        return f"an {model.name} has no {change.baud} baud: set servos.baud"
    old, new = change.servo.id, change.id
    port = SerialPort(path, change.servo.baud, PING_TIMEOUT)
    port.openPort()
    try:
        line = ServoLine(port, PacketHandler())
        if line.store(reg.STATUS_RETURN_LEVEL, {old: b"\x02"}):
            return "answers a ping but no read"
        if new != old and line.ping(new) is not None:
            return f"ID {new} at {port.baudrate} baud is taken by another servo"
        torque = line.read(old, reg.TORQUE_ENABLE, 1)
        if torque != b"\x00":
            if line.store(reg.TORQUE_ENABLE, {old: b"\x00"}):
                return "torque could not be switched off"
            done.append(f"{title}: torque off, since EEPROM is locked while it is on")
        if new != old:
            line.tell(reg.ID, {old: bytes((new,))})
            if line.ping(new) != model.number:
                return f"ID {old} could not be set to {new}"
        if change.baud != port.baudrate:
            index = model.baud_rates.index(change.baud)
            line.tell(reg.BAUD_RATE, {new: bytes((index,))})
            time.sleep(_WRITTEN)
            port.setBaudRate(change.baud)
            if line.ping(new) != model.number:
                return f"no answer after its rate was set to {change.baud} baud"
    finally:
        port.closePort()
    return ""


# --- all else ------------------------------------------------------------------------------------


def _mend_one(
    line: ServoLine,
    servo_id: int,
    title: str,
    mode: int | None,
    done: list[str],
    problems: list[str],
) -> None:
    # A level of 0 leaves reads unanswered, so it is set before anything is read.
    if line.store(reg.STATUS_RETURN_LEVEL, {servo_id: b"\x02"}):
        problems.append(f"{title}: answers a ping but no read")
        return
    table = line.read(servo_id, 0, reg.BACKUP_READY)
    if table is None:
        problems.append(f"{title}: its registers could not be read")
        return
    if table[reg.HARDWARE_ERROR_STATUS]:
        error = reg.hardware_error_names(table[reg.HARDWARE_ERROR_STATUS])
        if not _reboot(line, servo_id):
            problems.append(f"{title}: no answer after a reboot ({error})")
            return
        done.append(f"{title}: rebooted, since it had a hardware error: {error}")
    elif table[reg.TORQUE_ENABLE]:
        if line.store(reg.TORQUE_ENABLE, {servo_id: b"\x00"}):
            problems.append(f"{title}: torque could not be switched off")
            return
        done.append(f"{title}: torque off, since EEPROM is locked while it is on")
    wanted = []
    now = table[reg.OPERATING_MODE]
    if mode is not None and now != mode:
        wanted.append((reg.OPERATING_MODE, mode, f"operating mode {now}"))
    drive = table[reg.DRIVE_MODE]
    if drive & DRIVE_UNFIT:
        wanted.append((reg.DRIVE_MODE, drive & ~DRIVE_UNFIT, f"drive mode {drive}"))
    delay = table[reg.RETURN_DELAY_TIME]
    if delay > RETURN_DELAY_MAX:
        wanted.append((reg.RETURN_DELAY_TIME, 0, f"return delay {delay}"))
    for address, value, text in wanted:
        if line.store(address, {servo_id: bytes((value,))}):
            problems.append(f"{title}: {text} could not be set to {value}")
        else:
            done.append(f"{title}: {text} → {value}")


def _reboot(line: ServoLine, servo_id: int) -> bool:
    line.handler.reboot(line.port, servo_id)
    end = time.monotonic() + _REBOOT_LIMIT
    while time.monotonic() < end:
        # Each ping waits for its deadline, and so paces this.
        if line.ping(servo_id, tries=1) is not None:
            return line.read(servo_id, reg.HARDWARE_ERROR_STATUS, 1) == b"\x00"
    return False
