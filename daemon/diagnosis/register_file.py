"""Save the servos' registers to a file, and restore them from a file.

The file contains JSON with the register names from `servos.register_table.REGISTERS`:
``{"servos": [{"id": 1, "model": "XM430-W350", "firmware": 48, "registers": {NAME: value}}]}``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from pydantic import ValidationError, model_validator

from softfinger.daemon.errors import ServoError
from softfinger.daemon.own_files import read_file, write_text
from softfinger.daemon.profile.fields import Section
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.servos.checks import Registers
from softfinger.daemon.servos.joint import servo_name
from softfinger.daemon.servos.protocol import ServoLine, open_line
from softfinger.daemon.servos.register_table import REGISTERS

_FILE_SIZE_MAX = 1 << 20  # maximum file size [bytes]
_PASS_COUNT = 2  # number of passes; a servo may reject a lower limit until the upper limit is set


class StoredServo(Section):
    """Entry for one servo in a register file."""

    id: int
    model: str
    firmware: int
    registers: dict[str, int]

    @model_validator(mode="after")
    def _fit(self) -> StoredServo:
        known = {each.name: each for each in REGISTERS}
        for name, value in self.registers.items():
            if name not in known:
                raise ValueError(f"unknown register {name!r}")
            bits = 8 * known[name].size
            if not -(1 << bits - 1) <= value < 1 << bits:
                raise ValueError(f"{name}: found {value}, expected {bits} bits")
        return self


class StoredServos(Section):
    """Contents of a register file."""

    servos: tuple[StoredServo, ...]


def save_registers(settings: Settings, path: Path) -> list[Finding]:
    """Save the registers of each servo that replies, except for ID and baud rate.

    Raises ServoError if the file already exists, because it may be the only copy of older values.
    """
    if path.is_file():
        raise ServoError(
            f"{path}: already exists; choose another file, or move this file elsewhere"
        )
    servos: list[StoredServo] = []
    found = []
    with _open(settings) as line:
        for finger in settings.scene.indices:
            servo_id = settings.servos.ids[finger]
            table = Registers.read(line, servo_id)
            if not table:
                found.append(Finding("FAIL", servo_name(servo_id, finger), "not saved: no reply"))
                continue
            number = table.word(reg.MODEL_NUMBER)
            values = {each.name: each.value_in(table) for each in REGISTERS}
            firmware = table[reg.FIRMWARE_VERSION]
            servos.append(
                StoredServo(
                    id=servo_id, model=reg.name_of(number), firmware=firmware, registers=values
                )
            )
            text = f"{len(values)} registers saved to {path}"
            found.append(Finding("note", servo_name(servo_id, finger), text))
    if servos:
        with write_text(path) as file:
            file.write(StoredServos(servos=tuple(servos)).model_dump_json(indent=1) + "\n")
    return found


def restore_registers(settings: Settings, path: Path) -> list[Finding]:
    """Write the registers saved by :func:`save_registers` to servos with the same ID and model.

    Raises ServoError if the file format is invalid.
    """
    stored = _stored(path)
    result: list[Finding] = []
    with _open(settings) as line:
        for finger in settings.scene.indices:
            servo_id = settings.servos.ids[finger]
            name, kept = servo_name(servo_id, finger), stored.get(servo_id)
            if kept is None:
                result.append(
                    Finding(
                        "warn", name, f"not restored: {path} contains no servo with ID {servo_id}"
                    )
                )
                continue
            number = line.ping(servo_id)
            model = "no reply" if number is None else reg.name_of(number)
            if model != kept.model:
                text = (
                    f"not restored: {path} contains the registers of an {kept.model}, found {model}"
                )
                result.append(Finding("warn", name, text))
                continue
            _restore(line, servo_id, name, kept.registers, result)
    return result


def _restore(
    line: ServoLine, servo_id: int, name: str, values: dict[str, int], result: list[Finding]
) -> None:
    if line.store(reg.TORQUE_ENABLE, {servo_id: b"\0"}):
        result.append(Finding("warn", name, "not restored: torque could not be switched off"))
        return
    # After a watchdog stop, goals are read-only until 0 is written to the watchdog register.
    line.store(reg.BUS_WATCHDOG, {servo_id: b"\0"})
    tables: list[bytes] = []
    # Write the operating mode first, because this write resets gains, profiles and goals.
    order = sorted(REGISTERS, key=lambda each: each.address != reg.OPERATING_MODE)
    for turn in range(_PASS_COUNT + 1):
        table = Registers.read(line, servo_id)
        if not table:
            result.append(Finding("warn", name, "not restored: the registers could not be read"))
            return
        tables.append(table)
        for each in order if turn < _PASS_COUNT else ():
            if each.name in values and each.value_in(table) != values[each.name]:
                line.store(each.address, {servo_id: each.packed(values[each.name])})
    for each in REGISTERS:
        wanted, old, now = (
            values.get(each.name),
            each.value_in(tables[0]),
            each.value_in(tables[-1]),
        )
        if wanted is None or wanted == old == now:
            continue
        if now == wanted:
            result.append(Finding("fixed", name, f"{each.name} {old} → {now}"))
        else:
            text = f"{each.name} {now} could not be set to {wanted}"
            result.append(Finding("warn", name, text))


@contextlib.contextmanager
def _open(settings: Settings) -> Iterator[ServoLine]:
    """Open the servo port and wait for the servos, as `softfinger run` does."""
    servos = settings.servos
    with open_line(servos.port, servos.baud) as line:
        ids = [servos.ids[finger] for finger in settings.scene.indices]
        line.wait_for(ids, servos.open_timeout)
        yield line


def _stored(path: Path) -> dict[int, StoredServo]:
    """Read a register file and return a dictionary of its servos, keyed by ID.

    Raises ServoError if the file format is invalid.
    """
    try:
        stored = StoredServos.model_validate_json(read_file(path, _FILE_SIZE_MAX))
    except OSError as error:
        raise ServoError(f"{path}: {error.strerror or error}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "contents"
        raise ServoError(
            f"{path}: {where}: {first['msg']}; expected a file written by `softfinger "
            "doctor --save`"
        ) from None
    return {each.id: each for each in stored.servos}
