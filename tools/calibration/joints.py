"""Run `calibrate joints` and `calibrate heat`: write servo data to a profile.

During `calibrate joints`, torque is off and the user moves each finger manually. The servo counts
are read in the closed, open and zero poses. `calibrate heat` fits the thermal constants to a
recording in which the hand holds an object for several minutes.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import re
import tomllib
from collections.abc import Mapping
from typing import Any

from softfinger.daemon.errors import ServoError, SettingsError
from softfinger.daemon.profile.load import find, load, profile_text
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.heat import set_law
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.checks import DRIVE_REVERSE, Registers
from softfinger.daemon.servos.protocol import ServoLine, open_line
from softfinger.daemon.types import FINGERS
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.servo_fit import fit_heat
from softfinger.kinematics.compiled.own_folder import write_whole
from softfinger.kinematics.hand.servo_heat import HeatLaw
from softfinger.tools.arguments import own_runtime_folder
from softfinger.tools.calibration.calibration_frames import bring
from softfinger.tools.recordings.reader import read_recording

_POSES = {
    "closed": "close the finger fully",
    "open": "open the finger fully",
    "zero": "point the finger straight away from the palm",
}
_LEAST = 0.2  # minimum joint rotation from open to closed [rad]
_ALONE = 0.25  # maximum ratio of the other joint's rotation to this joint's rotation
_MARGIN = 0.03  # margin between each joint stop and the commanded range [rad]
_Counts = dict[int, int]  # The keys are servo IDs.


def calibrate_joints(arguments: argparse.Namespace, settings: Settings) -> str:
    """Guide the user through each finger's poses, write the profile and return a summary.

    Raises ServoError, CalibrationError or SettingsError; the profile is then unchanged.
    """
    servos = settings.servos
    if servos.backend != "dynamixel":
        raise CalibrationError(
            f"servos.backend: found {servos.backend!r}, expected 'dynamixel': this step "
            "requires physical servos"
        )
    new: dict[str, dict[str, list[Any]]] = {
        "servos": {name: list(getattr(servos, name)) for name in ("ids", "direction", "zero")},
        "hand": {name: list(getattr(settings.hand, name)) for name in ("q_min", "q_max")},
    }
    scene = settings.scene.indices
    ids = [servos.ids[finger] for finger in scene]
    radian = 2.0 * math.pi / reg.COUNTS_PER_TURN / servos.gear_ratio
    told = []
    with open_line(servos.port, servos.baud) as line:
        _read(line, ids)
        for finger in scene:
            name = FINGERS[finger]
            at = {}
            for pose, wanted in _POSES.items():
                bring(arguments, f"{name} finger: {wanted}", finger=name, pose=pose)
                at[pose] = _read(line, ids)
            servo = _turned(name, at, radian)
            closed, opened, zero = (at[pose][servo] for pose in _POSES)
            direction = 1 if closed > opened else -1
            low, high = (direction * (counts - zero) * radian for counts in (opened, closed))
            found = (servo, direction, zero, round(low + _MARGIN, 3), round(high - _MARGIN, 3))
            lists = (each for values in new.values() for each in values.values())
            for each, value in zip(lists, found, strict=True):
                each[finger] = value
            old = servos.ids[finger]
            swapped = "" if servo == old else f" (servos.ids has {old}: the IDs are swapped)"
            told.append(
                f"{name}: servo {servo}{swapped}, direction {direction:+d}, zero {zero} counts, "
                f"{math.degrees(low):.1f}° to {math.degrees(high):.1f}°"
            )
    if len({new["servos"]["ids"][finger] for finger in scene}) < len(scene):
        raise CalibrationError(
            f"servo {new['servos']['ids'][0]} rotated when either finger was moved, expected one "
            "servo per finger: move one finger at a time"
        )
    return "\n  ".join([*told, *write_keys(arguments, new)])


def _read(line: ServoLine, ids: list[int]) -> _Counts:
    """Return all servo positions; raise ServoError if torque is on or a value exceeds one turn."""
    counts = {}
    for servo in ids:
        table = Registers.read(line, servo)
        if not table:
            raise ServoError(f"servo {servo}: no reply: run `softfinger doctor`")
        if table[reg.TORQUE_ENABLE]:
            raise ServoError(
                f"servo {servo}: torque is on: stop `softfinger run`, or send `disarm`"
            )
        counts[servo] = table.long(reg.PRESENT_POSITION)
        # After power-up, a servo's position is its encoder count, which is always less than one
        # turn.
        encoder = counts[servo] - table.long(reg.HOMING_OFFSET)
        if table[reg.DRIVE_MODE] & DRIVE_REVERSE:
            encoder = -encoder
        if not 0 <= encoder < reg.COUNTS_PER_TURN:
            raise ServoError(
                f"servo {servo}: found a position of {encoder} counts, expected 0 to "
                f"{reg.COUNTS_PER_TURN - 1} (one turn): switch the supply off and on again to "
                "reset the turn count; if the position is still outside this range, mount the horn "
                "half a turn further"
            )
    return counts


def _turned(name: str, at: dict[str, _Counts], radian: float) -> int:
    """Return the servo that rotated between the closed and open poses.

    Raises CalibrationError if it rotated too little, or if another servo rotated in any pose.
    """
    moved = {k: abs(at["closed"][k] - at["open"][k]) * radian for k in at["open"]}
    servo, *others = sorted(moved, key=lambda k: -moved[k])
    if moved[servo] < _LEAST:
        raise CalibrationError(
            f"{name} finger: found a range of {math.degrees(moved[servo]):.1f}° between closed and "
            f"open, expected at least {math.degrees(_LEAST):.0f}°"
        )
    for other in others:
        counts = [pose[other] for pose in at.values()]
        if (max(counts) - min(counts)) * radian > _ALONE * moved[servo]:
            raise CalibrationError(
                f"{name} finger: servos {servo} and {other} rotated, expected one servo: move "
                "only one finger"
            )
    return servo


def calibrate_heat(arguments: argparse.Namespace, settings: Settings) -> str:
    """Write the thermal constants to the profile and return a summary.

    Raises RecordingError, SettingsError, or CalibrationError if there is no recording or the hold
    is too short.
    """
    if len(arguments.recording) != 1:
        raise CalibrationError(
            "heat: expected --recording FILE, a recording of one grip made with `softfinger record`"
        )
    found = read_recording(arguments.recording[0])
    law, finger = HeatLaw(), arguments.finger
    rise, time = set_law(law, settings.changed(servos={"heat_rise": 0.0, "heat_time": 0.0}))
    known = found[f"{finger}.temperature"] > 0.0
    fit = fit_heat(
        law, *(found[key][known] for key in ("t", f"{finger}.current", f"{finger}.temperature"))
    )
    new = {"heat_rise": round(rise * fit.rise, 3), "heat_time": round(time * fit.time, 1)}
    write_keys(arguments, {"servos": new})
    return (
        f"{new['heat_rise']:.1f} ± {rise * fit.rise_std:.1f} K/A² in {new['heat_time']:.0f} ± "
        f"{time * fit.time_std:.0f} s, residual {fit.residual:.1f} °C"
    )


def write_keys(arguments: argparse.Namespace, new: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Write ``new`` settings to ``arguments.file``, and keep all other text.

    If the file does not exist, it is created as a copy of the profile.
    """
    changes = [f"{s}.{key} = {value}" for s, values in new.items() for key, value in values.items()]
    source = arguments.file if arguments.file.exists() else arguments.config
    load(source, arguments.dir or own_runtime_folder(), [*arguments.set, *changes])
    before = text = profile_text(find(source))
    for section, values in new.items():
        text = put(text, section, values)
    wanted = tomllib.loads(before)
    for section, values in new.items():
        wanted.setdefault(section, {}).update(values)
    found = None
    with contextlib.suppress(tomllib.TOMLDecodeError):
        found = tomllib.loads(text)
    if found != wanted:
        raise SettingsError(
            f"{source}: could not be changed; add these settings yourself: {', '.join(changes)}"
        )
    write_whole(arguments.file, text.encode())
    return changes


def put(text: str, section: str, values: Mapping[str, Any]) -> str:
    """Return a profile's text with ``values`` (arrays or numbers) set in ``[section]``.

    If the profile has no ``[section]`` header but uses dotted keys, ``section.key`` is used.
    """
    head = re.search(rf"(?m)^\[{section}\].*\n?", text)
    if head is None and not re.search(rf"(?m)^{section}\.", text):
        return put(f"{text.rstrip()}\n\n[{section}]\n", section, values)
    prefix = "" if head else f"{section}."
    start = head.end() if head else 0
    after = re.compile(r"(?m)^\[").search(text, start)
    end = after.start() if after else len(text)
    body = text[start:end]
    for key, value in reversed([*values.items()]):
        name = re.escape(prefix + key)
        body, found = re.subn(
            rf"(?m)^({name}\s*=\s*)(?:\[[^\]]*\]|[\w.+-]+)", rf"\g<1>{value}", body
        )
        if not found:
            body = f"{prefix}{key} = {value}\n{body}"
    return text[:start] + body + text[end:]
