"""`RecordingWriter`: messages of the stream into an MCAP file, chunk by chunk."""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from pathlib import Path
from typing import Any

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.wire import schema
from softfinger.tools.extras import require
from softfinger.tools.recordings.channels import (
    ENCODING,
    LIBRARY,
    PROFILE,
    SCHEMA_ENCODING,
    Converter,
    channel_name,
    schema_of,
    to_json,
)

# A killed recorder loses at most the chunk that wasn't full yet, since the last flush.
CHUNK = 256 * 1024  # bytes before compression: a fifth of a second of state at 1 kHz


class RecordingWriter:
    """Writes one file. ``messages`` and ``size`` [bytes] count what is in it: whole chunks.

    Raises RecordingError when the file can't be opened, or exists already. After a failed write the
    file is closed: what was written until then can be read.
    """

    def __init__(self, path: Path) -> None:
        require("record")
        import orjson
        from mcap.writer import Writer

        self.path = path
        self.messages = 0
        self.size = 0
        self._dumps = orjson.dumps
        self._added = 0  # messages, with those of the chunk that is being filled
        self._filled = 0  # bytes of messages in that chunk
        self._channels: dict[bytes | str, tuple[int, Converter]] = {}  # by topic, frames' by name
        self._schemas: dict[bytes, int] = {}
        self._ended = False
        self._newest = math.nan  # time of the newest message [s]
        self._early: list[tuple[bytes, dict[str, Any]]] = []  # repeated before any other came
        try:
            self._file = path.open("xb", buffering=4 * CHUNK)  # a chunk goes out in one write
        except FileExistsError:
            raise RecordingError(f"{path}: exists already; nothing is written over it") from None
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror}") from None
        try:
            self._mcap = Writer(self._file, 2 * CHUNK)  # `add` ends a chunk before that
            self._mcap.start(PROFILE, LIBRARY)
            self._wrote()
        except OSError as error:
            raise self._failed(error) from None

    def add(self, topic: bytes, message: dict[str, Any]) -> None:
        """Write one message; the map may be changed. Raises RecordingError.

        A repeated message (``again``) has its first time in it, from before the recording. In the
        file its log time is that of the message before it, so that the file's times are its own.
        """
        assert not self._ended
        stamp = message.get("timestamp")
        when = stamp if isinstance(stamp, float) and 0.0 <= stamp < 1e10 else time.time()
        if message.get("again") is not True:
            self._newest = when
            if self._early:
                self._write_early(when)
        elif math.isnan(self._newest):
            self._early.append((topic, message))
            return
        else:
            when = self._newest
        self._write(topic, message, when)

    def flush(self) -> None:
        """End the chunk and hand it to the system: a killed process doesn't lose it."""
        try:
            self._mcap.flush()  # type: ignore[no-untyped-call]
            self._wrote()
        except OSError as error:
            raise self._failed(error) from None

    def close(self) -> None:
        """Write the last chunk and the summary. Raises RecordingError."""
        if self._ended:
            return
        if self._early:
            self._write_early(time.time())
        self._ended = True
        try:
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._wrote()
            self._file.close()
            del self._mcap  # with the index of all its chunks, by far the most of its memory
        except OSError as error:
            raise self._failed(error) from None

    def _write_early(self, when: float) -> None:
        early, self._early = self._early, []
        for topic, message in early:
            self._write(topic, message, when)

    def _write(self, topic: bytes, message: dict[str, Any], when: float) -> None:
        key = channel_name(topic, message) if topic == schema.TACTILE else topic
        try:
            if key not in self._channels:
                self._channels[key] = self._open(channel_name(topic, message), topic)
            channel, convert = self._channels[key]
            try:
                data = self._dumps(convert(message))
            except TypeError:  # orjson's error, too: JSON can't hold it
                return
            sequence = message.get("seq")
            sequence = sequence & 0xFFFFFFFF if isinstance(sequence, int) else 0
            stamp = int(when * 1e9)
            self._mcap.add_message(channel, stamp, data, stamp, sequence)
        except OSError as error:
            raise self._failed(error) from None
        self._added += 1
        self._filled += len(data)
        if self._filled > CHUNK:
            self.flush()

    def _open(self, name: str, topic: bytes) -> tuple[int, Converter]:
        number = self._schemas.get(topic)
        if number is None:
            title, fields = schema_of(topic)
            text = json.dumps(fields, ensure_ascii=False).encode()
            number = self._schemas[topic] = self._mcap.register_schema(title, SCHEMA_ENCODING, text)
        return self._mcap.register_channel(name, ENCODING, number), to_json(topic)

    def _wrote(self) -> None:
        self._file.flush()
        self.size, self.messages, self._filled = self._file.tell(), self._added, 0

    def _failed(self, error: OSError) -> RecordingError:
        self._ended = True
        with contextlib.suppress(OSError):  # the buffer's rest doesn't fit either, and is dropped
            self._file.close()
        with contextlib.suppress(OSError):
            os.truncate(self.path, self.size)  # to the last record that is whole
        return RecordingError(
            f"{self.path}: {error.strerror}; what was written until then can be read, "
            f"`softfinger record --recover {self.path}` closes it"
        )
