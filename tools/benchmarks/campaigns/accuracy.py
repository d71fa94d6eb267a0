"""How accurate the estimator is over its whole envelope: a campaign of ten minutes.

Errors against the Cramér-Rao bound, honesty of the covariance, dead cells, 8-bit counts, faint
contacts, false alarms, frames of other contact models and of imperfect sensors.
"""

from __future__ import annotations

from collections.abc import Callable

from softfinger.tools.benchmarks.campaigns.accuracy_detection import detection, false_alarms
from softfinger.tools.benchmarks.campaigns.accuracy_envelope import (
    Sweep,
    against_the_bound,
    of_eight_bits,
)
from softfinger.tools.benchmarks.campaigns.accuracy_models import flaws, mismatches
from softfinger.tools.benchmarks.framework.report import Report

_FRAMES = 2000  # of each contact


def _sweep(frames: int) -> Sweep:
    return Sweep(around=16, frames=frames, again=12, again_frames=20 * frames)


# Each part by the frames of a contact.
PARTS: dict[str, Callable[[int], list[Report]]] = {
    "bound": lambda n: against_the_bound(_sweep(n)),
    "eight bits": lambda n: of_eight_bits(_sweep(n)),
    "faint contacts": lambda n: detection(16, 5 * n // 2, 50 * n),
    "false alarms": lambda n: false_alarms(1500 * n),
    "other models": lambda n: mismatches(max(n // 4, 1)),
    "imperfect sensors": lambda n: flaws(max(n // 10, 1)),
}


def measure(trials: int | None = None, only: str = "") -> list[Report]:
    """The parts whose name ``only`` is found in, with ``trials`` frames of each contact."""
    chosen = [part for name, part in PARTS.items() if only in name]
    return [table for part in chosen for table in part(trials or _FRAMES)]


def known(only: str) -> bool:
    """Whether this is found in any part's name."""
    return any(only in name for name in PARTS)
