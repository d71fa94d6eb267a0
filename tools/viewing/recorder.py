"""Start and end recordings at the web page's request."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softfinger.tools.processes.child_processes import RecorderProcess


class PageRecorder:
    """Run one `softfinger record` process at a time, in the current folder.

    ``show`` receives a map with the running recording's ``file`` and its start time ``since`` (Unix
    time [s]). If the recording failed, the map contains the reason as ``failed``. If no recording
    is running, the map is empty.
    """

    def __init__(self, address: str, keys: str, show: Callable[[dict[str, Any]], None]) -> None:
        self._address = address
        self._keys = keys
        self._show = show
        self._lock = threading.Lock()
        self._process: RecorderProcess | None = None

    def toggle(self) -> str:
        """Start a recording, or end the running one; return a line that describes the result."""
        try:
            from softfinger.tools.processes.child_processes import RecorderError, RecorderProcess
        except ImportError:  # This system has no termios.
            return "✗ record: available only on Linux and macOS; use softfinger record instead"
        with self._lock:
            if self._process is not None:
                return f"✓ {self._end()}"
            path = Path(time.strftime("softfinger-%Y%m%d-%H%M%S.mcap")).absolute()
            words = [str(path), "--address", self._address]
            try:
                self._process = RecorderProcess(words, path.exists, self._failed, self._keys)
            except RecorderError as error:
                return f"✗ record: {error}"
            self._show({"file": path.name, "since": time.time()})
            return f"✓ recording to {path}"

    def close(self) -> None:
        """End the running recording, if any."""
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
