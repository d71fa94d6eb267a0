"""The tactile sensor under one tip of the simulated hand, in this process and without a thread."""

from __future__ import annotations

import math

import numpy as np

from daemon.clock import Clock
from daemon.model import make_grid, make_material, make_tip
from daemon.records import Frame
from daemon.settings import Settings
from daemon.simulation import layout
from daemon.simulation.hand import SimulatedHand
from daemon.simulation.sensor_model import SensorModel


class SimulatedTactile:
    """Frames of one fingertip of a :class:`SimulatedHand`.

    A frame is due at every k / ``tactile.rate`` since the hand's start, shows the contact of that
    instant and arrives ``simulation.tactile_delay`` later. Only the newest that has arrived is
    rendered, and only when it is asked for; ``seq`` counts the others too.
    """

    def __init__(self, settings: Settings, hand: SimulatedHand, clock: Clock, finger: int) -> None:
        self._hand = hand
        self._clock = clock
        self._finger = finger
        self._delay = settings.simulation.tactile_delay
        self._period = 1.0 / settings.tactile.rate
        # A few roundings of the clock's value, so that a frame due now counts as come.
        self._slack = 1e-9
        self._shape = (settings.tactile.rows, settings.tactile.cols)
        self._model = SensorModel(
            make_grid(settings, finger),
            make_tip(settings),
            make_material(settings.material),
            settings.tactile.pascal_per_count,
            noise=settings.simulation.tactile_noise,
            seed=(settings.simulation.seed, finger),
            gain=settings.simulation.modulus_scale,
            dead=settings.tactile.dead[finger],
            threshold=settings.tactile.threshold,
        )
        self._newest = -1
        self._frame: Frame | None = None
        self._next_arrival = math.inf

    def open(self) -> None:
        """Wait for the first frame to arrive."""
        self._next_arrival = self._hand.start + self._delay
        self._clock.sleep_until(self._next_arrival)
        self.latest()

    def latest(self) -> Frame | None:
        """The newest frame that has arrived, None before the first or when not open."""
        now = self._clock.now() + self._slack
        if now < self._next_arrival:
            return self._frame
        start = self._hand.start
        number = math.floor((now - start - self._delay) / self._period)
        # Rounding may put the floor one off an arrival that falls on the clock's value.
        number = max(number, self._newest + 1)
        self._hand.advance(now)
        self._frame = self._render(number)
        self._newest = number
        self._next_arrival = start + (number + 1) * self._period + self._delay
        return self._frame

    def counters(self) -> dict[str, int]:
        """``frames`` that arrived since open; ``resyncs`` and ``skipped_bytes`` stay 0."""
        return {"frames": self._newest + 1, "resyncs": 0, "skipped_bytes": 0}

    def close(self) -> None:
        """Deliver nothing more."""
        self._next_arrival = math.inf

    def _render(self, number: int) -> Frame:
        sample = self._hand.sample(number)
        d = float(sample[layout.SAMPLE_D + self._finger])
        theta = float(sample[layout.SAMPLE_THETA + self._finger])
        share = float(sample[layout.SAMPLE_GAIN + self._finger])
        # Force goes with d²: half a tip on the face's edge presses with half the force.
        d = d * math.sqrt(share) if abs(theta) < 0.5 * math.pi else 0.0
        data = np.empty(self._shape, dtype=np.uint16)
        self._model.frame(d, theta, 0.0, data)
        sampled = self._hand.start + number * self._period
        return Frame(
            seq=number + 1,
            t_sample=sampled,
            t_arrival=sampled + self._delay,
            valid=True,
            data=data,
        )
