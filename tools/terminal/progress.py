"""A progress bar on standard error, if that is a terminal."""

from __future__ import annotations

import shutil
import sys
import time

_STEP = 0.1  # s between two redraws
_WIDTH = 20


class Progress:
    """``with Progress("analyse", total) as progress: progress(done)``; written to stderr."""

    def __init__(self, what: str, total: int, on: bool = True) -> None:
        self._what = what
        self._total = max(total, 1)
        self._shown = -1.0
        self.on = on and sys.stderr.isatty()

    def __call__(self, done: int, note: str = "") -> None:
        """Show that ``done`` of the total is done, with ``note`` instead of the percentage."""
        if not self.on or time.monotonic() - self._shown < _STEP:
            return
        self._shown = time.monotonic()
        fraction = min(done / self._total, 1.0)
        full = round(fraction * _WIDTH)
        bar = "█" * full + "·" * (_WIDTH - full)
        line = f"{self._what} {bar} {note or f'{fraction:4.0%}'}"
        columns = shutil.get_terminal_size().columns
        print(f"\r{line[: columns - 1]}\x1b[K", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self.on:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
