"""A progress bar on the terminal, and nothing where there is none."""

from __future__ import annotations

import shutil
import sys
import time
from types import TracebackType

_STEP = 0.1  # s between two pictures
_WIDTH = 20


class Progress:
    """``with Progress("analyse", total) as progress: progress(done)``; written to stderr."""

    def __init__(self, what: str, total: int, on: bool = True) -> None:
        self._what = what
        self._total = max(total, 1)
        self._shown = -1.0
        self.on = on and sys.stderr.isatty()

    def __call__(self, done: int, note: str = "") -> None:
        """So much of the total is behind; ``note`` says more than the share does."""
        if not self.on or time.monotonic() - self._shown < _STEP:
            return
        self._shown = time.monotonic()
        share = min(done / self._total, 1.0)
        full = round(share * _WIDTH)
        bar = "█" * full + "·" * (_WIDTH - full)
        line = f"{self._what} {bar} {note or f'{share:4.0%}'}"
        columns = shutil.get_terminal_size().columns
        print(f"\r{line[: columns - 1]}\x1b[K", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.on:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
