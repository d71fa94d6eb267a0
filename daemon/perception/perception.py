"""Perception of each finger: its newest frame calibrated and estimated, then filtered.

`FingerPerception` estimates each frame once; `hand_estimator` carries the estimates on
to the contacts of every tick.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.calibration_file import Converter, least_end
from softfinger.daemon.perception.finger_model import FingerModel, make_estimator
from softfinger.daemon.perception.hand_estimator import HandEstimator
from softfinger.daemon.perception.zero import UnpressedCells
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.tactile.base import TactileSensor
from softfinger.daemon.types import FINGERS, Event, Frame, SensorFacts, State
from softfinger.kinematics.estimation.estimator import ContactEstimate

_TARE_FRAMES = 16
_ZERO_EVERY = 8  # frames: what warmth moves takes seconds
_STEPS = 65535  # of a published pressure
_REMEMBERED = 2.0  # s of frames that are known again
_REPEATED = 0.1  # s of frames that come again, from which on that is no chance …
_DISTINCT = 5  # … and how many they are at least
_CELLS = 4  # that change from each to the next: one or two that flicker come again by chance


class Perception:
    """A hand's tactile sensors and the filter of its contacts. Only the loop's thread calls it."""

    def __init__(
        self,
        settings: Settings,
        sensors: Mapping[int, TactileSensor],
        models: tuple[FingerModel, FingerModel],
    ) -> None:
        """``sensors`` by finger, none in a scene without."""
        self.events: list[Event] = []  # the loop takes them out
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
        """Take the mean of the next frames as zero, cell by cell."""
        for each in self.fingers:
            each.tare()

    def update(self, state: State) -> None:
        """Take in new frames; write the contacts and the object's pose of this tick."""
        if not self.fingers:
            return
        for each in self.fingers:
            frame = each.update()
            if frame is not None:
                if each.repeats.long:
                    frame = replace(frame, valid=False)
                contact = state.contacts[each.finger]
                self.filter.update(each.finger, frame, each.estimate, contact, each.changes)
        self.filter.write_contacts(state.t, state.contacts, state.object)


class Repeats:
    """Notices frames that come again in the order in which they came before.

    A sensor with noise never repeats one. One without, at rest, sends the same frame for long, or
    one of two: that is no repetition; what stays the same is judged as a frozen sensor.
    """

    def __init__(self, rate: float, enabled: bool = True) -> None:
        """``rate``: of the frames [Hz]; ``enabled``: to repeat them is wrong."""
        self._enabled = enabled
        self.lag = 0  # frames after which they come again, 0: they don't
        self._run = 0  # frames in a row that did so
        self._enough = max(round(_REPEATED * rate), _DISTINCT)
        self._digests: deque[int] = deque(maxlen=round(_REMEMBERED * rate))  # newest first
        self._last: NDArray[np.uint16] | None = None  # frame

    @property
    def again(self) -> bool:
        """True if the last two frames came in this order before."""
        return self._enabled and self._run > 1

    @property
    def long(self) -> bool:
        """True if the frames have repeated for long enough to be sure."""
        return self.again and self._run >= self._enough

    def differs(self, data: NDArray[np.uint16]) -> bool:
        """Take in a frame; return whether it differs from the last."""
        last, self._last = self._last, data.copy()
        changed = np.count_nonzero(data != last)
        if not changed:
            return False
        digest, digests = hash(data.tobytes()), self._digests
        lag = digests.index(digest) + 1 if changed >= _CELLS and digest in digests else 0
        digests.appendleft(digest)
        self._run = self._run + 1 if lag and lag == self.lag else min(lag, 1)
        self.lag = lag
        return True


