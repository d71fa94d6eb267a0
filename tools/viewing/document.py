"""Combine the page's parts into one HTML document, to be served or saved with a recording."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from urllib.parse import quote

from softfinger.tools.terminal.stream_state import GLOSSARY

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
    recording's pictures, compressed by `saved.save`.
    """
    others = rf'<section class="(?!{kind}).*?</section>'
    page = re.sub(others, "", _WHOLE, flags=re.S)
    return page.replace("STORED", base64.b64encode(stored).decode(), 1)
