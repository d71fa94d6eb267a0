"""Calibrate tactile frames, estimate the contact in each frame and filter the estimates.

`FingerPerception` processes each frame once. `hand_estimator` filters the estimates and predicts
the contacts on every tick.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.calibration_file import Converter, least_end
from softfinger.daemon.perception.finger_model import FingerModel, make_estimator, working_cells
from softfinger.daemon.perception.hand_estimator import HandEstimator
from softfinger.daemon.perception.unloaded_cells import UnloadedCells
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.tactile.base import TactileSensor
from softfinger.daemon.types import FINGERS, Event, Frame, SensorInfo, State
from softfinger.kinematics.estimation.estimator import ContactEstimate

_TARE_FRAME_COUNT = 16
_ZERO_INTERVAL = 8  # number of frames between zero updates; thermal drift takes seconds
_PRESSURE_STEPS = np.iinfo(np.uint16).max  # number of quantisation steps in a published pressure
_STORED_TIME = 2.0  # time for which frame digests are stored [s]
_CHANGED_CELLS_MIN = 4  # minimum number of changed cells; a few noisy cells may repeat by chance


class Perception:
    """Tactile sensors and contact filter for a hand. Only the loop thread may use this class."""

    def __init__(
        self,
        settings: Settings,
        sensors: Mapping[int, TactileSensor],
        models: tuple[FingerModel, FingerModel],
    ) -> None:
        """Create the perception stage; ``sensors`` maps finger indices to sensors."""
        self.events: list[Event] = []  # events that the loop publishes and then removes
        self.fingers = [
            FingerPerception(sensor, models[finger], settings, self.events)
            for finger, sensor in sorted(sensors.items())
        ]
        self.filter = HandEstimator(
            settings,
            (models[0].table, models[1].table),
            (models[0].material, models[1].material),
            (models[0].prior, models[1].prior),
        )

    def tare(self) -> None:
        """Start a tare, which sets each cell's zero offset to the mean of the next readings."""
        for each in self.fingers:
            each.tare()

    def update(self, state: State) -> None:
        """Process new frames, then write the contacts and the object pose for the current tick."""
        if not self.fingers:
            return
        for each in self.fingers:
            frame = each.update()
            if frame is not None:
                if each.repeats.is_fault:
                    frame = replace(frame, valid=False)
                contact = state.contacts[each.finger]
                self.filter.update(each.finger, frame, each.estimate, contact, each.has_changed)
        self.filter.write_contacts(state.t, state.contacts, state.object)


class RepeatDetector:
    """Detector for repeated sequences of frames.

    A noisy sensor never repeats a frame. While the hand is at rest, a noise-free sensor may send
    one frame repeatedly or alternate between two similar frames. The detector therefore ignores
    frames that differ from the previous frame in fewer than four cells. The frozen-sensor check
    handles constant frames.
    """

    def __init__(self, rate: float, fault_count: float, enabled: bool = True) -> None:
        """Create a detector for frames that arrive at ``rate`` [Hz].

        ``fault_count`` is the number of consecutive repeated frames that counts as a fault.
        """
        self._enabled = enabled
        self.period = 0  # repetition period in frames, or 0 if frames do not repeat
        self._repeated_count = 0  # number of consecutive frames that have repeated with `period`
        self._fault_count = fault_count
        self._digests: deque[int] = deque(maxlen=round(_STORED_TIME * rate))  # newest first
        self._last: NDArray[np.uint16] | None = None  # frame

    @property
    def is_repeating(self) -> bool:
        """True if the last two frames repeat two earlier frames in the same order."""
        return self._enabled and self._repeated_count > 1

    @property
    def is_fault(self) -> bool:
        """True if the number of consecutive repeated frames is too high to be a coincidence."""
        return self.is_repeating and self._repeated_count >= self._fault_count

    def update(self, data: NDArray[np.uint16]) -> bool:
        """Process a frame, and return True if the frame differs from the previous frame."""
        last, self._last = self._last, data.copy()
        changed = np.count_nonzero(data != last)
        if not changed:
            return False
        digest, digests = hash(data.tobytes()), self._digests
        is_stored = changed >= _CHANGED_CELLS_MIN and digest in digests
        lag = digests.index(digest) + 1 if is_stored else 0
        digests.appendleft(digest)
        continues = lag > 0 and lag == self.period
        self._repeated_count = self._repeated_count + 1 if continues else min(lag, 1)
        self.period = lag
        return True


