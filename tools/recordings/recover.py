"""Repairs a recording that was cut short: its sound part goes into a file with an end."""

from __future__ import annotations

import contextlib
from pathlib import Path

from softfinger.daemon.errors import RecordingError
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.writer import RecordingWriter


def recover(path: Path) -> tuple[int, str]:
    """Close the recording in place; how many messages it has, and what ended its reading.

    A sound file is left as it is. The new file takes the old one's place only once it is whole.
    Raises RecordingError.
    """
    recording = Recording(path)
    if recording.check():
        return recording.total, ""
    closed = path.with_name(path.name + ".recovered")
    closed.unlink(missing_ok=True)
    writer = RecordingWriter(closed)
    try:
        for topic, message in recording.messages():
            writer.add(topic, message)
        writer.close()
        closed.replace(path)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from None
    finally:
        with contextlib.suppress(OSError):
            closed.unlink(missing_ok=True)
    return writer.messages, recording.damage
