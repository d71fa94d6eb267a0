"""Parse Tekscan-style ASCII exports of pressure frames.

An export starts with a header, which consists of ``KEY value`` lines and ends with the line
``ASCII_DATA @@``. Each frame consists of a line that starts with ``Frame n``, and of the rows of
the frame. The letter ``B`` marks a position without a cell. A line ``@@`` may end the file. An
export with a single frame has no ``Frame`` line.

The parser detects the encoding, the decimal separator and the cell separator, which depend on the
locale of the exporting machine. Lengths are in mm, cm, m or inches. The unit names are abbreviated
or spelt out. Readings are raw counts, pressures, or forces per cell. Free text may follow
``COMMENTS:``. After ``COMMENTS:``, a line is a ``KEY value`` line only if its first word is in
capitals. Spreadsheets may add quotation marks and may append separators to lines.
"""

from __future__ import annotations

import codecs
import csv
import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.errors import SoftfingerError

_SIZE_MAX = 1024  # maximum number of rows or columns
_HEADER_LINES_MAX = 1000
_NUMBER_MAX = 1e12
_RAW_SATURATION = 255  # maximum reading of the manufacturer's 8-bit electronics
_SATURATION_FRACTION = 0.995  # fraction of the saturation pressure above which a cell is saturated
_EDGE_CHARACTERS = ' \t,;"'  # characters that spreadsheets add at line ends
_LENGTHS = {
    **dict.fromkeys(("", "mm", "millimeters", "millimetres", "millimeter", "millimetre"), 1e-3),
    **dict.fromkeys(("cm", "centimeters", "centimetres", "centimeter", "centimetre"), 1e-2),
    **dict.fromkeys(("m", "meters", "metres", "meter", "metre"), 1.0),
    **dict.fromkeys(("in", "inch", "inches"), 0.0254),
}
_TIMES = {**dict.fromkeys(("", "s", "sec", "seconds"), 1.0), "ms": 1e-3, "msec": 1e-3}
_RAW = ("raw", "rawsum", "rawdata", "counts", "count", "")
_FORCES = {
    **{"n": 1.0, "mn": 1e-3, "kn": 1e3, "dyn": 1e-5},
    **dict.fromkeys(("g", "gf", "gram", "grams", "p"), 9.80665e-3),
    **dict.fromkeys(("kg", "kgf", "kp"), 9.80665),
    **dict.fromkeys(("lb", "lbs", "lbf", "pounds"), 4.4482216152605),
    **dict.fromkeys(("oz", "ozf"), 0.27801385095),
}
_AREAS = {"m2": 1.0, "cm2": 1e-4, "mm2": 1e-6, "in2": 0.0254**2, "ft2": 0.3048**2}
_PRESSURES = {
    **{"pa": 1.0, "hpa": 1e2, "kpa": 1e3, "mpa": 1e6, "bar": 1e5, "mbar": 1e2},
    **{"psi": 6894.757293168, "ksi": 6894757.293168, "psf": 47.88025898},
    **{"atm": 101325.0, "at": 98066.5, "torr": 133.322368421},
    **{"mmhg": 133.322387415, "cmhg": 1333.22387415, "inhg": 3386.389},
    **{"mmh2o": 9.80665, "cmh2o": 98.0665, "inh2o": 249.08891},
    **{
        f"{force}/{area}": newton / square
        for force, newton in _FORCES.items()
        for area, square in _AREAS.items()
    },
}
# Notations of squares. The byte that means ² in DOS code pages means ý in Latin-1.
_SQUARES = str.maketrans({"²": "2", "ý": "2", "^": "", ".": "", "*": ""})


class TekscanError(SoftfingerError, ValueError):
    """Error raised if a text is not a valid export."""


@dataclass(frozen=True)
class Export:
    """Parsed export.

    ``values`` float64 [frames, rows, cols] are in counts if ``raw`` is True, and otherwise in Pa.
    Positions without a cell are NaN. ``t`` float64 [frames] is the time since the first frame [s].
    ``pitch`` (x, y) [m] is None if the header does not contain it. ``full`` is the reading of a
    saturated cell, or inf if unknown.
    """

    values: NDArray[np.float64]
    t: NDArray[np.float64]
    raw: bool
    pitch: tuple[float, float] | None
    full: float


