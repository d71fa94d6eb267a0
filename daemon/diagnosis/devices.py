"""Check the servos in the scene and the frames of each tactile board.

The checks do not change settings. `softfinger doctor --fix` calls the `repair` functions, which
configure adapters and servos. These functions switch torque off before they write a servo's EEPROM,
so the hand goes limp.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from softfinger.daemon.clock import RealClock, emulated
from softfinger.daemon.errors import ServoError, TactileError
from softfinger.daemon.perception.calibration_file import (
    Calibration,
    CalibrationFileError,
    Converter,
    calibration_for,
)
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.servos.checks import (
    Examined,
    check_latency_timer,
    examine,
    latency_file,
)
from softfinger.daemon.servos.control_table import ServoModel, by_name
from softfinger.daemon.servos.exchange import (
    EXCHANGE_COUNT,
    choose_reads,
    judge_exchanges,
    time_exchanges,
)
from softfinger.daemon.servos.joint import GOAL_SIZE
from softfinger.daemon.servos.protocol import GroupWrite, ServoLine, open_line
from softfinger.daemon.servos.provisioning import (
    FACTORY_ID,
    ONE_SERVO_ONLY,
    SEARCH_TIME,
    plan,
    provision,
    search,
)
from softfinger.daemon.servos.torque import goal_address
from softfinger.daemon.tactile.base import make_sensor
from softfinger.daemon.types import FINGERS, Frame

_LISTEN_TIME = 0.5  # duration of the frame rate measurement [s]
_REST_NOISE_RATIO = 3.0  # maximum median pressure without load, as a multiple of the cell noise
_RATE_TOLERANCE = 0.1  # tolerated relative error of the frame rate
_POISSON_TOLERANCE = 0.02  # tolerance for Poisson's ratio, set by the calibration accuracy


def check_servos(settings: Settings) -> list[Finding]:
    """Check each servo in the scene. If a servo does not reply, search for it at all baud rates."""
    servos = settings.servos
    model = by_name(servos.model)
    try:
        with open_line(servos.port, servos.baud) as line:
            ids = [servos.ids[finger] for finger in settings.scene.indices]
            line.wait_for(ids, servos.open_timeout)
            found = examine(line, settings, model)
            exchange = _try_exchange(line, settings, model, found)
            silent = [each.joint.id for each in found if not each.replies]
            late = [servo_id for servo_id in silent if line.ping(servo_id) is not None]
        results = [
            line for each in found for line in _judge(each, settings, model, each.joint.id in late)
        ]
        results += exchange
        if len(late) < len(silent):
            results += _search(settings, model) or _blame_power(found)
    except ServoError as error:
        return [Finding("FAIL", "servos", str(error))]
    return results


def _try_exchange(
    line: ServoLine, settings: Settings, model: ServoModel, found: list[Examined]
) -> list[Finding]:
    """If all servos are usable, measure how long the reads and writes of a tick take.

    The writes use the address and length of the loop's writes. The writes contain the current
    register values, so no register changes. Writes are omitted if torque is on, if the firmware
    versions differ, or if a register cannot be read.
    """
    if not all(each.table and not each.errors for each in found):
        return []
    ids = [each.joint.id for each in found]
    firmwares = [each.table[reg.FIRMWARE_VERSION] for each in found]
    try:
        reads, results = choose_reads(line, ids, all(map(model.fast_read, firmwares)))
    except ServoError as error:
        return [Finding("FAIL", "exchange", str(error))]
    mode = reg.MODE_NUMBERS[settings.servos.mode]
    address = goal_address(mode, model, firmwares[0])
    held = [line.read(servo_id, address, GOAL_SIZE[mode]) for servo_id in ids]
    obstacles = {
        "torque is on": any(each.table[reg.TORQUE_ENABLE] for each in found),
        "the firmware versions differ": len(set(firmwares)) > 1,
        "a goal register cannot be read": None in held,
    }
    reasons = " and ".join(reason for reason, applies in obstacles.items() if applies)
    write, what = None, f"{EXCHANGE_COUNT} read cycles (no writes, because {reasons})"
    if not reasons:
        group = GroupWrite(line.port, address, GOAL_SIZE[mode], ids)
        write = partial(group.send, [value for value in held if value is not None])
        what = f"{EXCHANGE_COUNT} read and write cycles"
    times = time_exchanges(line.port, reads, write)
    return [*results, judge_exchanges(times, settings, what, emulated(settings))]


def _judge(servo: Examined, settings: Settings, model: ServoModel, late: bool) -> list[Finding]:
    """Return one servo's findings; ``late`` is True if the servo replied after the timeout."""
    name = servo.joint.name
    if not servo.replies:
        waited = settings.servos.open_timeout
        problem = (
            f"no reply at {settings.servos.baud} baud within servos.open_timeout = {waited:g} s"
        )
        fix = "check the power supply and the cable, and read the findings below"
        if late:
            fix = "set a longer servos.open_timeout, because the servo replies now"
        return [Finding("FAIL", name, problem, fix)]
    if servo.errors:
        return servo.findings
    described = Finding("pass", name, _described(servo, model))
    return [*servo.findings, servo.misplaced or described]


