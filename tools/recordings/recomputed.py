"""Recompute a recording's states from its inputs and compare them with the recorded states."""

from __future__ import annotations

import json
import math
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from softfinger.daemon.client.stream import read
from softfinger.daemon.errors import RecordingError
from softfinger.daemon.profile.load import without_files
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS, Frame
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import packer
from softfinger.tools.recordings.channels import flat
from softfinger.tools.recordings.reader import MessageSource, Recording

if TYPE_CHECKING:
    from softfinger.daemon.perception.finger_model import FingerModel

# These fields depend on the machine's timing, not on the loop's inputs.
_TIMING = frozenset({"tick_s", "compute_s", "wake_late_s", "overruns", "behind_s", "seq_step"})

_SETTINGS = ("settings", "calibration_left", "calibration_right")  # fields of hand/settings


@dataclass(slots=True)
class Difference:
    """Number of differences in a ``hand/state`` field, and the first and largest difference."""

    count: int = 0
    first_tick: int = 0
    recorded: Any = None  # recorded value at the first difference
    recomputed: Any = None
    worst: float = 0.0  # largest numerical difference
    worst_tick: int = 0


@dataclass(slots=True)
class Comparison:
    """Result of a comparison, with the tick count, the state count and the differing fields."""

    ticks: int = 0
    states: int = 0
    fields: int = 0
    from_start: bool = False  # True if the recording starts with the daemon's first tick
    missing_ticks: int = 0
    missing_frames: int = 0
    differences: dict[str, Difference] = field(default_factory=dict)


def recorded_settings(recording: MessageSource) -> tuple[Settings, list[str]]:
    """Return the recording's settings and its calibrations (JSON).

    File paths are removed from the settings, because recordings are not trusted. Raises
    RecordingError.
    """
    message = next((each for _, each in recording.messages([schema.SETTINGS])), None)
    if message is None:
        raise RecordingError(f"{recording.path}: the recording does not contain hand/settings")
    text, *calibrations = (message.get(name) for name in _SETTINGS)
    if not (isinstance(text, str) and all(isinstance(each, str) for each in calibrations)):
        raise RecordingError(
            f"{recording.path}: hand/settings does not contain {' or '.join(_SETTINGS)}"
        )
    try:
        settings = Settings.model_validate_json(text, strict=False)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = "".join(f"{part}: " for part in first["loc"])
        raise RecordingError(
            f"{recording.path}: the settings belong to another version: {where}{first['msg']}"
        ) from None
    return without_files(settings), [str(each) for each in calibrations]


def recorded_models(recording: MessageSource) -> tuple[FingerModel, FingerModel]:
    """Create the finger models from the recording's settings and calibrations.

    Raises RecordingError, SettingsError or TactileError.
    """
    return _models(*recorded_settings(recording))


def _models(settings: Settings, calibrations: list[str]) -> tuple[FingerModel, FingerModel]:
    """Create the finger models from settings and from the JSON text of each calibration."""
    from softfinger.daemon.perception.finger_model import make_models

    with tempfile.TemporaryDirectory() as folder:
        files = ["", ""]
        for finger, text in enumerate(calibrations):
            if text:
                path = Path(folder) / f"{FINGERS[finger]}.json"
                path.write_text(text, encoding="utf-8")
                files[finger] = str(path)
        return make_models(settings.changed(tactile={"calibration": (files[0], files[1])}))


def counts_of(
    recording: MessageSource, message: dict[str, Any], settings: Settings
) -> NDArray[np.uint16]:
    """Return a frame's counts.

    Raises RecordingError if the frame contains pressures or does not match the settings' grid.
    """
    if message.get("unit") != "count":
        raise RecordingError(
            f"{recording.path}: found frames in {message.get('unit')!r}, expected counts: "
            'record with stream.tactile_unit = "count"'
        )
    shape, expected = (message["rows"], message["cols"]), settings.tactile
    if shape != (expected.rows, expected.cols):
        raise RecordingError(
            f"{recording.path}: found frames of {shape[0]} × {shape[1]} cells, expected "
            f"{expected.rows} × {expected.cols} as in the settings: the recording or the settings "
            "belong to another hand"
        )
    return np.frombuffer(message["data"], "<u2").reshape(shape)


def recompute(
    recording: Recording,
    settings: Settings | None = None,
    progress: Callable[[int], None] | None = None,
) -> Comparison:
    """Run the control loop with the recorded inputs, and compare all states.

    ``settings`` replaces the recorded settings. Raises RecordingError if required topics or frames
    are missing, or if the recording contains several runs of the daemon.
    """
    own, calibrations = recorded_settings(recording)
    if not recording.count(schema.INPUT):
        raise RecordingError(
            f"{recording.path}: the recording does not contain hand/input, the inputs of each "
            "tick: record with --topics all, or with `softfinger run --record FILE`"
        )
    result = Comparison()
    try:
        _run(result, recording, settings or own, calibrations, progress)
    except (LookupError, TypeError, ValueError, ArithmeticError, struct.error) as error:
        raise RecordingError(
            f"{recording.path}: the messages do not form complete ticks: {error!r}"
        ) from error
    return result