def decode(data: bytes) -> str:
    """Decode text in UTF-8, UTF-16 or a single-byte encoding, with or without a byte order mark."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    zeros = data[:200].count(0)
    if zeros > 0.3 * len(data[:200]):
        return data.decode("utf-16-le" if data[1:2] == b"\0" else "utf-16-be", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def parse(text: str, seconds_per_frame: float = 0.01) -> Export:
    """Parse an export. Raises TekscanError.

    ``seconds_per_frame`` [s] is used if the header does not state a frame period.
    """
    lines = text.splitlines()
    header, first = _header(lines)
    numbers, values = _frames(lines, first, _count(header, "ROWS"), _count(header, "COLS"))
    pitch = _pitch(header)
    factor = _unit(header, pitch)
    full = math.inf
    if factor is None:
        full = _RAW_SATURATION if np.nanmax(values, initial=0.0) <= _RAW_SATURATION else math.inf
    else:
        rounding = 0.5 * factor * 10.0 ** -_digits(values)
        values *= factor
        if "SATURATION_PRESSURE" in header:
            units = {**_PRESSURES, "": factor}
            full = _SATURATION_FRACTION * _quantity(header, "SATURATION_PRESSURE", units) - rounding
    step = seconds_per_frame
    if "SECONDS_PER_FRAME" in header:
        step = _quantity(header, "SECONDS_PER_FRAME", _TIMES)
    if not step > 0.0:
        raise TekscanError("SECONDS_PER_FRAME: expected a positive number of seconds")
    t = (np.array(numbers, np.float64) - numbers[0]) * step
    return Export(values, t, factor is None, pitch, full if full > 0.0 else math.inf)


def _digits(values: NDArray[np.float64]) -> int:
    """Return the number of decimal places in the readings."""
    for digits in range(9):
        rounded = np.round(values, digits)
        if np.allclose(values, rounded, rtol=1e-12, atol=0.0, equal_nan=True):
            return digits
    return 9


def _header(lines: list[str]) -> tuple[dict[str, str], int]:
    header: dict[str, str] = {}
    in_comments = False
    for number, line in enumerate(lines[:_HEADER_LINES_MAX]):
        match = re.match(r"(\w+)[\s,;:=]*(.*)", line.strip(_EDGE_CHARACTERS))
        if match is None:
            continue
        key, value = match[1].upper(), match[2].strip(_EDGE_CHARACTERS)
        if key == "ASCII_DATA":
            return header, number + 1
        if in_comments and match[1].isupper():
            header.setdefault(key, value)
        elif not in_comments:
            header[key] = value
            in_comments = key.startswith("COMMENT")
    raise TekscanError(
        "the file does not contain an ASCII_DATA line; expected a Tekscan-style export, or an .npz "
        "or .npy file"
    )


def _frames(
    lines: list[str], first: int, rows: int, cols: int
) -> tuple[list[int], NDArray[np.float64]]:
    """Parse the lines after the header; return frame numbers and readings [frames, rows, cols]."""
    numbers: list[int] = []
    readings: list[list[float]] = []
    separator = ""
    for number, text in enumerate(lines[first:], first + 1):
        line = text.strip()
        if not line.strip(_EDGE_CHARACTERS):
            continue
        if line.lstrip(_EDGE_CHARACTERS).startswith("@@"):
            break
        missing = len(numbers) * rows - len(readings)  # rows that the last frame still needs
        # A row starts with a number, with NaN, or with a single letter B.
        match = re.match(r'"?(?!nan|inf)[^\W\d]{2,}[\s:#,;]*(\d{1,9})\b', line, re.IGNORECASE)
        if match is not None:
            frame = int(match[1])
            if missing:
                had = f"frame {numbers[-1]} has {rows - missing} of {rows} rows"
                raise TekscanError(f"line {number}: {had}")
            if numbers and frame <= numbers[-1]:
                what = f"frame {frame} after frame {numbers[-1]}"
                raise TekscanError(f"line {number}: found {what}, expected increasing numbers")
            numbers.append(frame)
            continue
        if not numbers:  # single-frame export
            numbers.append(1)
        elif not missing:
            raise TekscanError(f"line {number}: found {line[:40]!r}, expected Frame n")
        separator = separator or _separator(line, cols)
        readings.append(_row(line, separator, cols, number))
    if not numbers:
        raise TekscanError("the file does not contain any frames")
    if missing := len(numbers) * rows - len(readings):
        had = f"{rows - missing} of {rows} rows"
        raise TekscanError(f"the file ends within frame {numbers[-1]}, which has {had}")
    return numbers, np.array(readings).reshape(-1, rows, cols)


def _separator(line: str, cols: int) -> str:
    """Detect the cell separator from the number of cells in a row."""
    for separator in ("\t", ";", ", ", ",", " "):
        if separator in line and len(_cells(line, separator, cols)) == cols:
            return separator
    return next((each for each in "\t;," if each in line), " ")


def _cells(line: str, separator: str, cols: int) -> list[str]:
    if separator == " ":
        return line.split(None, _SIZE_MAX)
    if '"' in line:
        try:
            cells = next(csv.reader([line], delimiter=separator[0], skipinitialspace=True))
        except csv.Error as error:
            raise TekscanError(
                f"found {line[:40]!r}…: {error}; check the quotation marks"
            ) from None
    else:
        cells = line.split(separator, 2 * _SIZE_MAX)
    while len(cells) > cols and not cells[-1].strip(_EDGE_CHARACTERS):
        cells.pop()
    return cells


def _row(line: str, separator: str, cols: int, number: int) -> list[float]:
    """Parse a row of readings, with NaN at positions without a cell."""
    cells = [cell.strip(' "').upper() for cell in _cells(line, separator, cols)]
    if separator == "," and len(cells) != cols:
        # Commas are decimal separators only if every number contains a comma.
        if len(cells) == 2 * cols - cells.count("B"):
            parts = iter(cells)
            cells = [part if part == "B" else f"{part}.{next(parts)}" for part in parts]
        elif cols < len(cells) < 2 * cols and all(each.isdigit() or each == "B" for each in cells):
            raise TekscanError(
                f"line {number}: found {len(cells)} cells, expected {cols}: the comma is both the "
                "separator and the decimal sign; export with decimal points or another separator"
            )
    if len(cells) != cols:
        raise TekscanError(f"line {number}: found {len(cells)} cells, expected {cols}")
    try:
        return [math.nan if cell == "B" else _number(cell) for cell in cells]
    except ValueError as error:
        raise TekscanError(f"line {number}: {error}") from None


_GROUPS = str.maketrans("", "", "'\N{RIGHT SINGLE QUOTATION MARK}\N{NO-BREAK SPACE}\u202f")


def _number(text: str) -> float:
    """Parse a number with a decimal point or comma.

    If both a point and a comma occur, whichever comes last is the decimal separator, and the other
    character groups digits. Apostrophes and narrow spaces only group digits.
    """
    text = text.translate(_GROUPS)
    if "," in text:
        text = text.replace("," if text.rfind(",") < text.rfind(".") else ".", "")
        text = text.replace(",", ".")
    value = float(text)
    if abs(value) > _NUMBER_MAX:
        raise ValueError(f"found {text}, expected at most {_NUMBER_MAX:g}")
    return value


def _count(header: dict[str, str], key: str) -> int:
    if key not in header:
        raise TekscanError(f"{key} is missing")
    text = header[key]
    if not re.fullmatch(r"[0-9]{1,4}", text) or not 1 <= int(text) <= _SIZE_MAX:
        raise TekscanError(f"{key}: found {text!r}, expected 1 to {_SIZE_MAX}")
    return int(text)


def _quantity(header: dict[str, str], key: str, units: dict[str, float]) -> float:
    """Parse a number with a unit and convert the number to SI units."""
    match = re.fullmatch(r"([-+0-9.,eE]+)[\s,;]*(.*)", header[key])
    try:
        value = _number(match[1].rstrip(",")) if match else math.nan
    except ValueError:
        value = math.nan
    unit = _plain_unit(match[2]) if match else ""
    if not math.isfinite(value) or unit not in units:
        known = ", ".join(name for name in units if 0 < len(name) <= 4)
        raise TekscanError(
            f"{key}: found {header[key]!r}, expected a number with one of the units {known}"
        )
    return value * units[unit]


def _pitch(header: dict[str, str]) -> tuple[float, float] | None:
    """Return the pitch (x, y) [m] from the spacings in the header, or None if one is missing."""
    found = []
    for key in ("COL_SPACING", "ROW_SPACING"):
        if key in header:
            found.append(_quantity(header, key, _LENGTHS))
            if found[-1] <= 0.0:
                raise TekscanError(f"{key}: expected a positive length")
    return (found[0], found[1]) if len(found) == 2 else None


def _unit(header: dict[str, str], pitch: tuple[float, float] | None) -> float | None:
    """Return the unit of the readings [Pa], or None for raw counts."""
    text = header.get("UNITS", "")
    unit = _plain_unit(text)
    if unit in _RAW:
        return None
    if unit in _PRESSURES:
        return _PRESSURES[unit]
    if unit not in _FORCES:
        raise TekscanError(f"UNITS: found {text!r}, expected RAW or a unit of pressure")
    area = pitch[0] * pitch[1] if pitch else 0.0  # The unit is a force per cell.
    if "SENSEL_AREA" in header:
        area = _quantity(header, "SENSEL_AREA", _AREAS)
    if area <= 0.0:
        raise TekscanError(f"UNITS: found {text!r}, a unit of force, which requires SENSEL_AREA")
    return _FORCES[unit] / area


def _plain_unit(unit: str) -> str:
    """Convert a unit to a uniform notation, in which squares end in 2."""
    plain = re.sub(r"[\s\[\]()]", "", unit.translate(_SQUARES)).lower()
    return re.sub(r"(sq|square)([a-z]+)", r"\g<2>2", plain)