def _described(servo: Examined, model: ServoModel) -> str:
    volts = servo.table.word(reg.PRESENT_INPUT_VOLTAGE) * reg.VOLTAGE_UNIT
    mode = reg.MODE_NAMES[servo.table[reg.OPERATING_MODE]]
    return (
        f"{model.name}, firmware {servo.table[reg.FIRMWARE_VERSION]}, {mode} mode, {volts:.1f} V, "
        f"{servo.table[reg.PRESENT_TEMPERATURE]} °C"
    )


def _search(settings: Settings, model: ServoModel) -> list[Finding]:
    """Search for servos at every baud rate of the model; explain how to use each servo found."""
    servos = settings.servos
    found = search(servos.port, model.baud_rates, SEARCH_TIME, {FACTORY_ID, *servos.ids})
    if found.old:
        return found.old_protocol()
    if not found.servos and not found.garbled:
        problem = f"no servo replies on {servos.port} at any baud rate"
        return [Finding("FAIL", "servos", problem, "check the power supply and the bus cable")]
    what = plan(found, settings, model)
    lines = [Finding("FAIL", "servos", str(each), ONE_SERVO_ONLY) for each in found.garbled]
    for change in what.changes:
        same = change.servo.id == change.id
        other = f"servos.baud = {change.servo.baud}" if same else "servos.ids"
        fix = f"run `softfinger doctor --fix` to use it as {change.name}: {change}; or set {other}"
        lines.append(Finding("note", "found", str(change.servo), fix))
    for each in what.strangers:
        fix = ONE_SERVO_ONLY if what.missing and each.number == model.number else ""
        lines.append(Finding("note", "found", str(each), fix))
    return lines


def _blame_power(examined: list[Examined]) -> list[Finding]:
    """Report the likely cause of missing servos if the search has found no other servos."""
    at = reg.PRESENT_INPUT_VOLTAGE
    volts = [each.table.word(at) * reg.VOLTAGE_UNIT for each in examined if each.table]
    problem = "no other servo replies at any baud rate"
    if not volts:
        return [Finding("note", "found", problem)]
    fix = "replace the cable between the servos; if this does not help, check the power supply"
    return [
        Finding(
            "note",
            "found",
            f"{problem}; the supply voltage of the servo that replies is {min(volts):.1f} V",
            fix,
        )
    ]


