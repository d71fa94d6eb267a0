"""Simulate the tactile sensor under one tip of the simulated hand."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.clock import Clock
from softfinger.daemon.profile.factory import make_grid, make_material, make_tip
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.faults import REPLAY_TIME_MAX
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.simulation.sensor_model import SensorModel
from softfinger.daemon.types import Frame


def make_sensor_model(settings: Settings, finger: int) -> SensorModel:
    """Create the pressure sensor model for one simulated tip."""
    simulation, tactile = settings.simulation, settings.tactile
    return SensorModel(
        make_grid(settings, finger),
        make_tip(settings),
        make_material(settings.material),
        tactile,
        simulation,
        seed=(simulation.seed, finger),
        gain=simulation.modulus_scale * simulation.tactile_gain[finger],
        dead=tactile.dead[finger],
    )


class StageTouch(NamedTuple):
    """Contact between a tip and the stage at one instant."""

    d: float  # m
    theta: float  # rad
    pressure: float  # uniform pressure on all cells [Pa]; a positive value replaces the contact


class SimulatedTactile:
    """Frame source for one fingertip of a :class:`SimulatedHand`.

    The hand's settings define the sensor. Frame k samples the contact at the time k /
    ``tactile.rate`` after the hand's start. A frame arrives at least ``simulation.tactile_delay``
    after its sample time, or is lost (see :class:`Arrivals`). As with real sensors, the exact
    sample time of a frame is unknown. The estimated sample time is the nominal arrival time minus
    ``settings.tactile.latency``. Only the newest frame is computed, and only on request. Frames
    that are not computed still increase ``seq``. The hand's ``measurement_faults`` are applied to
    the frames.

    If the function ``stage`` is set, it defines the contact, and the object is ignored. The
    argument of ``stage`` is the time since the hand's start [s].
    """

    def __init__(self, settings: Settings, hand: SimulatedHand, clock: Clock, finger: int) -> None:
        simulation, tactile = hand.settings.simulation, hand.settings.tactile
        self._early = simulation.tactile_delay - settings.tactile.latency
        self._hand = hand
        self._clock = clock
        self._finger = finger
        self._period = 1.0 / tactile.rate
        self._arrivals = Arrivals(
            hand.start,
            self._period,
            simulation.tactile_delay,
            simulation.tactile_dropped,
            simulation.tactile_jitter,
            (simulation.seed, finger, 1),
        )
        self._model = make_sensor_model(hand.settings, finger)
        self._radius = hand.settings.tip.radius
        self._solid = hand.settings.tip.physics == "solid"
        self.stage: Callable[[float], StageTouch] | None = None
        self._relaxation = list(
            zip(simulation.tip_relaxation, simulation.tip_relaxation_times, strict=True)
        )
        # Lagged plate force of each Prony term [N].
        self._relaxation_state = [0.0] * len(self._relaxation)
        self._pressed = -1  # number of the newest sample that was applied to the cells
        self._frame: Frame | None = None
        self._faults = hand.measurement_faults[finger]
        self._given: deque[NDArray[np.uint16]] = deque(
            maxlen=math.ceil(REPLAY_TIME_MAX * tactile.rate)
        )
        self._replayed: Iterator[NDArray[np.uint16]] | None = None
        self._lost = 0
        self._open = False

    def open(self) -> None:
        """Wait for the first frame to arrive."""
        self._open = True
        self._clock.sleep_until(self.next_arrival)
        self.latest()

    def latest(self) -> Frame | None:
        """Return the newest frame, or None if no frame has arrived yet."""
        now = self._clock.now()
        if self._open and self._arrivals.take(now):
            self._hand.advance(now)
            self._read(self._arrivals.number, self._arrivals.arrival)
        return self._frame

    @property
    def next_arrival(self) -> float:
        """Arrival time of the next frame [s]."""
        return self._arrivals.next_arrival

    def counters(self) -> dict[str, int]:
        """Return the numbers of ``frames`` received and ``missed`` since `open` was called.

        ``resyncs`` and ``skipped_bytes`` are always 0.
        """
        missed = self._arrivals.missed + self._lost
        return {
            "frames": self._arrivals.number + 1 - missed,
            "missed": missed,
            "resyncs": 0,
            "skipped_bytes": 0,
        }

    def close(self) -> None:
        """Stop delivering frames."""
        self._open = False

    def _read(self, number: int, arrival: float) -> None:
        """Compute the newest frame from a sample that the plant still stores."""
        # If readings depend on earlier contacts, also apply the samples whose frames are not
        # computed.
        first = self._pressed + 1 if self._model.has_memory else number
        for each in range(first, number):
            self._press(each)
        if not self._press(number):
            self._lost += 1
            return
        self._pressed = number
        t = self._hand.start + number * self._period
        data = self._counts(t)
        self._given.append(data)
        self._frame = Frame(number + 1, t + self._early, arrival, valid=True, data=data)

    def _counts(self, t: float) -> NDArray[np.uint16]:
        """Return the readings at ``t`` [s] or, during a replay fault, the next replayed frame."""
        last = round(self._faults("replay", t) / self._period)
        if last == 0 or not self._given:
            self._replayed = None
            data: NDArray[np.uint16] = np.empty(self._model.grid.shape, dtype=np.uint16)
            self._model.read(data, self._faults, t)
            return data
        if self._replayed is None:
            self._replayed = itertools.cycle(list(self._given)[-last:])
        return next(self._replayed)

    def _relaxation_factor(self, d: float, theta: float) -> float:
        """Advance the relaxation under the plate by one frame; return the relaxation factor."""
        lasting = float(self._hand.table(d, theta).force)
        state, factor = self._relaxation_state, 1.0
        for k, (strength, time) in enumerate(self._relaxation):
            state[k] += (lasting - state[k]) * -math.expm1(-self._period / time)
            factor += strength * (1.0 - state[k] / lasting if lasting > 0.0 else 1.0)
        return max(factor, 0.0)

    def _press(self, number: int) -> bool:
        """Apply sample ``number`` to the cells; return False if the plant no longer stores it."""
        if self.stage is not None:
            touch = self.stage(number * self._period)
            factor = self._relaxation_factor(max(touch.d, 0.0), touch.theta)
            self._model.press(touch.d, touch.theta, 0.0, number * self._period, 0.0, factor)
            if touch.pressure > 0.0:
                self._model.press_evenly(touch.pressure)
            return True
        sample = self._hand.sample(number)
        if sample is None:
            return False
        finger = self._finger
        d, theta = float(sample.d[finger]), float(sample.theta[finger])
        factor, curvature = float(sample.gain[finger]), float(sample.curvature[finger])
        if abs(theta) >= 0.5 * math.pi:
            d = 0.0
        if self._solid:
            shear = float(sample.tangential[finger]) * (1.0 - d / self._radius)
            self._model.press(d, theta, 0.0, number * self._period, curvature, factor, shear)
            return True
        # Remove the effect of curvature, because the sensor model already includes this effect.
        factor *= math.sqrt(1.0 + curvature * self._radius)
        # The force is proportional to d², so scale d by the square root of the force ratio.
        relaxation_factor = float(sample.relaxation_factor[finger])
        d *= math.sqrt(factor / relaxation_factor)
        self._model.press(d, theta, 0.0, number * self._period, curvature, relaxation_factor)
        return True


class Arrivals:
    """Arrival times of a sensor's frames.

    Frame k is sampled at start + k · period and is due ``delay`` [s] later. A frame is lost with
    the probability ``dropped``. The additional delay of a frame is uniformly distributed between 0
    and ``jitter`` [s]. Frames always arrive in order.
    """

    # Tolerance for rounding errors of the clock [s], so that a frame due now counts as arrived.
    _SLACK = 1e-9

    def __init__(
        self,
        start: float,
        period: float,
        delay: float,
        dropped: float = 0.0,
        jitter: float = 0.0,
        seed: tuple[int, ...] = (0,),
    ) -> None:
        self._start = start
        self._period = period
        self._delay = delay
        self._dropped = dropped
        self._jitter = jitter
        self._random = np.random.default_rng(seed)
        self.number = -1  # number of the newest frame
        self.arrival = start  # arrival time of the newest frame [s]
        self.missed = 0  # number of frames lost before the newest frame
        self._next = -1
        self.next_arrival = start + delay  # arrival time of the next frame [s]
        self._plan()

    def take(self, now: float) -> bool:
        """Advance to ``now`` [s]; return True if a newer frame has arrived."""
        newest = self.number
        while self.next_arrival <= now + self._SLACK:
            self.missed += self._next - self.number - 1
            self.number = self._next
            self.arrival = self.next_arrival
            self._plan()
        return self.number > newest

    def _plan(self) -> None:
        """Find the next frame that is not lost, and set its arrival time."""
        self._next += 1
        while self._dropped > 0.0 and self._random.random() < self._dropped:
            self._next += 1
        due = self._start + self._next * self._period + self._delay
        if self._jitter > 0.0:
            due += self._jitter * self._random.random()
        self.next_arrival = max(due, self.arrival)
