"""How accurate the estimator is over its whole envelope: a campaign of ten minutes.

Errors against the Cramér-Rao bound, honesty of the covariance, dead cells, 8-bit counts, faint
contacts, false alarms, frames of other contact models and of imperfect sensors. The parts are
accuracy_*.py; here are their sizes and their tables.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from softfinger.tools.benchmarks import accuracy_envelope, accuracy_trials
from softfinger.tools.benchmarks.accuracy_detection import (
    AlarmRow,
    DetectionRow,
    detection,
    false_alarms,
)
from softfinger.tools.benchmarks.accuracy_envelope import BiasRow, EnvelopeRow
from softfinger.tools.benchmarks.accuracy_flaws import FlawRow, flaws
from softfinger.tools.benchmarks.accuracy_mismatch import MismatchRow, mismatches
from softfinger.tools.benchmarks.estimator_bounds import MODULUS


@dataclass(frozen=True)
class Effort:
    """How much is measured; the default is the full campaign."""

    envelope: accuracy_envelope.Effort = field(default_factory=accuracy_envelope.Effort)
    faint_around: int = 16
    faint_frames: int = 5000  # of each contact
    faint_again: int = 100_000
    noise_frames: int = 3_000_000  # of noise alone, on each board
    samples: int = 20_000  # of importance sampling, at each level
    other_frames: int = 500
    other_noises: tuple[float, ...] = accuracy_trials.noises()
    flaw_frames: int = 200


def measure(effort: Effort | None = None) -> list[Any]:
    """Rows of all parts."""
    effort = effort or Effort()
    return [
        *accuracy_envelope.against_the_bound(effort.envelope),
        *accuracy_envelope.of_eight_bits(effort.envelope),
        *detection(effort.faint_around, effort.faint_frames, effort.faint_again),
        *false_alarms(effort.noise_frames, effort.samples),
        *mismatches(effort.other_frames, effort.other_noises),
        *flaws(effort.flaw_frames),
    ]


def table(rows: list[Any]) -> str:
    """All rows as aligned tables."""
    parts = [
        _envelope(_of(EnvelopeRow, rows)),
        _bias(_of(BiasRow, rows)),
        _detection(_of(DetectionRow, rows)),
        _alarms(_of(AlarmRow, rows)),
        _mismatch(_of(MismatchRow, rows)),
        _flaws(_of(FlawRow, rows)),
    ]
    return "\n\n".join("\n".join(lines) for lines in parts)


def _of(kind: type, rows: list[Any]) -> list[Any]:
    return [row for row in rows if isinstance(row, kind)]


def _envelope(rows: Iterable[EnvelopeRow]) -> list[str]:
    lines = [
        f"{'RMS error over the Cramér-Rao bound':46}{'cases':>6}{'frames':>10}{'d median':>10}"
        f"{'worst':>7}{'tilt median':>13}{'worst':>7}{'aim':>8}{'lost':>9}"
    ]
    for row in rows:
        lines.append(
            f"{row.name:46}{row.cases:6d}{row.frames:10d}{row.d_median:10.3f}{row.d_worst:7.3f}"
            f"{row.tilt_median:13.3f}{row.tilt_worst:7.3f}{f'≤ {row.aim:.2f}':>8}{row.lost:9d}"
        )
    lines += [
        "",
        f"{'errorᵀ Σ⁻¹ error a degree of freedom':46}{'cases':>6}{'mean':>10}{'least':>8}"
        f"{'most':>8}{'in the 99 % band':>18}{'seldom seen':>13}{'misfits':>9}",
    ]
    for row in rows:
        lines.append(
            f"{row.name:46}{row.cases - row.seldom:6d}{row.nees:10.3f}{row.nees_least:8.3f}"
            f"{row.nees_most:8.3f}{100 * row.nees_in_band:16.1f} %{row.seldom:13d}{row.misfits:9d}"
        )
    lines += ["", "worst contacts"]
    for row in rows:
        lines.append(f"{row.name:46}d: {row.d_where}; tilt: {row.tilt_where}")
    return lines


def _bias(rows: Iterable[BiasRow]) -> list[str]:
    lines = [
        f"{'bias of d over d, %':67}{'cases':>6}{'RMS':>8}{'worst':>8}{'±':>7}{'worst (d, θ)':>14}"
        f"{'aim':>6}{'lost':>6}{'misfits':>9}"
    ]
    for row in rows:
        lines.append(
            f"{row.name:67}{row.cases:6d}{row.rms:8.3f}{row.worst:8.3f}{row.deviation:7.3f}"
            f"{row.mean_worst:14.3f}{f'≤ {row.aim:g}':>6}{row.lost:6d}"
            f"{row.misfits:9d}"
        )
        lines.append(f"    worst: {row.where}")
    return lines


def _detection(rows: Iterable[DetectionRow]) -> list[str]:
    lines = [f"{'seen':50}{'frames':>9}{'share':>10}{'worst contact':>15}{'frames':>9}{'aim':>10}"]
    for row in rows:
        lines.append(
            f"{row.name:50}{row.frames:9d}{row.seen:10.5f}{row.worst:15.5f}{row.worst_frames:9d}"
            f"{f'≥ {row.aim:g}':>10}"
        )
    return lines


def _alarms(rows: Iterable[AlarmRow]) -> list[str]:
    lines = [
        f"{'alarms a frame':45}{'noise Pa':>9}{'level':>7}{'computed':>10}{'exact':>10}"
        f"{'sampled':>10}{'95 % below':>12}{'frames':>9}{'aim':>10}"
    ]
    for row in rows:
        aim = f"≤ {row.aim:.0e}" if row.default else ""
        lines.append(
            f"{row.name:45}{row.noise:9.0f}{row.patch_level:7.1f}{_rate(row.expected):>10}"
            f"{_rate(row.importance):>10}{_rate(row.sampled):>10}{_rate(row.upper):>12}"
            f"{row.frames or '':>9}{aim:>10}"
        )
    return lines


def _mismatch(rows: Iterable[MismatchRow]) -> list[str]:
    lines = [
        f"{'estimated as linear':20}{'d mm':>6}{'θ °':>6}{'noise %':>9}{'d off mm':>10}{'±':>8}"
        f"{'θ off °':>9}{'χ²':>10}{'flagged':>9}{'not valid':>11}"
    ]
    for row in rows:
        lines.append(
            f"{row.name:20}{row.d * 1e3:6.1f}{math.degrees(row.theta):6.1f}"
            f"{100 * row.noise / MODULUS:9.1f}{row.d_error * 1e3:10.3f}{row.told * 1e3:8.3f}"
            f"{math.degrees(row.theta_error):9.2f}{row.chi2:10.2f}{100 * row.misfits:7.0f} %"
            f"{100 * row.invalid:9.0f} %"
        )
    return lines


def _flaws(rows: Iterable[FlawRow]) -> list[str]:
    lines = [
        f"{'a sensor with':28}{'d mm':>6}{'θ °':>6}{'gain':>7}{'d off mm':>10}{'±':>8}"
        f"{'θ off °':>9}{'gain':>8}{'flagged':>9}{'not valid':>11}"
    ]
    for row in rows:
        lines.append(
            f"{row.name:28}{row.d * 1e3:6.1f}{math.degrees(row.theta):6.1f}"
            f"{'free' if row.free else 'known':>7}{row.d_error * 1e3:10.3f}{row.told * 1e3:8.3f}"
            f"{math.degrees(row.theta_error):9.2f}{row.gain:8.3f}{100 * row.misfits:7.0f} %"
            f"{100 * row.invalid:9.0f} %"
        )
    return lines


def _rate(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2e}"
