"""Which servo of a bus is meant by which ID of the settings, where IDs or rates are not theirs yet.

Pure: it decides what may be set without a guess; setting it is :mod:`servos.mend`'s affair.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.models import ServoModel
from softfinger.daemon.servos.scanning import Found, FoundServo
from softfinger.daemon.types import FINGERS


@dataclass(frozen=True, slots=True)
class Change:
    """A servo that is to get the ID and rate of a finger's."""

    servo: FoundServo
    finger: int
    id: int
    baud: int

    def __str__(self) -> str:
        changes = []
        if self.servo.id != self.id:
            changes.append(f"ID {self.servo.id} → {self.id}")
        if self.servo.baud != self.baud:
            changes.append(f"{self.servo.baud} → {self.baud} baud")
        return ", ".join(changes)


@dataclass(frozen=True, slots=True)
class Plan:
    """``changes`` that leave no doubt, and what else stands against the settings."""

    changes: tuple[Change, ...]
    missing: tuple[int, ...]  # fingers whose servo is not known yet
    strangers: tuple[FoundServo, ...]  # that answer and are nobody's


def plan(found: Found, settings: Settings, model: ServoModel, rates: Sequence[int]) -> Plan:
    """Who is who, of what was found at ``rates``.

    A servo of the settings' model that has a missing servo's ID, at another rate, is that servo.
    Failing that, one single servo that is nobody's is the single missing one. Whatever is garbled
    stays as it is.
    """
    servos = settings.servos
    ids = {servos.ids[FINGERS.index(name)]: FINGERS.index(name) for name in settings.scene.fingers}
    seen = Counter(each.id for each in found.servos)
    # A stand-in without pace answers at whatever rate it is asked.
    anywhere = {servo_id for servo_id, count in seen.items() if 1 < count == len(rates)}
    home = {each.id for each in found.servos if each.baud == servos.baud and each.id in ids}
    bad = {(each.id, each.baud) for each in found.garbled}
    strangers = [
        each
        for each in found.servos
        if (each.baud != servos.baud or each.id not in ids)
        and not (each.id in anywhere and each.baud != servos.baud)
        and (each.id, each.baud) not in bad
    ]
    # At the settings' rate an ID of theirs is that finger's, although the scene leaves it out.
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