def check_law(settings: Settings, finger: int) -> Finding:
    """Compare a tip's contact law in the settings with the result of `calibrate law`."""
    name, tip = f"tip {FINGERS[finger]}", settings.tip
    try:
        calibration = calibration_for(settings, finger)
    except CalibrationFileError as error:
        return Finding("FAIL", name, str(error), "`softfinger calibrate`")
    if calibration is None or not calibration.wants:
        problem = (
            f"tip.physics is {tip.physics!r}, which has not been verified with presses on this tip"
        )
        return Finding("note", name, problem, "`softfinger calibrate law`")
    for key, wanted in calibration.wants.items():
        found = getattr(tip, key)
        near = isinstance(wanted, float) and key == "poisson"
        if found != wanted and not (near and abs(found - wanted) <= _POISSON_TOLERANCE):
            problem = f"tip.{key} is {found!r}, but `calibrate law` found {wanted!r}"
            return Finding("warn", name, problem, f"set tip.{key}")
    return Finding("pass", name, f"{tip.physics}, as found by `calibrate law`")


def check_board(settings: Settings, finger: int) -> Finding:
    """Check that a board sends frames of the configured grid size at the configured rate."""
    tactile = settings.tactile
    name = f"tactile {FINGERS[finger]}"
    sensor = make_sensor(settings, RealClock(), None, finger)
    assert sensor is not None
    try:
        calibration = calibration_for(settings, finger)
        sensor.open()
    except TactileError as error:
        return Finding("FAIL", name, str(error))
    try:
        before, start = sensor.counters(), time.monotonic()
        time.sleep(_LISTEN_TIME)
        frame = sensor.latest()  # Some plugins read the board only when `latest` is called.
        after, spent = sensor.counters(), time.monotonic() - start
    finally:
        sensor.close()
    frames = after.get("frames", 0) - before.get("frames", 0)
    rate = frames / spent
    found = f"{tactile.rows} × {tactile.cols} cells, {rate:.0f} frames per second"
    lost = after.get("skipped_bytes", 0) - before.get("skipped_bytes", 0)
    if lost:
        fix = "check the cable, and move other devices to another USB hub"
        return Finding("warn", name, f"{found}, but {lost} bytes were corrupted or lost", fix)
    rest = 0.0 if frame is None else _rest(settings, calibration, frame)
    if rest > _REST_NOISE_RATIO * tactile.noise:
        text = (
            f"{found}, but half of the cells read {rest / 1e3:.1f} kPa or more without load "
            "(expected 0 kPa)"
        )
        fix = "run `softfinger calibrate tare` once, or `softfinger send tare` after each start"
        return Finding("warn", name, text, fix)
    # The frame count may be off by one, depending on the timing.
    if abs(frames - tactile.rate * spent) > max(_RATE_TOLERANCE * tactile.rate * spent, 1.5):
        text = f"{found}, expected {tactile.rate:g}"
        fix = f"if this machine is not busy, set tactile.rate = {rate:.0f}"
        return Finding("warn", name, text, fix)
    return Finding("pass", name, found)


def _rest(settings: Settings, calibration: Calibration | None, frame: Frame) -> float:
    """Return the median pressure of all cells [Pa].

    The median is the pressure of an unloaded cell, because a contact loads fewer than half of the
    cells.
    """
    scale = settings.tactile.pascal_per_count
    if calibration is None:
        return scale * float(np.median(frame.data))
    converter = Converter(calibration, scale)
    return float(np.median(converter(frame.data)[converter.live]))


def repair_latency_timer(path: str, *sysfs: Path) -> Finding | None:
    """Set the adapter's latency timer to 1 ms; return None if no change is necessary."""
    place = latency_file(path, *sysfs)
    found = check_latency_timer(path, 1.0, *sysfs)
    if place is None or found is None or found.status == "pass":
        return None
    subject = f"{path} latency timer"
    try:
        place.write_text("1")
    except OSError as error:
        problem = f"could not be set: {(error.strerror or 'refused').lower()}"
        return Finding("warn", subject, problem, f"echo 1 | sudo tee {place}")
    return Finding("fixed", subject, "set to 1 ms")


def repair_servos(settings: Settings) -> list[Finding]:
    """Configure the scene's servos for the daemon; return one finding per change."""
    try:
        found = provision(settings)
    except ServoError as error:
        return [Finding("warn", "servos", f"not repaired: {error}")]
    return [
        each if each.status == "fixed" else replace(each, text=f"not repaired: {each.text}")
        for each in found
    ]
