"""Asks every servo of the scene who it is and how it is set up; changes nothing in any of them."""

from __future__ import annotations

from dataclasses import dataclass

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import registers as reg
from softfinger.daemon.servos.checks import MEND, Findings, check_servo
from softfinger.daemon.servos.line import ServoLine
from softfinger.daemon.servos.models import ServoModel
from softfinger.daemon.types import FINGERS

CHECKED = reg.BACKUP_READY  # registers 0 … 146 are looked at


@dataclass(frozen=True, slots=True)
class Examined:
    """One servo of the scene. ``table`` is empty when it could not be read."""

    finger: int
    id: int
    answers: bool  # to a ping
    table: bytes
    findings: Findings

    @property
    def name(self) -> str:
        """How it is called in reports."""
        return servo_name(self.id, self.finger)

    @property
    def position(self) -> int:
        """Present position in counts."""
        span = self.table[reg.PRESENT_POSITION : reg.PRESENT_POSITION + 4]
        return int.from_bytes(span, "little", signed=True)

    def word(self, address: int) -> int:
        """A register of two bytes."""
        return int.from_bytes(self.table[address : address + 2], "little")

    def long(self, address: int) -> int:
        """A register of four bytes, signed."""
        return int.from_bytes(self.table[address : address + 4], "little", signed=True)


def servo_name(servo_id: int, finger: int) -> str:
    """``servo 1 (left)``."""
    return f"servo {servo_id} ({FINGERS[finger]})"


def examine(line: ServoLine, settings: Settings, model: ServoModel) -> list[Examined]:
    """Ping, read and judge each servo of the scene, in the scene's order."""
    found = []
    for name in settings.scene.fingers:
        finger = FINGERS.index(name)
        servo_id = settings.servos.ids[finger]
        title = servo_name(servo_id, finger)
        if line.ping(servo_id) is None:
            found.append(Examined(finger, servo_id, False, b"", Findings()))
            continue
        table = line.read(servo_id, 0, CHECKED)
        if table is None:
            why = (
                f"{title}: answers a ping but no read (status return level 0, two servos with "
                f"this ID, or a bad line): "
                f"{MEND}"
            )
            found.append(Examined(finger, servo_id, True, b"", Findings(errors=(why,))))
            continue
        findings = check_servo(title, model, table, settings, finger)
        found.append(Examined(finger, servo_id, True, table, findings))
    return found
