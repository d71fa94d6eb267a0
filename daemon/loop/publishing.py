"""Decide which topics to publish on each tick, and measure the actual rates.

Each topic is published on every n-th tick, counted by ``seq``. The divisor n is chosen so that the
rate is closest to the requested rate. If possible, statistics are published a few ticks after the
state to distribute the load. Tactile frames are decimated in the same way. `wire.publisher` sends
the messages; this module does not change the state.
"""

from __future__ import annotations

import math

from softfinger.daemon.loop.timing import Statistics
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame, SceneParts, State, Truth
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import Publisher, bit
from softfinger.daemon.wire.schema import Rates

_STATE, _TACTILE, _STATS, _INPUT, _TRUTH = map(
    bit, (schema.STATE, schema.TACTILE, schema.STATS, schema.INPUT, schema.TRUTH)
)
_STATS_RATE = 1.0  # Hz
_STATS_PHASE = 3  # ticks from a state to the statistics, so that no tick publishes both


def every(rate: float, wanted: float) -> int:
    """Return the decimation factor n for which rate/n is closest to ``wanted``."""
    return max(round(rate / wanted), 1)


def parts(settings: Settings) -> SceneParts:
    """List the components of the configured scene."""
    return SceneParts(
        fingers=("left" in settings.scene.fingers, "right" in settings.scene.fingers),
        has_servos=settings.servos.backend != "none",
        has_sensors=settings.tactile.backend != "none",
    )


class Publishing:
    """Publisher of the topics that are due on a tick and have subscribers."""

    def __init__(
        self,
        settings: Settings,
        publisher: Publisher,
        perceptions: list[FingerPerception],
        statistics: Statistics,
        truth: Truth | None = None,
    ) -> None:
        """Create the publisher; ``truth`` is the true state of a simulated hand."""
        self._publisher = publisher
        self._perceptions = perceptions
        self._statistics = statistics
        self._truth = truth
        rate, stream = settings.loop.rate, settings.stream
        self._period = 1.0 / rate
        self._state_every = every(rate, stream.state_rate)
        self._stats_every = every(rate, _STATS_RATE)
        self._stats_phase = _STATS_PHASE % self._stats_every
        self._frames_every = every(settings.tactile.rate, stream.tactile_rate)
        self._scene = parts(settings)
        self._numbers = [0, 0]  # number of published frames per finger
        self._published = [-1, -1]  # `Frame.seq` // n of the last published frame, per finger
        self._states = 0  # number of published states
        # Time [s] and counts when the rates were last calculated.
        self._counted: tuple[float, ...] = (math.nan,) * 6

    def __call__(self, state: State) -> None:
        """Publish everything that is due on this tick."""
        publisher, seq = self._publisher, state.seq
        wanted = publisher.wanted
        if wanted & _TACTILE:
            for perception in self._perceptions:
                self._frame(state, perception)
        if wanted & _INPUT:  # Publish inputs after the frames that they refer to.
            frames: list[Frame | None] = [None, None]
            for perception in self._perceptions:
                frames[perception.finger] = perception.frame
            publisher.send(schema.INPUT, state, frames)
        if seq % self._state_every == 0:
            if wanted & _STATE:
                self._states += 1
                publisher.send(schema.STATE, state, self._scene, self._state_every)
            if wanted & _TRUTH and self._truth is not None:
                publisher.send(schema.TRUTH, state, self._truth, self._state_every)
        if seq % self._stats_every == self._stats_phase:
            rates = self._rates(state)
            if wanted & _STATS:
                statistics = self._statistics
                told = state, self._period, rates, statistics.ticks, statistics.spreads()
                publisher.send(schema.STATS, *told, self._stats_every)

    def _frame(self, state: State, perception: FingerPerception) -> None:
        frame, n = perception.frame, self._frames_every
        if frame is None or frame.seq // n == self._published[perception.finger]:
            return
        self._published[perception.finger] = frame.seq // n
        self._numbers[perception.finger] += 1
        wall = state.wall - (state.t - frame.t_sample)
        data = perception.published()
        number = self._numbers[perception.finger]
        sensor = perception.finger, perception.info
        self._publisher.send(schema.TACTILE, frame, data, *sensor, wall, n, number)

    def _rates(self, state: State) -> Rates:
        """Return the message rates [Hz] since the previous call, measured in machine time.

        The first call returns NaN.
        """
        frames = [0, 0]
        for perception in self._perceptions:
            frames[perception.finger] = perception.frame_count
        t = state.t + state.timing.behind_s
        counted = t, state.seq, *frames, self._states, sum(self._numbers)
        last, self._counted = self._counted, counted
        dt, *counts = (now - before for now, before in zip(self._counted, last, strict=True))
        return Rates(*(count / dt for count in counts))
