"""What a measurement returns, and the statistics that all of them share."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Row:
    """One measured quantity: its median and tail in ``unit``, from ``count`` samples."""

    name: str
    unit: str
    median: float
    p99: float
    count: int
    aim: float | None = None  # for the median, where there is one

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


def row(name: str, unit: str, samples: ArrayLike, aim: float | None = None) -> Row:
    """Summarise samples that are already in ``unit``."""
    values = np.asarray(samples, dtype=np.float64)
    median, p99 = np.percentile(values, [50.0, 99.0])
    return Row(name, unit, float(median), float(p99), len(values), aim)


def table(rows: list[Row]) -> str:
    """The rows as an aligned table."""
    width = max([58, *(len(each.name) for each in rows)])
    lines = [f"{'':{width}} {'median':>9} {'p99':>9} {'unit':>4} {'aim':>7} {'n':>7}"]
    for each in rows:
        aim = "" if each.aim is None else f"≤ {each.aim:g}"
        lines.append(
            f"{each.name:{width}} {_number(each.median)} {_number(each.p99)} {each.unit:>4} "
            f"{aim:>7} {each.count:7d}"
        )
    return "\n".join(lines)


def _number(value: float) -> str:
    """Three decimals, or an exponent where these would hide it."""
    return f"{value:9.3f}" if value == 0.0 or abs(value) >= 0.01 else f"{value:9.1e}"
