"""Finding servos on a port: which answer at which rate, and where several answer at once.

Everything is asked, and nothing is changed in any servo.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from softfinger.daemon.errors import ServoError
from softfinger.daemon.servos import registers as reg
from softfinger.daemon.servos.line import ServoLine
from softfinger.daemon.servos.models import by_number
from softfinger.daemon.servos.packets import PacketHandler
from softfinger.daemon.servos.port import SerialPort

PING_TIMEOUT = 0.02  # s, for factory-new servos with their return delay, behind slow adapters
FACTORY_ID = 1
_PROBES = 8  # reads of the whole table
_TABLE = reg.BACKUP_READY  # registers 0 … 146


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


@dataclass(frozen=True, slots=True)
class Garbled:
    """An ID whose replies come damaged: several servos have it, or the line is bad."""

    id: int
    baud: int

    def __str__(self) -> str:
        factory = ", as all have from the factory" if self.id == FACTORY_ID else ""
        return (
            f"replies of ID {self.id} at {self.baud} baud come damaged: several servos have that "
            f"ID{factory}, or the line is bad"
        )


ALONE = (
    "connect one servo alone, then `softfinger doctor --fix`; then the next one beside it, and the "
    "same again"
)


@dataclass(frozen=True, slots=True)
class Found:
    """All that a port has. A servo may be in ``servos`` and its ID in ``garbled``."""

    servos: tuple[FoundServo, ...]
    garbled: tuple[Garbled, ...]


def search(
    path: str,
    bauds: Iterable[int] = reg.BAUD_RATES,
    wait: float = 0.8,
    ids: Iterable[int] = (FACTORY_ID,),
) -> Found:
    """Every servo on the port, at each of the rates; ``wait`` s for each rate.

    Rates that the adapter has not are passed over. Where damaged bytes came, ``ids`` are asked one
    by one.

    Raises:
        ServoError: the port can't be opened at any of the rates.
    """
    found: list[FoundServo] = []
    garbled: list[Garbled] = []
    opened, refusal = False, None
    for baud in bauds:
        port = SerialPort(path, baud, PING_TIMEOUT)
        try:
            port.openPort()
        except ServoError as error:
            refusal = refusal or error
            continue
        opened = True
        try:
            handler = PacketHandler()
            line = ServoLine(port, handler)
            answers = line.ping_all(wait)
            noisy = _damage(handler) > 0
            found += [FoundServo(each, baud, *what) for each, what in answers.items()]
            for servo_id in sorted({*answers, *(ids if noisy else ())}):
                if talks_garbled(line, servo_id):
                    garbled.append(Garbled(servo_id, baud))
        finally:
            port.closePort()
    if refusal is not None and not opened:
        raise refusal
    return Found(tuple(found), tuple(garbled))


def scan(path: str, bauds: Iterable[int] = reg.BAUD_RATES, wait: float = 0.8) -> list[FoundServo]:
    """The servos of :func:`search`."""
    return list(search(path, bauds, wait).servos)


def talks_garbled(line: ServoLine, servo_id: int) -> bool:
    """Whether several servos answer to this ID at once, as far as their registers differ.

    Supply voltage, position and running time do, a reply of a ping does not.
    """
    handler = line.handler
    before = _damage(handler)
    damaged = 0
    for _ in range(_PROBES):
        line.handler.readTxRx(line.port, servo_id, 0, _TABLE)
        damaged += _damage(handler) > before
        before = _damage(handler)
    return damaged > 1  # one alone may be a disturbance


def _damage(handler: PacketHandler) -> int:
    return handler.crc_errors + handler.torn + handler.skipped_bytes