def _run(
    result: Comparison,
    recording: Recording,
    used: Settings,
    calibrations: list[str],
    progress: Callable[[int], None] | None,
) -> None:
    # Importing the loop is slow, so recordings without settings or inputs are rejected earlier.
    from softfinger.daemon.loop.process_replay import ProcessReplay
    from softfinger.daemon.loop.publishing import parts

    machine = ProcessReplay(used, _models(used, calibrations))
    scene = parts(used)
    pack_state = packer(schema.STATE)
    newest = [0, 0]
    last = 0
    for tick, frames, commands, state in _ticks(recording, used, progress):
        if result.ticks == 0:
            result.from_start = tick["seq"] == 1
        elif tick["seq"] <= last:
            raise RecordingError(
                f"{recording.path}: found tick {tick['seq']} after tick {last}, because the daemon "
                "was restarted during the recording; expected a single run: record each run to "
                "its own file"
            )
        else:
            result.missing_ticks += tick["seq"] - last - 1
        last = tick["seq"]
        taken: dict[int, Frame] = {}
        for finger in machine.fingers:
            part = tick[FINGERS[finger]]
            if part["frame_seq"] == newest[finger]:
                continue
            newest[finger] = part["frame_seq"]
            counts = frames.get((finger, part["frame_seq"]))
            if counts is None:
                result.missing_frames += 1
                continue
            taken[finger] = Frame(
                part["frame_seq"],
                part["frame_t"],
                part["frame_arrival"],
                part["frame_valid"],
                counts,
            )
        now = machine.tick(tick, taken, commands)
        result.ticks += 1
        if state is not None:
            step = state.get("seq_step", 1)
            # Pack and unpack the state in the same way as the recorded state, so that types and
            # rounding are identical.
            again = msgpack.unpackb(pack_state(now, scene, step))
            _compare(result, state, again)


# Tick input, recent frames by (finger, seq), commands, and the state or None.
_Tick = tuple[
    dict[str, Any], dict[tuple[int, int], Any], list[dict[str, Any]], dict[str, Any] | None
]


def _ticks(
    recording: Recording, used: Settings, progress: Callable[[int], None] | None
) -> Iterator[_Tick]:
    """Yield all ticks; the file contains a tick's frames and commands, then input, then state."""
    wanted = (schema.INPUT, schema.TACTILE, schema.COMMAND, schema.STATE)
    frames: dict[tuple[int, int], Any] = {}
    commands: dict[int, list[dict[str, Any]]] = {}
    waiting: dict[str, Any] | None = None
    for topic, message in recording.messages(wanted, progress=progress):
        if topic == schema.TACTILE:
            if message.get("seq_step") != 1:
                raise RecordingError(
                    f"{recording.path}: found only 1 of {message.get('seq_step')} frames, expected "
                    "all frames: set stream.tactile_rate to the frame rate of the sensors and "
                    "record again"
                )
            finger = FINGERS.index(message["finger"])
            frames[finger, message["seq"]] = counts_of(recording, message, used)
            frames.pop((finger, message["seq"] - 2), None)
        elif topic == schema.COMMAND:
            command = read(schema.AnsweredCommand, message)
            request = _request(command.request) if command.ok else None
            if request is not None:
                commands.setdefault(command.tick, []).append(request)
        elif topic == schema.INPUT:
            if waiting is not None:
                yield waiting, frames, commands.pop(waiting["seq"], []), None
            waiting = message
        elif waiting is not None and message["seq"] == waiting["seq"]:
            yield waiting, frames, commands.pop(waiting["seq"], []), message
            waiting = None
    if waiting is not None:
        yield waiting, frames, commands.pop(waiting["seq"], []), None


def _request(text: str) -> dict[str, Any] | None:
    """Return a command's map, or None if the text contains no map."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _compare(result: Comparison, recorded: dict[str, Any], recomputed: dict[str, Any]) -> None:
    result.states += 1
    again, fields = flat(recomputed), 0
    for name, before in flat(recorded).items():
        if name in _TIMING:
            continue
        fields += 1
        after = again.get(name)
        if before == after or (before != before and after != after):
            continue
        seen = result.differences.get(name)
        tick = recorded["seq"]
        if seen is None:
            seen = result.differences[name] = Difference(0, tick, before, after)
        seen.count += 1
        if isinstance(before, float) and isinstance(after, float):
            size = abs(after - before)
            if not size <= seen.worst:
                seen.worst, seen.worst_tick = (math.inf if math.isnan(size) else size), tick
    result.fields = max(result.fields, fields)
