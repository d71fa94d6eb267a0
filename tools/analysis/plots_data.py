"""A recording as columns for pictures: states, truth, the model."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.client.records import read, to_columns
from softfinger.daemon.errors import RecordingError, SettingsError, SoftfingerError, TactileError
from softfinger.daemon.loop.process_replay import with_calibrations
from softfinger.daemon.perception.finger_model import FingerModel, make_models
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire import schema
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.recomputed import recorded_settings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_GAP = 0.1  # s without a state, at least, that breaks a line


class Missing(SoftfingerError):
    """The recording lacks what a picture needs. The message says what."""


@dataclass(frozen=True)
class RecordedRun:
    """A recording, or a part of it. SI units; ``t`` counts from the recording's first message.

    ``states`` and ``truth`` are one array a field, by the names of the stream, nested ones with a
    dot. ``truth`` is empty where the recording has none.
    """

    name: str
    models: tuple[FingerModel, FingerModel] | None
    why_no_model: str
    states: dict[str, NDArray[Any]]
    truth: dict[str, NDArray[Any]]
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
        """Return where the finger's state is valid and in contact."""
        of = {name: self.states[f"{finger}.{name}"] for name in ("valid", "contact", "d")}
        return np.asarray(of["valid"] & of["contact"] & np.isfinite(of["d"]))

    def gapped(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return t and ``values`` with a NaN in each gap of the stream, which breaks the line."""
        t = self.t
        steps = np.diff(t)
        longest = max(_GAP, 10.0 * float(np.median(steps))) if steps.size else math.inf
        at = np.flatnonzero((steps > longest) | (steps < 0.0)) + 1
        return np.insert(t, at, t[at - 1] if at.size else t[:0]), np.insert(values, at, np.nan)

    def matched(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return indices of the states and the truths of the same ticks."""
        pair: tuple[Any, NDArray[np.intp], NDArray[np.intp]] = np.intersect1d(
            self.states["mono_ns"], self.truth["mono_ns"], return_indices=True
        )
        return pair[1], pair[2]

    def need_states(self) -> None:
        """Raise Missing without a state."""
        if not self.t.size:
            raise Missing("no hand/state in it")

    def need_model(self) -> tuple[FingerModel, FingerModel]:
        """Return both fingers' models. Raises Missing without them."""
        if self.models is None:
            raise Missing(self.why_no_model)
        return self.models

    def need_contact(self) -> list[str]:
        """Return the fingers that ever touched something. Raises Missing when none did."""
        self.need_states()
        touched = [name for name in self.fingers if self.touching(name).any()]
        if not touched:
            raise Missing("no contact in it")
        return touched


def load_run(
    recording: Recording,
    start: float,
    end: float,
    progress: Callable[[int], None] | None = None,
) -> RecordedRun:
    """Read what pictures need from ``start`` to ``end`` s. Raises RecordingError."""
    found: dict[bytes, list[Any]] = {schema.STATE: [], schema.TRUTH: []}
    for topic, message in recording.messages(found, start, end, progress):
        found[topic].append(read(schema.TOPICS[topic].record, message))
    states, truths = found.values()
    truth = to_columns(truths) if truths else {}
    return RecordedRun(
        recording.path.name, *_model(recording), to_columns(states), truth, recording.start
    )


def _model(recording: Recording) -> tuple[tuple[FingerModel, FingerModel] | None, str]:
    try:
        settings, calibrations = recorded_settings(recording)
    except RecordingError as error:
        return None, str(error).removeprefix(f"{recording.path}: ")
    try:
        with tempfile.TemporaryDirectory() as folder:
            models = make_models(with_calibrations(settings, calibrations, Path(folder)))
    except (SettingsError, TactileError, ValueError) as error:
        return None, f"its model can't be made: {error}"
    return models, ""
