"""What a recording holds, as columns for pictures: states, truth, statistics, commands, the model.

Reads and orders; nothing here draws.
"""

from __future__ import annotations

import json
import math
import tempfile
from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.control.modes import Mode
from softfinger.daemon.errors import RecordingError, SettingsError, SoftfingerError, TactileError
from softfinger.daemon.loop.process_replay import with_calibrations
from softfinger.daemon.perception.finger_model import FingerModel, make_models
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.recomputed import recorded_settings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MODES = tuple(mode.value for mode in Mode)
GRIPS = (Mode.GRASPING.value, Mode.HOLDING.value, Mode.ROTATING.value)

_TICK = ("seq", "mono_ns", "timestamp", "tick_s", "compute_s", "wake_late_s", "overruns")
_FINGER = (
    *("valid", "contact", "q", "goal_q", "current", "goal_current", "temperature"),
    *("d", "theta", "force", "energy", "d_std", "theta_std", "gain"),
)
_OBJECT = ("valid", "angle")
_SINCE = ("goal_force", "goal_angle")  # older recordings have none
_TRUE = ("d", "theta", "force")
_TRUE_OBJECT = ("angle",)
_GAP = 0.1  # s without a state, at least, over which no line is drawn


class Missing(SoftfingerError):
    """What a picture needs is not in the recording. The message says what."""


