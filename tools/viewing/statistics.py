"""``hand/stats`` as a page of Markdown."""

from __future__ import annotations

import math
from typing import Any

from softfinger.tools.terminal.feed import number

_ROWS = {
    "wake": "wake-up late",
    "compute": "work",
    "bus": "of it: bus",
    "publish": "of it: publish",
}
_COLUMNS = ("p50", "p99", "p999", "max")
_RATES = ("tick", "left", "right", "state", "tactile")


def table(message: dict[str, Any]) -> str:
    """Times since the daemon's start in µs, rates over the last second in Hz."""
    ticks, overruns = number(message, "ticks"), number(message, "overruns")
    period = 1e3 * number(message, "period_s")
    lines = [
        f"**{_shown(ticks)} ticks** of {_shown(period, 3)} ms, **{_shown(overruns)} overruns**",
        "",
        "| µs | median | 99 % | 99.9 % | longest |",
        "|---|---:|---:|---:|---:|",
    ]
    for key, name in _ROWS.items():
        values = [_shown(1e6 * number(message, key, column), 1) for column in _COLUMNS]
        lines.append(f"| {name} | {' | '.join(values)} |")
    rates = [f"{name} {_shown(number(message, 'rates', name), 1)}" for name in _RATES]
    return "\n".join([*lines, "", f"Hz: {' · '.join(rates)}"])


def _shown(value: float, decimals: int = 0) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else "—"
