"""Build the page's HTML document, and save a recording as a page or as an animated picture."""

from __future__ import annotations

import base64
import gzip
import json
import math
import re
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from urllib.parse import quote

from softfinger.daemon.own_files import write_text
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.terminal.stream_state import GLOSSARY
from softfinger.tools.viewing.hand_drawing import COLOURS
from softfinger.tools.viewing.pictures import Pictures, Row
from softfinger.tools.viewing.sources import Playback, ViewError, marks_of

_PICTURE_COUNT_MAX = 6000  # maximum number of pictures in the page's memory; each takes about 10 kB
_SCALE = 3000.0  # SVG user units per metre
_ARC = 30  # number of points above which a line omits every second point

_HELP = "".join(f"<dt><b>{words}</b><dd>{meaning}" for words, meaning in GLOSSARY)
_WEB = Path(__file__).with_name("web")


def _whole() -> str:
    html, style, icon, *scripts = (
        (_WEB / name).read_text("utf-8")
        for name in ("page.html", "page.css", "icon.svg", "charts.js", "controls.js", "page.js")
    )
    parts = {"GLOSSARY": _HELP, "STYLE": style, "ICON": quote(icon), "SCRIPTS": "".join(scripts)}
    return re.sub("|".join(parts), lambda word: parts[word[0]], html)


_WHOLE = _whole()


def document(kind: str, stored: bytes = b"") -> str:
    """Return the page for the ``kind`` of visitor: ``command``, ``watch`` or ``play``.

    Without ``stored``, the page receives pictures from its server. ``stored`` contains a
    recording's pictures, compressed by `save`.
    """
    others = rf'<section class="(?!{kind}).*?</section>'
    page = re.sub(others, "", _WHOLE, flags=re.S)
    return page.replace("STORED", base64.b64encode(stored).decode(), 1)


def save(path: Path, recording: Recording, period: float, say: Callable[[str], None]) -> None:
    """Save pictures at intervals of ``period`` [s]. The suffix of ``path`` selects the format.

    Raises
    ------
    ViewError
        If the recording is too long or has no states, or if the file cannot be written.
    """
    count = 1 + math.ceil(recording.duration / period)
    if count > _PICTURE_COUNT_MAX:
        raise ViewError(
            f"{recording.path}: {recording.duration:.0f} s of recording require {count} pictures, "
            f"expected at most {_PICTURE_COUNT_MAX}; choose a lower --rate"
        )
    scenes, rows, seen = _pictures(recording, period, count, say)
    if seen == 0:
        raise ViewError(f"{recording.path}: the recording does not contain hand/state")
    if path.suffix == ".svg":
        text = _moving(scenes, period)
    else:
        lines = [*chain.from_iterable((scene, *shown) for scene, shown in scenes), rows]
        text = document("play", gzip.compress("\n".join(lines).encode(), mtime=0))
    try:
        with write_text(path) as file:
            file.write(text)
    except OSError as error:
        raise ViewError(f"{path}: {error.strerror}") from None


def _pictures(
    recording: Recording, period: float, count: int, say: Callable[[str], None]
) -> tuple[list[tuple[str, list[str]]], str, int]:
    """Return each scene with its pictures, all plot rows, and the number of states.

    The scenes, pictures and rows are the JSON texts that the server would send to a page.
    """
    scenes: list[tuple[str, list[str]]] = []
    kept: dict[int, str] = {}

    def keep(scene: str, picture: str, rows: list[Row]) -> None:
        if not scenes or scene != scenes[-1][0]:
            scenes.append((scene, []))
        scenes[-1][1].append(picture)
        kept.update((row.number, row.text) for row in rows)

    pictures = Pictures(keep, lambda: True, say, live=False, period=period)
    pictures.mark(marks_of(recording))
    playback = Playback(recording, pictures, period)
    for k in range(count):
        playback.position = min(k * period, recording.duration)
        playback.show()
    return scenes, f"[{','.join(kept.values())}]", pictures.seen


def _moving(scenes: list[tuple[str, list[str]]], period: float) -> str:
    """Draw the hand as an animated SVG, which needs no scripts."""
    (box,) = (
        panel["box"] for panel in json.loads(scenes[0][0])["panels"] if panel["name"] == "hand"
    )
    shown = [json.loads(each)["panels"]["hand"]["lines"] for _, kept in scenes for each in kept]
    left, right, top, bottom = (_SCALE * side for side in box)
    # Each line is identified by its colour and by its index among the lines of this colour.
    lines: dict[tuple[str, int], tuple[float, list[list[str]]]] = {}
    for k, drawn in enumerate(shown):
        places: dict[str, int] = {}
        for colour, thick, flat in drawn:
            place = places[colour] = places.get(colour, -1) + 1
            _, points = lines.setdefault((colour, place), (thick, len(shown) * [["0,0"]]))
            points[k] = _points(flat, left, top)
    seconds = f"{period * len(shown):g}"
    wide, tall = f"{right - left:.0f}", f"{top - bottom:.0f}"
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {tall}" width="{wide}" '
        f'height="{tall}" color="{_hex("goal")}" fill="none" stroke-linejoin="round">'
    ]
    for (colour, _), (thick, points) in lines.items():
        # All values have the same number of points, because Chromium mixes lists of different
        # lengths.
        count = max(map(len, points))
        values = [" ".join(each + (count - len(each)) * each[-1:]) for each in points]
        stroke = "currentColor" if colour == "goal" else _hex(colour)
        look = f'stroke="{stroke}" stroke-width="{_SCALE * thick:.3g}"'
        parts.append(f'<polyline {look} points="{values[-1]}">')
        if len(set(values)) > 1:
            parts.append(
                f'<animate attributeName="points" calcMode="discrete" dur="{seconds}s" '
                f'repeatCount="indefinite" values="{";".join(values)}"/>'
            )
        parts.append("</polyline>")
    return "\n".join([*parts, "</svg>\n"])


def _points(flat: list[float], left: float, top: float) -> list[str]:
    pairs = list(zip(flat[::2], flat[1::2], strict=True))
    if len(pairs) > _ARC:
        pairs = pairs[::2]
    return [f"{_SCALE * x - left:.0f},{top - _SCALE * y:.0f}" for x, y in pairs]


def _hex(colour: str) -> str:
    return "#{:02x}{:02x}{:02x}".format(*COLOURS[colour])
