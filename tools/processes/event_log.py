"""Write the daemon's events to standard error or a file, one per line, in a separate thread.

A stopped terminal (Ctrl-S), a full pipe or a full disk blocks writes. Ticks therefore never write
to the log. Lines that cannot be written are dropped.

Plain lines are for human readers. With ``form="json"``, each line is an object with the fields
``timestamp``, ``level``, ``kind`` and ``text``, as in ``hand/event``. ``timestamp`` is the Unix
time [s] at which the line was queued. ``level`` is ``info``, ``warning`` or ``error``. Additional
fields contain numbers. In systemd's journal, each line has a priority.
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

# Maximum number of lines queued for a slow reader. If the queue is full, the oldest line is
# dropped.
_LINE_COUNT_MAX = 1000
_PRIORITIES = {"error": "<3>", "warning": "<4>", "info": "<6>"}  # see sd-daemon(3)


class EventLog:
    """Log in plain text or JSON; the ``line`` method never blocks or fails.

    If ``file`` already exists, lines are appended to it. Raises OSError if the file cannot be
    opened.
    """

    def __init__(self, form: str = "plain", file: Path | None = None) -> None:
        self.quiet = False  # True while a full-screen page uses the terminal
        self._json = form == "json"
        self._file: TextIO | None = None
        if file is not None:
            self._file = write_text(file, append=True)
        self._journal = file is None and _is_journal()
        self._lines: deque[tuple[float, str, str, str, dict[str, Any]]] = deque(
            maxlen=_LINE_COUNT_MAX
        )
        self._news = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._write, name="event log", daemon=True)
        self._thread.start()

    def line(self, level: str, kind: str, text: str, **fields: Any) -> None:
        """Queue one line. The ``fields`` appear only in JSON logs.

        Without a ``kind``, plain logs show the ``text`` unchanged.
        """
        if not self.quiet or self._file is not None:
            self._lines.append((time.time(), level, kind, text, fields))
            self._news.set()

    def take_over_logging(self) -> None:
        """Log the warnings and errors that any module sends to Python's logging."""
        logging.getLogger().addHandler(_LogHandler(self))

    def close(self, patience: float = 1.0) -> None:
        """Write the queued lines, and wait at most ``patience`` s until they are written."""
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
                    pass  # The output was closed.
            if self._closing:
                return

    def _shown(
        self, timestamp: float, level: str, kind: str, text: str, fields: dict[str, Any]
    ) -> str:
        if self._json:
            record = {"timestamp": timestamp, "level": level, "kind": kind, "text": text}
            shown = json.dumps(record | fields, ensure_ascii=False)
        elif not kind:
            shown = text
        else:
            shown = f"{level:7} {kind:8} {text}"
            if not self._journal:  # The systemd journal adds the time.
                date = "%H:%M:%S" if self._file is None else "%Y-%m-%d %H:%M:%S"
                shown = f"{_clock(date, timestamp)} {shown}"
        if self._journal:
            priority = _PRIORITIES[level]
            shown = priority + shown.replace("\n", f"\n{priority}")
        return shown


def _clock(date: str, timestamp: float) -> str:
    """Format a Unix time as a date, or as plain seconds if the date is invalid."""
    try:
        clock = time.strftime(date, time.localtime(timestamp))
    except (OverflowError, OSError, ValueError):
        return f"{timestamp:g}"
    return f"{clock}.{int(timestamp % 1.0 * 1e3):03}"


def _is_journal() -> bool:
    """Return True if standard error is connected to systemd's journal."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class _LogHandler(logging.Handler):
    """Forward the warnings and errors of Python's logging to an event log."""

    def __init__(self, log: EventLog) -> None:
        super().__init__(logging.WARNING)
        self._log = log

    def emit(self, record: logging.LogRecord) -> None:
        level = "warning" if record.levelno < logging.ERROR else "error"
        try:
            self._log.line(level, record.name.rpartition(".")[2], record.getMessage())
        except Exception:  # A logging error must not stop the caller.
            self.handleError(record)
