"""Recordings that the page begins and ends."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softfinger.tools.processes.beside import RecorderBeside


class PageRecorder:
    """One recording at a time, by `softfinger record` in the current folder.

    ``show`` is given the recording that goes on: its ``file`` and ``since`` [Unix s], or why it
    ``failed``; an empty map without one.
    """

    def __init__(self, address: str, keys: str, show: Callable[[dict[str, Any]], None]) -> None:
        self._address = address
        self._keys = keys
        self._show = show
        self._lock = threading.Lock()
        self._process: RecorderBeside | None = None

    def toggle(self) -> str:
        """Begin a recording, or end the one that goes on; a line about it."""
        try:
            from softfinger.tools.processes.beside import NoRecorder, RecorderBeside
        except ImportError:  # no termios
            return "✗ record: only on Linux and macOS; use softfinger record"
        with self._lock:
            if self._process is not None:
                return f"✓ {self._end()}"
            path = Path(time.strftime("softfinger-%Y%m%d-%H%M%S.mcap")).absolute()
            words = [str(path), "--address", self._address]
            try:
                self._process = RecorderBeside(words, path.exists, self._failed, self._keys)
            except NoRecorder as error:
                return f"✗ record: {error}"
            self._show({"file": path.name, "since": time.time()})
            return f"✓ recording to {path}"

    def close(self) -> None:
        """End a recording that goes on."""
        with self._lock:
            if self._process is not None:
                self._end()

    def _end(self) -> str:
        assert self._process is not None
        said = self._process.close()
        self._process = None
        self._show({})
        return said

    def _failed(self, why: str) -> None:
        self._process = None
        self._show({"failed": why})
