"""What the loop does how often, as one table: every tick, and every n-th.

The servo tick is the base. What is rarer is done on exactly every n-th tick, counted by ``seq``,
with the n whose rate is nearest to the wanted one, and on ticks of its own where n allows it, so
that no tick carries all of it. Tactile frames have their sensor's rate: every tick looks whether
there is a new one, only a new one is estimated, and of every n one is published.
"""

from __future__ import annotations

from typing import NamedTuple

from softfinger.daemon.profile.settings import Settings

_STATS = 1.0  # Hz of the loop's own statistics


class Turn(NamedTuple):
    """Something that is done on the ticks whose ``seq`` is ``phase`` modulo ``every``."""

    what: str
    every: int
    phase: int

    def due(self, seq: int) -> bool:
        """Whether tick ``seq`` is one of them."""
        return seq % self.every == self.phase


class Schedule:
    """The loop's turns."""

    def __init__(self, settings: Settings) -> None:
        self.rate = settings.loop.rate
        self._frames = settings.tactile.rate if settings.tactile.backend != "none" else 0.0
        stream = settings.stream
        self.tactile_every = max(round(settings.tactile.rate / stream.tactile_rate), 1)  # frames
        #                         what          wanted rate [Hz]     phase
        self.state = self._turn("hand/state", stream.state_rate, 0)
        self.stats = self._turn("hand/stats", _STATS, 3)

    def _turn(self, what: str, wanted: float, phase: int) -> Turn:
        every = max(round(self.rate / wanted), 1)
        return Turn(what, every, phase % every)

    def turns(self) -> tuple[Turn, ...]:
        """All of them, from frequent to rare."""
        turns = (self.state, self.stats)
        return tuple(sorted(turns, key=lambda turn: turn.every))

    def __str__(self) -> str:
        """One line for people."""
        parts = [f"every tick ({self.rate:g} Hz) read, feel, decide, bound, write"]
        if self._frames:
            parts[0] += f", tactile frames as they come ({self._frames:g} Hz)"
            rate = self._frames / self.tactile_every
            frames = "frame" if self.tactile_every == 1 else f"{self.tactile_every} frames"
            parts.append(f"every {frames} hand/tactile ({rate:.4g} Hz)")
        parts += [
            f"every {f'{turn.every} ticks' if turn.every > 1 else 'tick'} {turn.what} "
            f"({self.rate / turn.every:.4g} Hz)"
            for turn in self.turns()
        ]
        return "; ".join(parts)