class FingerPerception:
    """One finger's sensor: its newest frame, and what is estimated from that frame alone."""

    def __init__(
        self, sensor: TactileSensor, model: FingerModel, settings: Settings, events: list[Event]
    ) -> None:
        """``events`` takes a tare that failed."""
        full = getattr(sensor, "full_count", None)  # of a recording that has its own
        if full is not None and full < settings.tactile.full_count:
            own = settings.tactile.model_copy(update={"full_count": full})
            settings = settings.model_copy(update={"tactile": own})
        for note in getattr(sensor, "notes", ()):
            events.append(("warning", "tactile", note))
        tactile, calibration = settings.tactile, model.calibration
        self.finger = model.finger
        self.sensor = sensor
        self.frame: Frame | None = None
        self.frames = 0  # that came
        self.changes = True  # the newest tells anything new
        self.changed = 0.0  # when one that differs from its last arrived [s]
        # A recording that plays from its start again repeats itself.
        self.repeats = Repeats(settings.tactile.rate, tactile.backend != "replay")
        self.estimate = ContactEstimate()  # of the last valid frame
        active = getattr(sensor, "live", None)  # of a recording that lacks cells
        self._estimator = make_estimator(
            settings, model.material, model.finger, active, calibration
        )
        self._full = float(tactile.full_count)
        self._scale = tactile.pascal_per_count  # of the readings
        self._quantum = tactile.pascal_per_count  # of a count where nothing presses
        self._converter: Converter | None = None
        if calibration is not None:
            self._converter = Converter(calibration, tactile.pascal_per_count, tactile.full_count)
            self._scale = 1.0
            self._quantum = self._converter.quantum
        self._readings: NDArray[Any] | None = None  # of the newest frame: counts over zero, or Pa
        self._as_pressure = settings.stream.tactile_unit == "Pa"
        self.facts = self._facts(settings, model)
        self._events = events
        self._zero: NDArray[np.uint16] | None = None  # where there is no converter
        live = np.ones(model.grid.shape, np.bool_) if active is None else active
        self._unpressed = UnpressedCells(model.grid, settings.tip.radius, live)
        self._noise = tactile.noise  # of a cell, as set [Pa]
        self._tare_sum: NDArray[np.uint32] | int = 0
        self._tare_left = 0

    @property
    def noise(self) -> float:
        """Standard deviation that the cells show [Pa]; 0 where that is not known."""
        return self._unpressed.scatter * self._quantum

    @property
    def full_count(self) -> float:
        """The reading of a saturated cell [counts]."""
        return self._full

    @property
    def taring(self) -> bool:
        """The zero is being learnt."""
        return self._tare_left > 0

    def tare(self) -> None:
        """Take the mean of the next frames as zero, cell by cell."""
        self._tare_sum = 0
        self._tare_left = _TARE_FRAMES
        self._unpressed.forget_zero()

    def update(self) -> Frame | None:
        """Return the newest frame, estimated, where it is a new one; None where it is not."""
        frame, last = self.sensor.latest(), self.frame
        if frame is None or frame is last:
            return None
        differs = self.repeats.differs(frame.data)
        self.changes = differs and not self.repeats.again
        if differs:
            self.changed = frame.t_arrival
        self.frame = frame
        self.frames += 1
        counts = frame.data
        if self._tare_left and frame.valid:
            self._learn_zero(counts)
        if frame.valid:
            if self.frames % _ZERO_EVERY == 1:
                self._unpressed.follow(counts)
                self._estimator.noise = max(self._noise, self._unpressed.noise * self._quantum)
            counts = self._unpressed.corrected(counts, int(self._full))
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
        """Return the newest frame's data [rows, cols] for subscribers; unit and scale are in
        ``facts``.
        """
        assert self.frame is not None
        assert self._readings is not None
        if not self._as_pressure:
            return self.frame.data
        if self._converter is None:
            return self._readings
        # A zero below the calibration's lets a cell read more than the scale was made for.
        steps = np.minimum(self._readings * (1.0 / self.facts.scale), _STEPS)
        return np.rint(steps).astype(np.uint16)

    def _facts(self, settings: Settings, model: FingerModel) -> SensorFacts:
        scale = settings.tactile.pascal_per_count
        if self._converter is not None:
            scale = (
                self._converter.largest / _STEPS if self._as_pressure else self._converter.quantum
            )
        grid = model.grid
        return SensorFacts(
            *grid.pitches,
            *grid.centre,
            rotation=grid.rotation,
            unit=settings.stream.tactile_unit,
            scale=scale,
            calibrated=self._as_pressure and self._converter is not None,
            calibration="" if model.calibration is None else model.calibration.identity,
        )

    def _learn_zero(self, counts: NDArray[np.uint16]) -> None:
        self._tare_sum = self._tare_sum + counts.astype(np.uint32)
        self._tare_left -= 1
        if self._tare_left:
            return
        mean = self._tare_sum / _TARE_FRAMES
        ends = self._full - np.round(mean)
        if not np.median(ends) > 0.0:  # over such a zero no contact could be felt
            side = FINGERS[self.finger]
            text = f"{side} sensor's zero stays: most cells are full where nothing presses"
            self._events.append(("warning", "tare", text))
        elif self._converter is not None:
            self._converter.zero[:] = mean
            self._estimator.saturation = self._converter.saturation
        else:
            self._zero = np.round(mean).astype(np.uint16)
            self._estimator.saturation = least_end(ends)