class FingerPerception:
    """Sensor of one finger. The contact is estimated from each frame alone, without filtering."""

    def __init__(
        self, sensor: TactileSensor, model: FingerModel, settings: Settings, events: list[Event]
    ) -> None:
        """Create the perception stage for one finger. Each tare appends an event to ``events``."""
        # Some recordings specify the count at which their cells saturated.
        full = getattr(sensor, "full_count", None)
        if full is not None and full < settings.tactile.full_count:
            settings = settings.changed(tactile={"full_count": full})
        for note in getattr(sensor, "notes", ()):
            events.append(("warning", "tactile", note))
        tactile, calibration = settings.tactile, model.calibration
        self.finger = model.finger
        self.sensor = sensor
        self.frame: Frame | None = None
        self.frame_count = 0  # number of received frames
        self.has_changed = True  # False if the newest frame repeats an earlier frame
        self.changed_time = 0.0  # arrival time of the last frame with new data [s]
        # Disable the detector for recordings, because a looped recording repeats its frames.
        self.repeats = RepeatDetector(
            tactile.rate, settings.safety.frame_age_fault, tactile.backend != "replay"
        )
        self.estimate = ContactEstimate()  # estimate from the last valid frame
        active = getattr(sensor, "live", None)  # Some recordings contain only some of the cells.
        self._live = working_cells(settings, model.finger, active, calibration)
        self._estimator = make_estimator(
            settings, model.material, model.finger, active, calibration
        )
        self.full_count = float(tactile.full_count)
        self._scale = tactile.pascal_per_count  # pressure per unit of `_readings` [Pa]
        self._quantum = tactile.pascal_per_count  # pressure per sensor count [Pa]
        self._converter: Converter | None = None
        if calibration is not None:
            self._converter = Converter(calibration, tactile.pascal_per_count, tactile.full_count)
            self._converter.live = self._live
            self._scale = 1.0
            self._quantum = self._converter.quantum
        self._readings: NDArray[Any] | None = None  # newest frame [Pa or counts]
        self._publishes_pressure = settings.stream.tactile_unit == "Pa"
        self.info = self._info(settings, model)
        self._events = events
        self._zero: NDArray[np.uint16] | None = None  # zero offset if there is no converter
        self._unloaded = UnloadedCells(model.grid, settings.tip.radius, self._live)
        self._noise = tactile.noise  # cell noise from the settings [Pa]
        self._tare_sum: NDArray[np.uint32] | int = 0
        self._tare_remaining_count = 0

    @property
    def noise(self) -> float:
        """Measured standard deviation of the cell noise [Pa]; 0 if unknown."""
        return self._unloaded.scatter * self._quantum

    @property
    def is_taring(self) -> bool:
        """True while a tare is in progress."""
        return self._tare_remaining_count > 0

    def tare(self) -> None:
        """Start a tare, which sets each cell's zero offset to the mean of the next readings."""
        self._tare_sum = 0
        self._tare_remaining_count = _TARE_FRAME_COUNT

    def update(self) -> Frame | None:
        """Process and return a new frame, or return None if no new frame has arrived."""
        frame, last = self.sensor.latest(), self.frame
        if frame is None or frame is last:
            return None
        differs = self.repeats.update(frame.data)
        self.has_changed = differs and not self.repeats.is_repeating
        if differs:
            self.changed_time = frame.t_arrival
        self.frame = frame
        self.frame_count += 1
        counts = frame.data
        if self._tare_remaining_count and frame.valid:
            self._measure_zero(counts)
        if frame.valid:
            if self.frame_count % _ZERO_INTERVAL == 1:
                zero = self._zero if self._converter is None else self._converter.zero
                self._unloaded.update(counts, zero)
                self._estimator.noise = max(self._noise, self._unloaded.noise * self._quantum)
            counts = self._unloaded.corrected(counts, int(self.full_count))
        if self._converter is not None:
            readings: NDArray[Any] = self._converter(counts)
        elif self._zero is not None:
            readings = np.maximum(counts, self._zero) - self._zero
        else:
            readings = counts
        self._readings = readings
        if frame.valid:
            self.estimate = self._estimator.update(readings, self._scale)
        return frame

    def published(self) -> NDArray[np.uint16]:
        """Return the newest frame [rows, cols] in the unit that ``info`` specifies."""
        assert self.frame is not None
        assert self._readings is not None
        if not self._publishes_pressure:
            return self.frame.data
        if self._converter is None:
            return self._readings
        # If a tare has reduced the zero offset, a reading may exceed the largest published
        # pressure.
        steps = np.minimum(self._readings * (1.0 / self.info.scale), _PRESSURE_STEPS)
        return np.rint(steps).astype(np.uint16)

    def _info(self, settings: Settings, model: FingerModel) -> SensorInfo:
        scale = self._quantum
        if self._publishes_pressure and self._converter is not None:
            scale = self._converter.largest / _PRESSURE_STEPS
        grid = model.grid
        return SensorInfo(
            *grid.pitches,
            *grid.centre,
            rotation=grid.rotation,
            unit=settings.stream.tactile_unit,
            scale=scale,
            calibrated=self._publishes_pressure and self._converter is not None,
            calibration="" if model.calibration is None else model.calibration.identity,
        )

    def _measure_zero(self, counts: NDArray[np.uint16]) -> None:
        self._tare_sum = self._tare_sum + counts.astype(np.uint32)
        self._tare_remaining_count -= 1
        if self._tare_remaining_count:
            return
        mean, side = self._tare_sum / _TARE_FRAME_COUNT, FINGERS[self.finger]
        ends = self.full_count - np.round(mean)[self._live]
        if not np.median(ends) > 0.0:  # Most cells are saturated at their zero offset.
            text = f"the {side} sensor was not tared: most cells are saturated without contact"
            self._events.append(("warning", "tare", text))
            return
        self._unloaded.reset_zero()
        if self._converter is not None:
            moved = (mean - self._converter.zero)[self._live]
            self._converter.zero[:] = mean
            self._estimator.saturation = self._converter.saturation
        else:
            moved = (mean - (0 if self._zero is None else self._zero))[self._live]
            self._zero = np.round(mean).astype(np.uint16)
            self._estimator.saturation = least_end(ends)
        middle, most = float(np.median(moved)), float(moved[np.argmax(np.abs(moved))])
        text = (
            f"the {side} sensor's zero offsets changed: median {middle:+.1f} counts "
            f"({middle * self._quantum:+.0f} Pa), largest change {most:+.1f} counts"
        )
        self._events.append(("info", "tare", text))
