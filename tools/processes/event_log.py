"""The daemon's log: events as lines on standard error or in a file, written by its own thread.

A stopped terminal (Ctrl-S), a full pipe or a full disk blocks a writer: the tick never writes, and
lines that can't be written are dropped.

Plain lines are for people. With ``form="json"`` each line is an object: ``timestamp`` (Unix s, when
it was handed over), ``level`` (``info``, ``warning``, ``error``), ``kind`` and ``text``, as in
``hand/event``.
"""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import TextIO

from softfinger.daemon.own_files import write_text

_KEPT = 1000  # lines that wait for a slow reader; older ones are dropped
_LEVELS = {logging.DEBUG: "info", logging.INFO: "info", logging.WARNING: "warning"}


class EventLog:
    """Lines for people or programs. ``line`` never waits and never fails.

    Raises OSError when ``file`` can't be opened; it is written on at its end.
    """

    def __init__(self, form: str = "plain", file: Path | None = None) -> None:
        self.quiet = False  # while a page owns the terminal
        self._json = form == "json"
        self._file: TextIO | None = None
        if file is not None:
            self._file = write_text(file, append=True)
        self._lines: deque[tuple[float, str, str, str]] = deque(maxlen=_KEPT)
        self._news = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._write, name="event log", daemon=True)
        self._thread.start()

    def line(self, level: str, kind: str, text: str) -> None:
        if not self.quiet or self._file is not None:
            self._lines.append((time.time(), level, kind, text))
            self._news.set()

    def plain(self, text: str, level: str = "") -> None:
        """Hand over one line as it is; in JSON it is of ``level``, or ``info``, and no kind."""
        self._lines.append((time.time(), level, "", text))
        self._news.set()

    def take_over_logging(self) -> None:
        """Take all modules' warnings and errors from Python's logging."""
        handler = _LogHandler(self)
        handler.setLevel(logging.WARNING)
        logging.getLogger().addHandler(handler)

    def close(self, patience: float = 1.0) -> None:
        """Write what waits, for ``patience`` s at most."""
        self._closing = True
        self._news.set()
        self._thread.join(patience)

    def _write(self) -> None:
        out = sys.stderr if self._file is None else self._file
        while True:
            self._news.wait()
            self._news.clear()
            while self._lines:
                try:
                    print(self._shown(*self._lines.popleft()), file=out, flush=True)
                except (OSError, ValueError):
                    pass  # nobody can read it
            if self._closing:
                return

    def _shown(self, timestamp: float, level: str, kind: str, text: str) -> str:
        if self._json:
            record = {"timestamp": timestamp, "level": level or "info", "kind": kind, "text": text}
            return json.dumps(record, ensure_ascii=False)
        return f"{level:7} {kind:8} {text}" if kind else text


class _LogHandler(logging.Handler):
    """Python's logging into an event log."""

    def __init__(self, log: EventLog) -> None:
        super().__init__()
        self._log = log

    def emit(self, record: logging.LogRecord) -> None:
        level = _LEVELS.get(record.levelno, "error")
        try:
            self._log.line(level, record.name.rpartition(".")[2], record.getMessage())
        except Exception:  # a log call must not end its caller
            self.handleError(record)