@dataclass(frozen=True)
class Run:
    """A recording, or a part of it. SI units; ``t`` counts from the recording's first message.

    ``states`` and ``truth`` hold one array a field, by the names of the stream, nested ones with a
    dot; ``mode`` are indices into MODES. ``truth`` is empty, and ``stats`` None, where the
    recording has none. ``commands`` were carried out, in their order.
    """

    name: str
    settings: Settings | None
    models: tuple[FingerModel, FingerModel] | None
    why_no_model: str
    states: dict[str, FloatArray]
    modes: NDArray[np.int64]
    faults: list[tuple[float, str]]  # t and reason of each that was latched
    truth: dict[str, FloatArray]
    stats: dict[str, Any] | None
    commands: list[dict[str, Any]]
    offset: float  # timestamp at t = 0

    @cached_property
    def t(self) -> FloatArray:
        """Time of each state [s], by the daemon's monotonic clock."""
        mono, wall = self.states["mono_ns"], self.states["timestamp"]
        if not mono.size:
            return mono
        t: FloatArray = (mono - mono[0]) * 1e-9 + (wall[0] - self.offset)
        return t

    @cached_property
    def fingers(self) -> tuple[str, ...]:
        """The fingers that took part."""
        return tuple(name for name in FINGERS if self.states[f"{name}.valid"].any())

    def touching(self, finger: str) -> BoolArray:
        """Where the finger's numbers are sound and something touches it."""
        sound = (self.states[f"{finger}.valid"] > 0.0) & (self.states[f"{finger}.contact"] > 0.0)
        return sound & np.isfinite(self.states[f"{finger}.d"])

    def gapped(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """t and ``values`` with a NaN in each gap of the stream, where a line shall break."""
        t = self.t
        steps = np.diff(t)
        longest = max(_GAP, 10.0 * float(np.median(steps))) if steps.size else math.inf
        at = np.flatnonzero((steps > longest) | (steps < 0.0)) + 1
        return np.insert(t, at, t[at - 1] if at.size else t[:0]), np.insert(values, at, np.nan)

    @cached_property
    def gripping(self) -> BoolArray:
        """Where the hand closes on, holds or turns an object."""
        return np.isin(self.modes, [MODES.index(mode) for mode in GRIPS])

    def goal_force(self) -> FloatArray:
        """What the grip went to [N]: what was asked for, or more where the tips would slip."""
        return self.states["goal_force"]

    def goal_angle(self) -> FloatArray:
        """The angle that the grip turned to or kept [rad], as the hand went by it."""
        return self.states["goal_angle"]

    def target_force(self) -> FloatArray:
        """The force asked for by the last ``grasp`` while its grip lasts [N], else NaN."""
        default = math.nan if self.settings is None else self.settings.control.force_default
        return self._asked("grasp", "force", default)

    def target_angle(self) -> FloatArray:
        """The angle asked for by the last ``rotate`` while the grip lasts [rad], else NaN."""
        return self._asked("rotate", "angle", math.nan)

    def _asked(self, command: str, key: str, default: float) -> FloatArray:
        """Of the last such command in the same grip, at each state."""
        seq = self.states["seq"]
        asked = np.full(seq.size, np.nan)
        edges = np.flatnonzero(np.diff(self.gripping)) + 1
        for first, last in zip([0, *edges], [*edges, seq.size], strict=True):
            if not self.gripping[first:last].any():
                continue
            began = seq[first - 1] if first else -math.inf  # the grip's own command is later
            for each in self.commands:
                if each["command"] == command and began <= each["tick"] <= seq[last - 1]:
                    value = json.loads(each["request"]).get(key, default)
                    asked[first:last][seq[first:last] >= each["tick"]] = value
        return asked

    def matched(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices of the states, and of the truths, that are of the same tick."""
        pair: tuple[Any, NDArray[np.intp], NDArray[np.intp]] = np.intersect1d(
            self.states["mono_ns"], self.truth["mono_ns"], return_indices=True
        )
        return pair[1], pair[2]

    def need_states(self) -> None:
        """Raises Missing without a state."""
        if not self.t.size:
            raise Missing("no hand/state in it")

    def need_model(self) -> tuple[FingerModel, FingerModel]:
        """Both fingers' models. Raises Missing when the recording doesn't tell them."""
        if self.models is None:
            raise Missing(self.why_no_model)
        return self.models

    def need_contact(self) -> list[str]:
        """The fingers that ever touched something. Raises Missing when none did."""
        self.need_states()
        touched = [name for name in self.fingers if self.touching(name).any()]
        if not touched:
            raise Missing("no contact in it")
        return touched


def load_run(
    recording: Recording,
    start: float,
    end: float,
    cache: Path | None,
    progress: Callable[[int], None] | None = None,
) -> Run:
    """Read what pictures need from ``start`` to ``end`` s. Raises RecordingError."""
    states = _Columns(_TICK, {**dict.fromkeys(FINGERS, _FINGER), "object": _OBJECT}, _SINCE)
    truth = _Columns(("seq", "mono_ns"), {**dict.fromkeys(FINGERS, _TRUE), "object": _TRUE_OBJECT})
    modes, faults, commands = array("q"), [], []
    stats: dict[str, Any] | None = None
    fault = ""
    wanted = {schema.STATE, schema.TRUTH, schema.STATS}
    for topic, message in recording.messages(wanted, start, end, progress):
        if topic == schema.TRUTH:
            truth.take(message)
        elif topic == schema.STATS:
            stats = message
        elif states.take(message):
            mode = message.get("mode")
            modes.append(MODES.index(mode) if mode in MODES else -1)
            said = str(message.get("fault") or "")
            if said and said != fault:
                faults.append((message["timestamp"] - recording.start, said))
            fault = said
    # From the file's start on: what was asked for before a part begins still holds in it.
    for _, message in recording.messages({schema.COMMAND}, end=end):
        if message.get("ok") is True and isinstance(message.get("tick"), int):
            commands.append(message)
    settings, models, why = _model(recording, cache)
    return Run(
        recording.path.name,
        settings,
        models,
        why,
        states.arrays(),
        np.array(modes, np.int64),
        faults,
        truth.arrays() if truth.count else {},
        stats,
        commands,
        recording.start,
    )


def _model(
    recording: Recording, cache: Path | None
) -> tuple[Settings | None, tuple[FingerModel, FingerModel] | None, str]:
    try:
        settings, calibrations = recorded_settings(recording)
    except RecordingError as error:
        return None, None, str(error).removeprefix(f"{recording.path}: ")
    try:
        with tempfile.TemporaryDirectory() as folder:
            models = make_models(with_calibrations(settings, calibrations, Path(folder)), cache)
    except (SettingsError, TactileError, ValueError) as error:
        return settings, None, f"its model can't be made: {error}"
    return settings, models, ""


class _Columns:
    """Maps of one kind into one array a field. A map that is not of that kind is passed over."""

    def __init__(
        self, own: Iterable[str], nested: dict[str, tuple[str, ...]], since: tuple[str, ...] = ()
    ) -> None:
        """``since`` are fields that older recordings lack: NaN there."""
        self._own = tuple(own)
        self._nested = nested
        self._since = since
        self.names = [*self._own, *(f"{part}.{name}" for part in nested for name in nested[part])]
        self.names += since
        self._values = array("d")
        self.count = 0

    def take(self, message: dict[str, Any]) -> bool:
        """One more row; False when it is none."""
        try:
            row = [float(message[name]) for name in self._own]
            for part, names in self._nested.items():
                inner = message[part]
                row += [float(inner[name]) for name in names]
            row += [float(message.get(name, math.nan)) for name in self._since]
        except (KeyError, TypeError, ValueError):
            return False
        self._values.extend(row)
        self.count += 1
        return True

    def arrays(self) -> dict[str, FloatArray]:
        """By name, float64 [rows]."""
        table = np.array(self._values, np.float64).reshape(-1, len(self.names)).T
        return {
            name: np.ascontiguousarray(column)
            for name, column in zip(self.names, table, strict=True)
        }
