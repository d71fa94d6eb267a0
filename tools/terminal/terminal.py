"""The terminal of a full-screen page: screen modes, key decoding, output, and their restoring.

Only lines that changed are written, in one write a redraw: that is light over ssh and doesn't
flicker.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterable, Sequence
from typing import Any

from rich.color import ColorSystem
from rich.console import Console
from rich.segment import Segment
from rich.text import Text

from softfinger.daemon.errors import SoftfingerError

with contextlib.suppress(ModuleNotFoundError):  # Windows has no page, but `monitor --plain`
    import termios
    import tty

_ENTER = "\x1b[?1049h\x1b[?25l\x1b[?2004h\x1b[2J"  # alternate screen, no cursor, pastes marked
_LEAVE = "\x18\x1b[0m\x1b[?2004l\x1b[?25h\x1b[?1049l"  # CAN ends a sequence that was cut off
_HOLD, _SHOW = "\x1b[?2026h", "\x1b[?2026l"  # terminals that know it show a redraw as one

_COLOUR_SYSTEMS = {
    "truecolor": ColorSystem.TRUECOLOR,
    "256": ColorSystem.EIGHT_BIT,
    "standard": ColorSystem.STANDARD,
}

_ARROWS = {b"D": "left", b"C": "right"}
_KEY = re.compile(
    rb"\x1b\[200~(?s:.)*?\x1b\[201~"  # a paste
    rb"|(?P<part>\x1b(\[(200~(?s:.)*|[0-?]*[ -/]*)|O)?\Z)"  # cut off: the rest is to come
    rb"|\x1b[\[O](?P<arrow>[CD])"
    rb"|\x1b(\[[0-?]*[ -/]*[@-~]|O(?s:.)|(?s:.))"  # a sequence that means nothing here
    rb"|(?P<character>[ -~])"
    rb"|(?s:.)"
)


class TerminalGone(SoftfingerError):
    """The terminal can't be written to any more, or a signal ended a blocked write."""


class KeyDecoder:
    """Decodes a terminal's bytes to names of keys. Pasted text is ignored."""

    def __init__(self) -> None:
        self._rest = b""

    def decode(self, data: bytes) -> list[str]:
        """Return the keys in ``data``: ``left``, ``right`` or the character itself."""
        keys = list(_KEY.finditer(self._rest + data))
        self._rest = keys[-1]["part"] or b"" if keys else b""
        known = (_ARROWS.get(key["arrow"]) or (key["character"] or b"").decode() for key in keys)
        return [key for key in known if key]

    def settle(self) -> None:
        """Drop an incomplete key: no more bytes come for now, and a lone Escape begins nothing."""
        if not self._rest.startswith(b"\x1b[200~"):
            self._rest = b""


class Terminal:
    """A context in which the page owns the terminal; it is restored afterwards."""

    def __init__(self, output: int, keyboard: int | None, suspendable: bool = True) -> None:
        self._output = output
        self._keyboard = keyboard
        self._suspendable = suspendable
        self._attributes: list[Any] | None = None
        self._shown: list[str] = []
        self._size = (0, 0)
        self.writing = False
        self._stuck = False
        self._console = Console()
        name = None if self._console.no_color else self._console.color_system
        self._colours = _COLOUR_SYSTEMS.get(name) if name else None
        self.coloured = name in ("truecolor", "256")  # 16 are too few for a map

    def __enter__(self) -> Terminal:
        if self._keyboard is not None:
            self._attributes = termios.tcgetattr(self._keyboard)
            tty.setcbreak(self._keyboard)  # also drops keys typed ahead
            if not self._suspendable:  # Ctrl-Z would stop the daemon too, torque on
                ours = termios.tcgetattr(self._keyboard)
                ours[6][termios.VSUSP] = b"\0"
                termios.tcsetattr(self._keyboard, termios.TCSANOW, ours)
        self._size = (0, 0)
        try:
            self._write(_ENTER)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError, termios.error, TerminalGone):
            if self._attributes is not None and self._keyboard is not None:
                # At once, not after the output has drained: a stopped terminal would block here.
                termios.tcsetattr(self._keyboard, termios.TCSANOW, self._attributes)
        with contextlib.suppress(OSError, termios.error, TerminalGone):
            if self._stuck:  # drop the page's rest
                termios.tcflush(self._output, termios.TCOFLUSH)
            termios.tcflow(self._output, termios.TCOON)  # as Ctrl-Q, or the next write hangs
            self._write(_LEAVE)

    def size(self) -> tuple[int, int]:
        """Return (columns, lines)"""
        try:
            size = os.get_terminal_size(self._output)
        except OSError:
            size = shutil.get_terminal_size()
        # A serial console may say 0 × 0.
        return size.columns or 80, size.lines or 24

    def draw(self, lines: Sequence[Text]) -> None:
        """Show ``lines``, each exactly as wide as the terminal."""
        output = []
        if (size := self.size()) != self._size:
            self._size = size
            self._shown = []
            output.append("\x1b[0m\x1b[2J")
        new = ["".join(map(self._render, self._segments(line))) for line in lines]
        for row, line in enumerate(new):
            if row >= len(self._shown) or line != self._shown[row]:
                output.append(f"\x1b[{row + 1};1H{line}")
        if output:
            self._write(_HOLD + "".join(output) + _SHOW)
        self._shown = new

    def _segments(self, line: Text) -> Iterable[Segment]:
        if line.spans:
            return line.render(self._console)
        return [Segment(line.plain, self._console.get_style(line.style))]

    def _render(self, segment: Segment) -> str:
        if segment.style is None:
            return segment.text
        return segment.style.render(segment.text, color_system=self._colours)

    def _write(self, text: str) -> None:
        data = memoryview(text.encode("utf-8", "replace"))
        self.writing = True
        try:
            while data:
                data = data[os.write(self._output, data) :]
        except TerminalGone:
            self._stuck = True
            raise
        except OSError as error:
            raise TerminalGone(str(error)) from error
        finally:
            self.writing = False
