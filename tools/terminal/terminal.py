"""Switch a terminal to a full-screen page, decode its keys, draw, and restore the terminal.

A redraw sends all changed lines in a single write, which is fast over ssh and avoids flicker.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import COLOR_SYSTEMS, Console
from rich.segment import Segment
from rich.text import Text

from softfinger.daemon.errors import SoftfingerError

with contextlib.suppress(ModuleNotFoundError):  # On Windows, only `monitor --plain` is supported.
    import termios
    import tty

_ENTER = "\x1b[?1049h\x1b[?25l\x1b[?2004h\x1b[2J"  # alternate screen, no cursor, bracketed paste
# This sequence begins with CAN, which ends an incomplete escape sequence.
LEAVE = "\x18\x1b[0m\x1b[?2004l\x1b[?25h\x1b[?1049l"
_HOLD, _SHOW = "\x1b[?2026h", "\x1b[?2026l"  # synchronised update, if supported by the terminal

_ARROWS = {b"D": "left", b"C": "right"}
_KEY = re.compile(
    rb"\x1b\[200~(?s:.)*?\x1b\[201~"  # a paste
    rb"|(?P<part>\x1b(\[(200~(?s:.)*|[0-?]*[ -/]*)|O)?\Z)"  # an incomplete sequence
    rb"|\x1b[\[O](?P<arrow>[CD])"
    rb"|\x1b(\[[0-?]*[ -/]*[@-~]|O(?s:.)|(?s:.))"  # an unused sequence
    rb"|(?P<character>[ -~])"
    rb"|(?s:.)"
)


class TerminalGone(SoftfingerError):
    """Error raised if writing to the terminal fails, or if a signal interrupts a blocked write."""


class KeyDecoder:
    """Decode a terminal's bytes into key names, and ignore pasted text."""

    def __init__(self) -> None:
        self._rest = b""

    def decode(self, data: bytes) -> list[str]:
        """Return the key names in ``data``: ``left``, ``right`` or the typed character."""
        keys = list(_KEY.finditer(self._rest + data))
        self._rest = keys[-1]["part"] or b"" if keys else b""
        known = (_ARROWS.get(key["arrow"]) or (key["character"] or b"").decode() for key in keys)
        return [key for key in known if key]

    def settle(self) -> None:
        """Drop an incomplete key code if no more bytes are queued, e.g. after a single Escape."""
        if not self._rest.startswith(b"\x1b[200~"):
            self._rest = b""


class Terminal:
    """Context manager that gives the page control of the terminal, then restores the terminal."""

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
        self._colours = COLOR_SYSTEMS[name] if name else None
        self.coloured = name in ("truecolor", "256")  # A map requires more than 16 colours.

    def __enter__(self) -> Terminal:
        if self._keyboard is not None:
            self._attributes = termios.tcgetattr(self._keyboard)
            tty.setcbreak(self._keyboard)  # This call also discards earlier key presses.
            # Disable Ctrl-Z, because it would also suspend the daemon while torque is on.
            if not self._suspendable:
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
                # Do not wait for the output to drain, because the process would block on a stopped
                # terminal.
                termios.tcsetattr(self._keyboard, termios.TCSANOW, self._attributes)
        with contextlib.suppress(OSError, termios.error, TerminalGone):
            if self._stuck:  # Discard output that has not been written yet.
                termios.tcflush(self._output, termios.TCOFLUSH)
            # Resume a terminal that was stopped by Ctrl-S; otherwise the next write would block.
            termios.tcflow(self._output, termios.TCOON)
            self._write(LEAVE)

    def size(self) -> tuple[int, int]:
        """Return the size as (columns, lines)."""
        try:
            size = os.get_terminal_size(self._output)
        except OSError:
            size = shutil.get_terminal_size()
        # A serial console may report a size of 0 × 0.
        return size.columns or 80, size.lines or 24

    def draw(self, lines: Sequence[Text]) -> None:
        """Show ``lines``, which must be exactly as wide as the terminal."""
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
