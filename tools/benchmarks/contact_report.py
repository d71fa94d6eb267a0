"""Rows of `bench contact` and their table."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

# How a representation is called, with the heading of its column.
MODES = {
    "loop": "in a loop",
    "chain": "chained",
    "kernel": "from Python",
    "python": "Python, API",
    "batch": "batch",
}


@dataclass(frozen=True)
class Timing:
    """Nanoseconds a call or, in a batch, a point; its ratio is the rounds' median."""

    min_ns: float
    median_ns: float
    over_closed: float  # to the closed form with as many outputs, called the same way


@dataclass(frozen=True)
class ContactRow:
    """One representation of the contact model: what it costs and how wrong it is."""

    name: str
    material: str
    outputs: int  # 2: force and energy; 6: with their first partials
    max_error: float  # largest relative error of these outputs over the bench's points
    certificate: float | None  # the table's own, over its whole domain and all six outputs
    nbytes: int | None
    build_s: float | None
    timings: dict[str, Timing]  # by mode

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self)


def aligned_table(rows: list[ContactRow]) -> str:
    """The rows by material: error, memory, build, and ns with the ratio to the closed form."""
    lines = []
    for material in dict.fromkeys(each.material for each in rows):
        lines.append(f"contact model, material: {material}")
        heads = "".join(f"{head:>15}" for head in MODES.values())
        lines.append(
            f"{'ns a call (× the closed form)':48} out {'error':>8}{'KiB':>5}{'build ms':>9}{heads}"
        )
        for each in rows:
            if each.material != material:
                continue
            memory = "" if each.nbytes is None else f"{each.nbytes / 1024:.0f}"
            build = "" if each.build_s is None else f"{each.build_s * 1e3:.0f}"
            cells = "".join(f"{_cell(each.timings.get(mode)):>15}" for mode in MODES)
            lines.append(
                f"{each.name:48} {each.outputs:3} {each.max_error:8.1e}{memory:>5}{build:>9}{cells}"
            )
        lines.append("")
    lines += [
        "in a loop: calls of a compiled loop, which overlap; chained: each waits for the last;",
        "from Python: the kernel called with floats; Python, API: the function or object that a",
        "notebook would call; batch: all points in one call, ns a point. Medians of the rounds.",
    ]
    return "\n".join(lines)


def _cell(timing: Timing | None) -> str:
    if timing is None:
        return "–"
    return f"{_digits(timing.median_ns)} ({_digits(timing.over_closed)})"


def _digits(value: float) -> str:
    if value >= 1e5:
        return f"{value:.1e}".replace("e+0", "e")
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
