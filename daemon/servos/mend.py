"""Find servos on a port, and set up those of the settings as the backend needs them.

The one place that writes a servo's EEPROM, and only when it is asked to (`softfinger doctor
--fix`); the hand lets go meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

from daemon.records import FINGERS
from daemon.servos import registers as reg
from daemon.servos.base import ServoError
from daemon.servos.checks import RETURN_DELAY_MAX
from daemon.servos.line import ServoLine
from daemon.servos.models import by_name, by_number
from daemon.servos.modes import mode_number
from daemon.servos.packets import PacketHandler
from daemon.servos.port import SerialPort
from daemon.settings import Settings

_REBOOT_LIMIT = 2.0  # s that a servo may take to answer again
_PING_TIMEOUT = 0.02  # s, for factory-new servos with their return delay, behind slow adapters


@dataclass(frozen=True, slots=True)
class FoundServo:
    """A servo that answered a scan."""

    id: int
    baud: int
    number: int
    firmware: int

    @property
    def model(self) -> str:
        """The model's name, or its number where the table lacks it."""
        known = by_number(self.number)
        return known.name if known else f"model number {self.number}"


def scan(path: str, bauds: Iterable[int] = reg.BAUD_RATES, wait: float = 0.8) -> list[FoundServo]:
    """Every servo on the port, at each of the rates; ``wait`` s for each rate.

    Rates that the adapter has not are passed over.

    Raises:
        ServoError: the port can't be opened at any of them.
    """
    found: list[FoundServo] = []
    handler = PacketHandler()
    opened, refusal = False, None
    for baud in bauds:
        port = SerialPort(path, baud, _PING_TIMEOUT)
        try:
            port.openPort()
        except ServoError as error:
            refusal = refusal or error
            continue
        opened = True
        try:
            for servo_id, (number, firmware) in ServoLine(port, handler).ping_all(wait).items():
                found.append(FoundServo(servo_id, baud, number, firmware))
        finally:
            port.closePort()
    if refusal is not None and not opened:
        raise refusal
    return found


def mend(settings: Settings) -> list[str]:
    """Set each servo of the scene up: mode, no return delay, status return level 2, no errors.

    Returns one line for each thing that was done; none when all was well already. IDs and rates
    are left alone.

    Raises:
        ServoError: the port can't be opened, or a servo that is missing, of another model, or
            that would not take a value, one line each; what could be done was done.
    """
    servos = settings.servos
    try:
        model = by_name(servos.model)
    except KeyError as error:
        raise ServoError(f"servos.model: {error.args[0]}") from None
    port = SerialPort(servos.port, servos.baud, _PING_TIMEOUT)
    port.openPort()
    done: list[str] = []
    problems: list[str] = []
    try:
        line = ServoLine(port, PacketHandler())
        for name in settings.scene.fingers:
            servo_id = servos.ids[FINGERS.index(name)]
            title = f"servo {servo_id} ({name})"
            number = line.ping(servo_id)
            if number is None:
                problems.append(f"{title}: no answer at {port.baudrate} baud")
            elif number != model.number:
                problems.append(f"{title}: is not an {model.name}: set servos.model")
            else:
                mode = mode_number(servos)
                wanted = mode if mode in model.modes else None
                _mend_one(line, servo_id, title, wanted, done, problems)
    finally:
        port.closePort()
    if problems:
        raise ServoError("\n".join(problems + [f"(done: {text})" for text in done]))
    return done


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
