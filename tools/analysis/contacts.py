"""d, θ, force and energy of recorded frames, by the daemon's own perception."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.own_files import write_text
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import FINGERS, Frame, State
from softfinger.tools import style
from softfinger.tools.analysis.sources import Progress, Source

FloatArray = NDArray[np.float64]

# The contact's fields and their units; the CSV's header says name_unit.
COLUMNS = (
    ("d", "m"),
    ("d_std", "m"),
    ("theta", "rad"),
    ("theta_std", "rad"),
    ("tilt_y", "rad"),
    ("force", "N"),
    ("energy", "J"),
    ("gain", ""),
)


@dataclass(frozen=True)
class Contacts:
    """One sensor's contacts, a row a frame. ``values`` by the names in COLUMNS, SI units."""

    finger: str
    t: FloatArray
    valid: NDArray[np.bool_]
    contact: NDArray[np.bool_]
    values: dict[str, FloatArray]
    truths: dict[str, FloatArray]


class _Pass:
    """One sensor's perception and its rows."""

    def __init__(self, source: Source, finger: int) -> None:
        self._sensor = GivenFrames(source.live)
        self._perception = Perception(source.settings, {finger: self._sensor}, source.models)
        self._state = State()
        self._contact = self._state.contacts[finger]
        self._rows: list[tuple[float, ...]] = []

    def take(self, t: float, counts: NDArray[np.uint16]) -> None:
        self._sensor.frame = Frame(len(self._rows) + 1, t, t, True, counts)
        self._state.t = t
        self._perception.update(self._state)
        contact = self._contact
        values = [getattr(contact, name) for name, _ in COLUMNS]
        self._rows.append((t, contact.valid, contact.contact, *values))

    def contacts(self, finger: int, truths: dict[str, FloatArray]) -> Contacts:
        table = np.array(self._rows, np.float64).reshape(-1, 3 + len(COLUMNS)).T
        values = {name: table[3 + k] for k, (name, _) in enumerate(COLUMNS)}
        return Contacts(FINGERS[finger], table[0], table[1] > 0.0, table[2] > 0.0, values, truths)


def analyse(source: Source, progress: Progress) -> list[Contacts]:
    """The contacts of each sensor. Raises what the source's frames raise."""
    passes = {finger: _Pass(source, finger) for finger in source.fingers}
    for finger, t, counts in source.frames(progress):
        passes[finger].take(t, counts)
    return [each.contacts(finger, source.truths) for finger, each in passes.items()]


def write_csv(path: Path, contacts: list[Contacts]) -> None:
    """One line a frame, sensors one after the other; names with units. Raises OSError."""
    names = [f"{name}_{unit}" if unit else name for name, unit in COLUMNS]
    truths = sorted({name for each in contacts for name in each.truths})
    units = dict(COLUMNS)
    with write_text(path, newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        known = [f"{name}_true_{units[name]}" for name in truths]
        writer.writerow(["t_s", "finger", "valid", "contact", *names, *known])
        for each in contacts:
            columns = [each.values[name] for name, _ in COLUMNS]
            columns += [each.truths[name] for name in truths]
            numbers = zip(*(column.tolist() for column in columns), strict=True)
            for t, valid, touches, row in zip(
                each.t.tolist(), each.valid.tolist(), each.contact.tolist(), numbers, strict=True
            ):
                writer.writerow([f"{t:.6f}", each.finger, int(valid), int(touches), *row])


# Title, value, its standard deviation, factor to what is shown, unit shown.
_PANELS = (
    ("displacement d", "d", "d_std", 1e3, "mm"),
    ("object's angle θ", "theta", "theta_std", 180.0 / np.pi, "°"),
    ("force F", "force", "", 1.0, "N"),
    ("energy U", "energy", "", 1e3, "mJ"),
)


def draw(contacts: list[Contacts], title: str, path: Path) -> None:
    """d and θ with two standard deviations, F and U over time. Raises MissingExtra."""
    with style.settings():
        figure = style.new_figure(7.0, 7.5)
        axes = figure.subplots(len(_PANELS), 1, sharex=True)
        for panel, (name, value, spread, factor, unit) in zip(axes, _PANELS, strict=True):
            for k, each in enumerate(contacts):
                sound = each.valid & each.contact
                shown = np.where(sound, each.values[value] * factor, np.nan)
                colour = style.KINDS[k]
                line = "-" if k == 0 else (0, (5, 1.5))
                panel.plot(each.t, shown, color=colour, linestyle=line, label=each.finger)
                if spread:
                    band = 2.0 * factor * each.values[spread]
                    panel.fill_between(
                        each.t, shown - band, shown + band, color=colour, alpha=0.25, lw=0
                    )
                if value in each.truths:
                    panel.plot(
                        each.t,
                        each.truths[value] * factor,
                        color=style.INK,
                        linestyle=":",
                        label=f"{each.finger}, known",
                    )
            panel.set_ylabel(f"{name} [{unit}]")
        axes[0].set_title(title, loc="left")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=4)
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(
            0.0, max([float(each.t.max()) for each in contacts if each.t.size] or [1])
        )
        style.save(figure, path)
