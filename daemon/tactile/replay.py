"""Replace a sensor with recorded frames or with frames that the caller sets."""

from __future__ import annotations

import bisect
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.clock import Clock
from softfinger.daemon.errors import RecordingError, TactileError
from softfinger.daemon.profile.settings import TactileSettings
from softfinger.daemon.tactile.frame_files import FrameRecording, load_recording
from softfinger.daemon.types import FINGERS, Frame

# Maximum relative difference between the pitch in the file and the pitch in the settings.
_PITCH_TOLERANCE = 0.01


def pitch_difference(recording: FrameRecording, pitch: tuple[float, float]) -> str:
    """Describe how the cell size in a file differs from ``pitch`` (x, y) [m].

    The text is empty if the cell sizes agree or if the file does not state a cell size.
    """
    if recording.pitch is None:
        return ""
    pairs = zip(recording.pitch, pitch, strict=True)
    if all(abs(found / each - 1.0) < _PITCH_TOLERANCE for found, each in pairs):
        return ""
    x, y = (each * 1e3 for each in recording.pitch)
    return (
        f"found cells of {x:.4g} × {y:.4g} mm in the header, expected {pitch[0] * 1e3:.4g} × "
        f"{pitch[1] * 1e3:.4g} mm as in tactile.pitch: set tactile.pitch = {x * 1e-3:.6g}, "
        f"tactile.pitch_y = {y * 1e-3:.6g}"
    )


class GivenFrames:
    """Sensor whose newest ``frame`` is set by the caller.

    ``live`` [rows, cols] is False where the sensor has no cell; None means that all cells exist.
    ``full_count`` is the reading of saturated cells; None selects the value in the settings.
    """

    def __init__(
        self, live: NDArray[np.bool_] | None = None, full_count: int | None = None
    ) -> None:
        self.frame: Frame | None = None
        self.live = live
        self.full_count = full_count

    def open(self) -> None:
        """Do nothing, because there is no port."""

    def latest(self) -> Frame | None:
        """Return the frame that was set most recently."""
        return self.frame

    def counters(self) -> dict[str, int]:
        """Return an empty dict, because there are no errors to count."""
        return {}

    def close(self) -> None:
        """Do nothing, because there is no port."""


class ReplayTactile:
    """Backend that replays a recording at its recorded times, starting when ``open`` is called.

    The recording restarts one mean frame interval after the last frame. If ``tactile.replay_again``
    is false, the last frame is repeated once with ``valid`` False, and the replay ends. ``error``
    states this reason. ``live`` [rows, cols] is False where the recording has no cell.
    ``full_count`` is the reading of saturated cells, or None if the recording does not state it.
    ``notes`` describes suspicious properties of the recording.
    """

    error = "the recording has ended, and tactile.replay_again is false"

    def __init__(self, settings: TactileSettings, clock: Clock, finger: int) -> None:
        """Load the recording.

        Raises TactileError if the recording is unreadable or has a different grid.
        """
        path = settings.recording[finger]
        if not path:
            raise TactileError(f"tactile.recording: found no file for the {FINGERS[finger]} finger")
        try:
            recording = load_recording(Path(path), settings)
        except RecordingError as error:
            raise TactileError(str(error)) from None
        if recording.counts.shape[1:] != (settings.rows, settings.cols):
            rows, cols = recording.counts.shape[1:]
            raise TactileError(
                f"{path}: found frames of {rows} × {cols} cells, expected {settings.rows} × "
                f"{settings.cols}: set tactile.rows and tactile.cols"
            )
        if wrong := pitch_difference(recording, settings.pitches):
            raise TactileError(f"{path}: {wrong}")
        self.notes = tuple(f"{path}: {note}" for note in recording.notes)
        self.full_count = recording.full_count
        self.live: NDArray[np.bool_] = recording.live
        self._recording: FrameRecording = recording
        self._again = settings.replay_again
        self._clock = clock
        self._latency = settings.latency
        self._times: list[float] = recording.t.tolist()
        count = len(self._times)
        interval = self._times[-1] / (count - 1) if count > 1 else 1.0 / settings.rate
        self._period = self._times[-1] + interval
        self._start = 0.0
        self._due = math.inf
        self._frame: Frame | None = None

    def open(self) -> None:
        """Start the replay at the recording's first frame."""
        self._start = self._due = self._clock.now()
        self._frame = None
        self.latest()

    def latest(self) -> Frame | None:
        """Return the newest frame that is due, or None before `open`."""
        now = self._clock.now() + 1e-9  # This margin keeps rounding errors from delaying a frame.
        if now < self._due:
            return self._frame
        turn = math.floor((now - self._start) / self._period)
        ended = turn > 0 and not self._again
        if ended:
            turn = 0
        begin = self._start + turn * self._period
        count = len(self._times)
        k = max(bisect.bisect_right(self._times, now - begin) - 1, 0)
        arrival = begin + self._times[k]
        due = begin + (self._times[k + 1] if k + 1 < count else self._period)
        self._due = math.inf if ended else due
        seq = turn * count + k + 1 + ended
        data = self._recording.counts[k]
        self._frame = Frame(seq, arrival - self._latency, arrival, not ended, data)
        return self._frame

    def counters(self) -> dict[str, int]:
        """Return the number of ``frames`` since `open`; all other counts are always 0."""
        frames = 0 if self._frame is None else self._frame.seq
        return {"frames": frames, "resyncs": 0, "skipped_bytes": 0}

    def close(self) -> None:
        """Stop delivering frames."""
        self._due = math.inf
