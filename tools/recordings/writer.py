"""`RecordingWriter`: messages of the stream into an MCAP file, chunk by chunk."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tools.recordings.errors import NoMcap, RecordingError
from tools.recordings.layout import (
    ENCODING,
    LIBRARY,
    PROFILE,
    SCHEMA_ENCODING,
    Converter,
    channel_name,
    schema_of,
    to_json,
)

if TYPE_CHECKING:
    from mcap.writer import Writer

# What a killed recorder loses at most: messages that did not fill a chunk yet.
CHUNK = 256 * 1024  # bytes before compression: a fifth of a second of state at 1 kHz


class _Channel:
    """A channel's number, its converter and how many messages it has."""

    def __init__(self, number: int, convert: Converter) -> None:
        self.number = number
        self.convert = convert
        self.count = 0


class RecordingWriter:
    """Writes one file. Raises RecordingError when it can't be opened, or is there already.

    After a failed write the file is closed as it is: what was written until then can be read.
    """

    def __init__(self, path: Path) -> None:
        try:
            import orjson
            from mcap.writer import CompressionType, Writer
        except ImportError:
            raise NoMcap from None
        self.path = path
        try:
            self._file = path.open("xb")
        except FileExistsError:
            raise RecordingError(f"{path}: is there already; nothing is written over it") from None
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror}") from None
        self._dumps = orjson.dumps
        self._json_error = orjson.JSONEncodeError
        self._channels: dict[str, _Channel] = {}
        self._schemas: dict[bytes, int] = {}
        self._writer: Writer | None = Writer(
            self._file, chunk_size=CHUNK, compression=CompressionType.ZSTD
        )
        self.messages = 0
        self.unfit = 0  # messages that JSON can't hold
        self.first = math.nan  # Unix time of the earliest message [s]
        self.last = math.nan
        self._writer.start(profile=PROFILE, library=LIBRARY)

    def add(self, topic: bytes, message: dict[str, Any]) -> None:
        """Write one message; the map may be changed. Raises RecordingError."""
        assert self._writer is not None
        name = channel_name(topic, message)
        stamp = message.get("timestamp")
        when = stamp if isinstance(stamp, float) and 0.0 <= stamp < 1e10 else time.time()
        sequence = message.get("seq")
        channel = self._channels.get(name) or self._open(name, topic)
        try:
            data = self._dumps(channel.convert(message))
        except (self._json_error, TypeError):
            self.unfit += 1
            return
        nanoseconds = int(when * 1e9)
        try:
            self._writer.add_message(
                channel.number,
                nanoseconds,
                data,
                nanoseconds,
                sequence & 0xFFFFFFFF if isinstance(sequence, int) else 0,
            )
        except OSError as error:
            raise self._failed(error) from None
        channel.count += 1
        self.messages += 1
        self.first = when if math.isnan(self.first) else min(self.first, when)
        self.last = when if math.isnan(self.last) else max(self.last, when)

    def _open(self, name: str, topic: bytes) -> _Channel:
        assert self._writer is not None
        schema = self._schemas.get(topic)
        if schema is None:
            title, fields = schema_of(topic)
            schema = self._writer.register_schema(
                title, SCHEMA_ENCODING, json.dumps(fields, ensure_ascii=False).encode()
            )
            self._schemas[topic] = schema
        number = self._writer.register_channel(name, ENCODING, schema)
        channel = self._channels[name] = _Channel(number, to_json(topic))
        return channel

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Put a file into the recording, as the settings are. Raises RecordingError."""
        assert self._writer is not None
        now = time.time_ns()
        try:
            self._writer.add_attachment(now, now, name, media_type, data)
        except OSError as error:
            raise self._failed(error) from None

    @property
    def size(self) -> int:
        """Bytes in the file so far; a chunk's messages count once it is full."""
        return 0 if self._file.closed else self._file.tell()

    @property
    def counts(self) -> dict[str, int]:
        """Messages by channel."""
        return {name: channel.count for name, channel in self._channels.items()}

    def flush(self) -> None:
        """Hand to the system what chunks are full: from then on a killed process loses it not."""
        try:
            self._file.flush()
        except OSError as error:
            raise self._failed(error) from None

    def close(self) -> None:
        """Write the last chunk and the summary. Raises RecordingError."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
        except OSError as error:
            raise self._failed(error) from None

    def _failed(self, error: OSError) -> RecordingError:
        self._writer = None
        try:
            self._file.close()
        except OSError:
            pass  # the buffer's rest doesn't fit either; the descriptor is closed all the same
        return RecordingError(
            f"{self.path}: {error.strerror}; what was written until then can be read, "
            f"`softfinger record --recover {self.path}` closes it"
        )
