"""Parses Tekscan-style ASCII exports: text in, pressure frames out.

Such a file starts with lines ``KEY value``, up to ``ASCII_DATA @@``. Then each frame is a line
``Frame n`` (more may stand behind it) and its rows, cells separated by commas, ``B`` where the
sensor has no cell; a line ``@@`` may end it. The export of a single frame has no ``Frame`` line.
Lengths come in mm, cm, m or in, abbreviated or spelt out, readings raw or in a unit of pressure.
Below ``COMMENTS:`` stands free text, in which only words in capitals are keys; a spreadsheet leaves
commas at the lines' ends.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import SoftfingerError

_MOST = 1024  # rows or cols
_HEADER_MOST = 1000  # lines
_LARGEST = 1e12  # of any reading, in its unit
_LENGTHS = {
    **dict.fromkeys(("", "mm", "millimeters", "millimetres", "millimeter", "millimetre"), 1e-3),
    **dict.fromkeys(("cm", "centimeters", "centimetres", "centimeter", "centimetre"), 1e-2),
    **dict.fromkeys(("m", "meters", "metres", "meter", "metre"), 1.0),
    **dict.fromkeys(("in", "inch", "inches"), 0.0254),
}
_RAW = ("raw", "rawsum", "counts", "")
_PRESSURES = {
    "pa": 1.0,
    "hpa": 1e2,
    "kpa": 1e3,
    "mpa": 1e6,
    "bar": 1e5,
    "mbar": 1e2,
    "psi": 6894.757293168,
    "mmhg": 133.322387415,
    "n/m2": 1.0,
    "n/cm2": 1e4,
    "n/mm2": 1e6,
    "g/cm2": 98.0665,
    "kg/cm2": 98066.5,
    "kgf/cm2": 98066.5,
}


class TekscanError(SoftfingerError, ValueError):
    """The text is no such export; the message names the line."""


@dataclass(frozen=True)
class Export:
    """A parsed export.

    ``values`` float64 [frames, rows, cols]: Pa, or counts where ``raw``; 0 where ``live`` [rows,
    cols] is False. ``t`` float64 [frames] from the first frame on [s]; ``pitch`` (x, y) [m], NaN
    where the header lacks it.
    """

    values: NDArray[np.float64]
    live: NDArray[np.bool_]
    t: NDArray[np.float64]
    raw: bool
    pitch: tuple[float, float]


def parse(text: str, seconds_per_frame: float = 0.01) -> Export:
    """Read an export; ``seconds_per_frame`` [s] where its header has none. Raises TekscanError."""
    lines = text.splitlines()
    header, first = _header(lines)
    rows, cols = _count(header, "ROWS"), _count(header, "COLS")
    numbers, frames = _frames(lines, first, rows, cols)
    values = np.array(frames)
    wrong = (values < 0.0) | (values > _LARGEST)
    if wrong.any():
        k, i, j = (int(x) for x in np.argwhere(wrong)[0])
        raise TekscanError(f"frame {numbers[k]}: row {i + 1}, cell {j + 1} is {values[k, i, j]}")
    live: NDArray[np.bool_] = np.logical_not(np.isnan(values).any(axis=0))
    values[:, ~live] = 0.0
    unit = re.sub(r"[\s^]", "", header.get("UNITS", "")).lower()
    if unit not in _RAW and unit not in _PRESSURES:
        raise TekscanError(f"UNITS: found {header['UNITS']!r}, expected RAW or a pressure's unit")
    step = seconds_per_frame
    if "SECONDS_PER_FRAME" in header:
        step = _quantity(header, "SECONDS_PER_FRAME", {"": 1.0, "s": 1.0, "ms": 1e-3})
    if not step > 0.0:
        raise TekscanError("SECONDS_PER_FRAME: expected a time above 0")
    t = (np.array(numbers, np.float64) - numbers[0]) * step
    raw = unit in _RAW
    if not raw:
        values *= _PRESSURES[unit]
    return Export(values, live, t, raw, _pitch(header))


def _header(lines: list[str]) -> tuple[dict[str, str], int]:
    header: dict[str, str] = {}
    in_comments = False
    for number, line in enumerate(lines[:_HEADER_MOST]):
        key, _, value = line.strip().rstrip(",").partition(" ")
        if key.upper() == "ASCII_DATA":
            return header, number + 1
        if key and (key.isupper() or not in_comments):
            header[key.upper()] = value.strip()
            in_comments |= key.upper().startswith("COMMENT")
    raise TekscanError("no line ASCII_DATA: this is no Tekscan-style export")


def _frames(
    lines: list[str], first: int, rows: int, cols: int
) -> tuple[list[int], list[list[NDArray[np.float64]]]]:
    """Numbers of the frames and their rows, from line ``first`` on."""
    numbers: list[int] = []
    frames: list[list[NDArray[np.float64]]] = []
    for number, text in enumerate(lines[first:], first + 1):
        line = text.strip()
        if not line:
            continue
        if line.startswith("@@"):
            break
        if line[:5].lower() == "frame":
            match = re.match(r"frame\s+(\d{1,9})\b", line, re.IGNORECASE)
            if match is None:
                raise TekscanError(f"line {number}: found {line[:40]!r}, expected Frame n")
            if frames and len(frames[-1]) < rows:
                had = f"{len(frames[-1])} rows of {rows}"
                raise TekscanError(f"line {number}: frame {numbers[-1]} has {had}")
            if numbers and int(match[1]) <= numbers[-1]:
                raise TekscanError(f"line {number}: frame {match[1]} after frame {numbers[-1]}")
            numbers.append(int(match[1]))
            frames.append([])
            continue
        if not frames:  # the export of a single frame
            numbers.append(1)
            frames.append([])
        if len(frames[-1]) == rows:
            raise TekscanError(f"line {number}: found {line[:40]!r}, expected Frame n")
        frames[-1].append(_row(line, cols, number))
    if not frames:
        raise TekscanError("no frame in it")
    if len(frames[-1]) < rows:
        raise TekscanError(
            f"the file ends in frame {numbers[-1]}: {len(frames[-1])} rows of {rows}"
        )
    return numbers, frames


def _row(line: str, cols: int, number: int) -> NDArray[np.float64]:
    cells = [cell.strip().upper() for cell in line.rstrip(",").split(",", _MOST)]
    if len(cells) != cols:
        raise TekscanError(f"line {number}: {len(cells)} cells, expected {cols}")
    try:
        values = np.array([math.nan if cell == "B" else float(cell) for cell in cells])
    except ValueError as error:
        raise TekscanError(f"line {number}: {error}") from None
    if np.count_nonzero(np.isnan(values)) != cells.count("B"):
        raise TekscanError(f"line {number}: a cell that is no number")
    return values


def _count(header: dict[str, str], key: str) -> int:
    if key not in header:
        raise TekscanError(f"{key} is missing")
    text = header[key]
    if not re.fullmatch(r"[0-9]{1,4}", text) or not 1 <= int(text) <= _MOST:
        raise TekscanError(f"{key}: found {text!r}, expected 1 to {_MOST}")
    return int(text)


def _quantity(header: dict[str, str], key: str, units: dict[str, float]) -> float:
    """A number with its unit, in SI."""
    match = re.fullmatch(r"([-+0-9.eE]+)\s*([A-Za-z]*)", header[key])
    try:
        value = float(match[1]) if match else math.nan
    except ValueError:
        value = math.nan
    unit = match[2].lower() if match else ""
    if not math.isfinite(value) or unit not in units:
        known = ", ".join(name for name in units if 0 < len(name) <= 4)
        raise TekscanError(f"{key}: found {header[key]!r}, expected a number in one of {known}")
    return value * units[unit]


def _pitch(header: dict[str, str]) -> tuple[float, float]:
    """(x, y) from the spacings."""
    found = []
    for key in ("COL_SPACING", "ROW_SPACING"):
        value = _quantity(header, key, _LENGTHS) if key in header else math.nan
        if value <= 0.0:
            raise TekscanError(f"{key}: expected a length above 0")
        found.append(value)
    return found[0], found[1]
