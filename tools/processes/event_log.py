"""The daemon's log: events as lines on standard error or in a file, written by its own thread.

A stopped terminal (Ctrl-S), a full pipe or a full disk blocks a writer: the tick never writes, and
lines that can't be written are dropped.

Plain lines are for people. With ``form="json"`` each line is an object: ``timestamp`` (Unix s, when
it was handed over), ``level`` (``info``, ``warning``, ``error``), ``kind`` and ``text``, as in
``hand/event``, and numbers as fields of their own. In systemd's journal each line has its priority.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any, TextIO

from softfinger.daemon.own_files import write_text

_KEPT = 1000  # lines that wait for a slow reader; older ones are dropped
_PRIORITIES = {"error": "<3>", "warning": "<4>", "": "<6>", "info": "<6>"}  # see sd-daemon(3)
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
        self._journal = file is None and _is_journal()
        self._lines: deque[tuple[float, str, str, str, dict[str, Any]]] = deque(maxlen=_KEPT)
        self._news = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._write, name="event log", daemon=True)
        self._thread.start()

    def line(self, level: str, kind: str, text: str, **fields: Any) -> None:
        """Hand over one line; ``fields`` are shown in JSON alone."""
        if not self.quiet or self._file is not None:
            self._lines.append((time.time(), level, kind, text, fields))
            self._news.set()

    def plain(self, text: str, level: str = "") -> None:
        """Hand over one line as it is; in JSON it is of ``level``, or ``info``, and no kind."""
        self._lines.append((time.time(), level, "", text, {}))
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

    def _shown(
        self, timestamp: float, level: str, kind: str, text: str, fields: dict[str, Any]
    ) -> str:
        if self._json:
            record = {"timestamp": timestamp, "level": level or "info", "kind": kind, "text": text}
            shown = json.dumps(record | fields, ensure_ascii=False)
        elif not kind:
            shown = text
        else:
            shown = f"{level:7} {kind:8} {text}"
            if not self._journal:  # which has the time of each line by itself
                date = "%H:%M:%S" if self._file is None else "%Y-%m-%d %H:%M:%S"
                shown = f"{_clock(date, timestamp)} {shown}"
        if self._journal:
            priority = _PRIORITIES[level]
            shown = priority + shown.replace("\n", f"\n{priority}")
        return shown


def _clock(date: str, timestamp: float) -> str:
    """The time of day, or the seconds of a nonsensical clock."""
    try:
        clock = time.strftime(date, time.localtime(timestamp))
    except (OverflowError, OSError, ValueError):
        return f"{timestamp:g}"
    return f"{clock}.{int(timestamp % 1.0 * 1e3):03}"


def _is_journal() -> bool:
    """Return whether standard error goes to systemd's journal."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


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
