"""One pass over recorded frames: d, θ, force and energy at each, by the daemon's own perception."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.own_files import write_text
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import FINGERS, Frame, State
from softfinger.tools.analysis.sources import Progress, Source

FloatArray = NDArray[np.float64]

# Name, unit and the contact's attribute of each column; the CSV's header says name_unit.
COLUMNS = (
    ("d", "m", "d"),
    ("d_std", "m", "d_std"),
    ("theta", "rad", "theta"),
    ("theta_std", "rad", "theta_std"),
    ("tilt_y", "rad", "tilt_y"),
    ("force", "N", "force"),
    ("energy", "J", "energy"),
    ("gain", "", "gain"),
)


@dataclass(frozen=True)
class Contacts:
    """One sensor's contacts: a row a frame. ``values`` by the names in COLUMNS, SI units."""

    finger: str
    t: FloatArray
    valid: NDArray[np.bool_]
    contact: NDArray[np.bool_]
    values: dict[str, FloatArray]
    truths: dict[str, FloatArray]


class _Pass:
    """One sensor's perception and the rows it has given."""

    def __init__(self, source: Source, finger: int) -> None:
        self._sensor = GivenFrames(source.live)
        self._perception = Perception(source.settings, {finger: self._sensor}, source.models)
        self._state = State()
        self._contact = self._state.contacts[finger]
        self._rows: list[tuple[float, ...]] = []
        shape = source.settings.tactile
        self._shape = (shape.rows, shape.cols)

    def take(self, t: float, counts: NDArray[np.uint16]) -> None:
        if counts.shape != self._shape:
            raise RecordingError(
                f"a frame of {counts.shape[0]} × {counts.shape[1]} cells, expected "
                f"{self._shape[0]} × {self._shape[1]}"
            )
        self._sensor.frame = Frame(len(self._rows) + 1, t, t, True, counts)
        self._state.t = t
        self._perception.update(self._state)
        c = self._contact
        self._rows.append(
            (
                t,
                c.valid,
                c.contact,
                c.d,
                c.d_std,
                c.theta,
                c.theta_std,
                c.tilt_y,
                c.force,
                c.energy,
                c.gain,
            )
        )

    def contacts(self, finger: int, truths: dict[str, FloatArray]) -> Contacts:
        table = np.array(self._rows, np.float64).reshape(-1, 3 + len(COLUMNS)).T
        values = {name: table[3 + k] for k, (name, _, _) in enumerate(COLUMNS)}
        return Contacts(FINGERS[finger], table[0], table[1] > 0.0, table[2] > 0.0, values, truths)


def analyse(source: Source, progress: Progress) -> list[Contacts]:
    """The contacts of each sensor. Raises RecordingError for a frame that doesn't fit."""
    passes = {finger: _Pass(source, finger) for finger in source.fingers}
    for finger, t, counts in source.frames(progress):
        passes[finger].take(t, counts)
    return [each.contacts(finger, source.truths) for finger, each in passes.items()]


def write_csv(path: Path, contacts: list[Contacts]) -> None:
    """One line a frame, sensors one after the other; names with units. Raises OSError."""
    names = [f"{name}_{unit}" if unit else name for name, unit, _ in COLUMNS]
    truths = sorted({name for each in contacts for name in each.truths})
    units = {"d": "m", "theta": "rad", "force": "N"}
    with write_text(path, newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        known = [f"{name}_true_{units[name]}" for name in truths]
        writer.writerow(["t_s", "finger", "valid", "contact", *names, *known])
        for each in contacts:
            columns = [each.values[name] for name, _, _ in COLUMNS]
            columns += [each.truths[name] for name in truths]
            numbers = zip(*(column.tolist() for column in columns), strict=True)
            for t, valid, touches, row in zip(
                each.t.tolist(), each.valid.tolist(), each.contact.tolist(), numbers, strict=True
            ):
                writer.writerow([f"{t:.6f}", each.finger, int(valid), int(touches), *row])
