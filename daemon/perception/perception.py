"""From tactile frames to contacts: frame → estimate → table.

One `FingerPerception` a sensor; a frame that was seen already costs one comparison. What the tips
feel between frames is `perception.contact_filter`'s.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.perception.calibration_file import Converter, least_end
from softfinger.daemon.profile.factory import FingerModel, make_estimator
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.tactile.base import TactileSensor
from softfinger.daemon.types import Contact, Frame
from softfinger.daemon.wire.messages import SensorFacts
from softfinger.kinematics.contact.table import lookup
from softfinger.kinematics.hand.grasp_state import total_tilt

_TARE_FRAMES = 16
_STEPS = 65535  # of a published pressure


class FingerPerception:
    """One finger's tactile pipeline: newest frame in, its `Contact` filled in place."""

    def __init__(self, sensor: TactileSensor, model: FingerModel, settings: Settings) -> None:
        tactile, calibration = settings.tactile, model.calibration
        self.finger = model.finger
        self.sensor = sensor
        self.frame: Frame | None = None
        self.frames = 0  # that came
        live = getattr(sensor, "live", None)  # of a recording that lacks cells
        self._estimator = make_estimator(settings, model.material, model.finger, live, calibration)
        self._table = model.table.data
        self._scale = tactile.pascal_per_count
        self._full = float(tactile.full_count)
        self._converter: Converter | None = None
        if calibration is not None:
            self._converter = Converter(calibration, tactile.pascal_per_count)
            self._scale = 1.0
        self._converted: Frame | None = None  # whose pressure the converter holds
        self._pressure: NDArray[np.float64] | None = None
        self._as_pressure = settings.stream.tactile_unit == "Pa"
        self.facts = self._facts(settings, model)
        self._zero: NDArray[np.uint16] | None = None
        self._tare_sum: NDArray[np.uint32] | None = None
        self._tare_left = 0
        self._zero_before: tuple[NDArray[np.uint16] | None, float | None] = None, None
        self.tare_failed = ""  # why the last tare left the zero as it was, until that is told

    @property
    def taring(self) -> bool:
        """The zero is being learnt: what is felt now is not yet right."""
        return self._tare_left > 0

    def tare(self) -> None:
        """Take the mean of the next frames as zero, cell by cell."""
        self._tare_sum = None
        self._tare_left = _TARE_FRAMES

    def update(self, contact: Contact) -> bool:
        """Look for a new frame and fill ``contact`` from it; False when there was none."""
        frame = self.sensor.latest()
        if frame is None or frame is self.frame:
            return False
        self.frame = frame
        self.frames += 1
        contact.seq = frame.seq
        contact.t = frame.t_sample
        contact.t_arrival = frame.t_arrival
        if not frame.valid:
            contact.valid = False
            return True
        counts = frame.data
        if self._tare_left:
            self._learn_zero(counts)
        if self._converter is not None:
            self._pressure, self._converted = self._converter(counts), frame
            self.estimate(self._pressure, contact)
        else:
            if self._zero is not None:
                counts = np.maximum(counts, self._zero) - self._zero
            self.estimate(counts, contact)
        if contact.valid:
            contact.t_sound = frame.t_arrival
        return True

    def estimate(self, counts: NDArray[np.uint16] | NDArray[np.float64], contact: Contact) -> None:
        """Fill ``contact`` from counts, or from the pressure [Pa] of a calibrated sensor, alone."""
        estimate = self._estimator.update(counts, self._scale)
        contact.valid = estimate.valid
        contact.contact = estimate.contact
        contact.gain = estimate.gain
        contact.misfit = estimate.misfit
        if not estimate.contact:
            contact.d = contact.theta = contact.tilt_y = 0.0
            contact.force = contact.energy = 0.0
            contact.d_std = contact.theta_std = 0.0
            contact.inside = True
            return
        contact.d = estimate.d
        contact.theta = estimate.tilt_x
        contact.tilt_y = estimate.tilt_y
        contact.d_std = estimate.d_std
        contact.theta_std = estimate.tilt_x_std
        force, energy, _, _, _, _, inside = lookup(
            self._table, contact.d, total_tilt(contact.theta, contact.tilt_y)
        )
        # A softer or stiffer tip than the table's shows as the gain of its whole pressure map.
        contact.force = contact.gain * force
        contact.energy = contact.gain * energy
        contact.inside = inside

    def shown(self, frame: Frame) -> NDArray[np.uint16]:
        """The newest frame's data [rows, cols] for subscribers, in steps as ``facts`` tells."""
        if not self._as_pressure:
            return frame.data
        if self._converter is None:
            zero = self._zero
            return frame.data if zero is None else np.maximum(frame.data, zero) - zero
        if self._pressure is None or self._converted is not frame:
            self._pressure, self._converted = self._converter(frame.data), frame
        # A zero below the calibration's lets a cell read more than the scale was made for.
        steps = np.minimum(self._pressure * (1.0 / self.facts.scale), _STEPS)
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
        if self._tare_sum is None:
            self._zero_before = self._zero, self._estimator.saturation
            if self._converter is None:
                self._zero = None
                self._estimator.saturation = self._full
            self._tare_sum = np.zeros(counts.shape, np.uint32)
        self._tare_sum += counts
        self._tare_left -= 1
        if self._tare_left:
            return
        mean = self._tare_sum / _TARE_FRAMES
        ends = self._full - np.round(mean)
        if not np.median(ends) > 0.0:  # over such a zero no contact could be felt
            self._zero, self._estimator.saturation = self._zero_before
            self.tare_failed = "most cells are full where nothing presses"
        elif self._converter is not None:
            self._converter.zero[:] = mean
            self._estimator.saturation = self._converter.saturation
        else:
            self._zero = np.round(mean).astype(np.uint16)
            self._estimator.saturation = least_end(ends)
