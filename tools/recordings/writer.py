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
from softfinger.tools.recordings.container import Container
from softfinger.tools.recordings.errors import require_packages
from softfinger.tools.recordings.layout import (
    ENCODING,
    LIBRARY,
    PROFILE,
    SCHEMA_ENCODING,
    Converter,
    channel_name,
    schema_of,
    to_json,
)

# What a killed recorder loses at most: what didn't fill a chunk yet, since the last flush.
CHUNK = 256 * 1024  # bytes before compression: a fifth of a second of state at 1 kHz


class _Channel:
    """A channel's number and its converter."""

    def __init__(self, number: int, convert: Converter) -> None:
        self.number = number
        self.convert = convert


class RecordingWriter:
    """Writes one file. Raises RecordingError when it can't be opened, or is there already.

    After a failed write the file is closed as it is: what was written until then can be read.
    """

    def __init__(self, path: Path) -> None:
        require_packages()
        import orjson

        self.path = path
        try:
            self._file = path.open("xb")
        except FileExistsError:
            raise RecordingError(f"{path}: is there already; nothing is written over it") from None
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror}") from None
        self._dumps = orjson.dumps
        self._json_error = orjson.JSONEncodeError
        self._channels: dict[bytes | str, _Channel] = {}  # by topic, frames' by channel
        self._schemas: dict[bytes, int] = {}
        self._ended = False
        self._newest = math.nan  # time of the newest message [s]
        self._early: list[tuple[bytes, dict[str, Any]]] = []  # told again before any other came
        self.unfit = 0  # messages that JSON can't hold
        try:
            self._container = Container(self._file, PROFILE, LIBRARY, CHUNK)
        except OSError as error:
            raise self._failed(error) from None

    def add(self, topic: bytes, message: dict[str, Any]) -> None:
        """Write one message; the map may be changed. Raises RecordingError.

        What is told again has its first time in it, from before the recording: in the file it
        stands where it came, so that the file's time is the recording's own.
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

    def _write_early(self, when: float) -> None:
        early, self._early = self._early, []
        for topic, message in early:
            self._write(topic, message, when)

    def _write(self, topic: bytes, message: dict[str, Any], when: float) -> None:
        key = channel_name(topic, message) if topic == schema.TACTILE else topic
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = self._open(channel_name(topic, message), topic)
        sequence = message.get("seq")
        if not isinstance(sequence, int):
            sequence = 0
        try:
            data = self._dumps(channel.convert(message))
        except (self._json_error, TypeError):
            self.unfit += 1
            return
        try:
            self._container.message(channel.number, int(when * 1e9), sequence & 0xFFFFFFFF, data)
        except OSError as error:
            raise self._failed(error) from None

    def _open(self, name: str, topic: bytes) -> _Channel:
        schema = self._schemas.get(topic)
        if schema is None:
            title, fields = schema_of(topic)
            text = json.dumps(fields, ensure_ascii=False).encode()
            schema = self._schemas[topic] = self._container.schema(title, SCHEMA_ENCODING, text)
        return _Channel(self._container.channel(name, ENCODING, schema), to_json(topic))

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Put a file into the recording, as the settings are. Raises RecordingError."""
        assert not self._ended
        try:
            self._container.attachment(time.time_ns(), name, media_type, data)
        except OSError as error:
            raise self._failed(error) from None

    @property
    def messages(self) -> int:
        """How many are in the file; a chunk's messages count once it is full."""
        return self._container.messages

    @property
    def size(self) -> int:
        """Bytes in the file so far; a chunk's messages count once it is full."""
        return self._container.size

    def flush(self) -> None:
        """Hand all to the system, in a short chunk: from then on a killed process loses it not."""
        assert not self._ended
        try:
            self._container.end_chunk()
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
            self._container.finish()
            self._file.close()
        except OSError as error:
            raise self._failed(error) from None

    def _failed(self, error: OSError) -> RecordingError:
        self._ended = True
        with contextlib.suppress(OSError):  # the buffer's rest doesn't fit either, and is dropped
            self._file.close()
        # A record that got in half way is none.
        with contextlib.suppress(OSError, AttributeError):
            os.truncate(self.path, self._container.size)
        return RecordingError(
            f"{self.path}: {error.strerror}; what was written until then can be read, "
            f"`softfinger record --recover {self.path}` closes it"
        )
