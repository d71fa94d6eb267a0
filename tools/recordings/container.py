"""`Container`: an MCAP file as it is written, record by record.

Holds the file format alone: records, chunks with their compression and index, the summary at the
end. A message costs one packed header and three appended numbers; all else is done once a chunk,
which is what keeps a recorder of a thousand messages a second at a few percent of a core. What is
in the messages is the writer's; reading is left to the mcap package.
"""

from __future__ import annotations

import struct
import zlib
from typing import BinaryIO

_MAGIC = b"\x89MCAP0\r\n"
_COMPRESSION = "zstd"
_LEVEL = 1  # our JSON comes out smaller than at zstd's usual 3, in half the time

_HEADER = 0x01
_FOOTER = 0x02
_SCHEMA = 0x03
_CHANNEL = 0x04
_MESSAGE = 0x05
_CHUNK = 0x06
_MESSAGE_INDEX = 0x07
_CHUNK_INDEX = 0x08
_ATTACHMENT = 0x09
_ATTACHMENT_INDEX = 0x0A
_STATISTICS = 0x0B
_SUMMARY_OFFSET = 0x0E
_DATA_END = 0x0F

# Opcode, length, channel, sequence, log time, publish time; the data follows.
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_MESSAGE_BODY = _MESSAGE_HEAD.size - 9  # bytes of it that count as the record's length


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _text(value: str) -> bytes:
    encoded = value.encode()
    return struct.pack("<I", len(encoded)) + encoded


class Container:
    """Writes one file that is open at its beginning; any method may raise OSError.

    ``chunk`` bytes of messages are compressed together. ``size`` is the file's so far [bytes], of
    records that the system has taken whole.
    """

    def __init__(self, file: BinaryIO, profile: str, library: str, chunk: int) -> None:
        import zstandard

        self.size = 0
        self._file = file
        self._chunk = chunk
        self._compress = zstandard.ZstdCompressor(level=_LEVEL).compress
        self._parts: list[bytes] = []  # of the chunk that is being filled
        self._filled = 0  # bytes in them
        self._indices: dict[int, list[int]] = {}  # by channel: log time, place, log time, …
        self._schemas: list[bytes] = []  # records, for the summary, as all of these
        self._channels: list[bytes] = []
        self._chunks = bytearray()
        self._chunk_count = 0
        self._attachments = bytearray()
        self._attachment_count = 0
        self._counts: dict[int, int] = {}  # messages by channel, in chunks that are written
        self._start = 0  # log time of the earliest message in them [ns]
        self._end = 0
        self._write(_MAGIC + _record(_HEADER, _text(profile) + _text(library)))

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Make a schema known; its number."""
        number = len(self._schemas) + 1
        body = struct.pack("<H", number) + _text(name) + _text(encoding)
        self._schemas.append(_record(_SCHEMA, body + struct.pack("<I", len(data)) + data))
        self._append(self._schemas[-1])
        return number

    def channel(self, name: str, encoding: str, schema: int) -> int:
        """Make a channel known; its number."""
        number = len(self._channels) + 1
        body = struct.pack("<HH", number, schema) + _text(name) + _text(encoding)
        self._channels.append(_record(_CHANNEL, body + struct.pack("<I", 0)))  # no metadata
        self._append(self._channels[-1])
        self._indices[number] = []
        self._counts[number] = 0
        return number

    def message(self, channel: int, when: int, sequence: int, data: bytes) -> None:
        """Append one message of Unix time ``when`` [ns]."""
        length = _MESSAGE_BODY + len(data)
        self._indices[channel] += (when, self._filled)
        self._parts += (_MESSAGE_HEAD.pack(_MESSAGE, length, channel, sequence, when, when), data)
        self._filled += 9 + length
        if self._filled > self._chunk:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Write the messages that are waiting for their chunk to fill."""
        indices = {channel: index for channel, index in self._indices.items() if index}
        if not indices:
            return
        start = min(min(index[::2]) for index in indices.values())
        end = max(max(index[::2]) for index in indices.values())
        data = b"".join(self._parts)
        packed = self._compress(data)
        sizes = struct.pack("<QQQI", start, end, len(data), zlib.crc32(data))
        body = sizes + _text(_COMPRESSION) + struct.pack("<Q", len(packed)) + packed
        record = _record(_CHUNK, body)
        place, length = self.size, len(record)
        messages, offsets = [], []
        behind = place + length
        for channel, index in indices.items():
            body = struct.pack(f"<HI{len(index)}Q", channel, 8 * len(index), *index)
            messages.append(_record(_MESSAGE_INDEX, body))
            offsets.append(struct.pack("<HQ", channel, behind))
            behind += len(messages[-1])
        self._write(b"".join((record, *messages)))
        self._chunks += _record(
            _CHUNK_INDEX,
            struct.pack("<QQQQI", start, end, place, length, 10 * len(offsets))
            + b"".join(offsets)
            + struct.pack("<Q", behind - place - length)
            + _text(_COMPRESSION)
            + struct.pack("<QQ", len(packed), len(data)),
        )
        self._start = min(self._start, start) if self._chunk_count else start
        self._end = max(self._end, end)
        self._chunk_count += 1
        for channel, index in indices.items():
            self._counts[channel] += len(index) // 2
            index.clear()
        self._parts.clear()
        self._filled = 0

    @property
    def messages(self) -> int:
        """How many are in the file."""
        return sum(self._counts.values())

    def attachment(self, when: int, name: str, media_type: str, data: bytes) -> None:
        """Put a file beside the messages."""
        told = struct.pack("<QQ", when, when)
        body = told + _text(name) + _text(media_type) + struct.pack("<Q", len(data)) + data
        body += struct.pack("<I", zlib.crc32(body))
        record = _record(_ATTACHMENT, body)
        place = struct.pack("<QQ", self.size, len(record)) + told + struct.pack("<Q", len(data))
        self._attachments += _record(_ATTACHMENT_INDEX, place + _text(name) + _text(media_type))
        self._attachment_count += 1
        self._write(record)

    def finish(self) -> None:
        """Write what is left and the summary."""
        self.end_chunk()
        self._write(_record(_DATA_END, struct.pack("<I", 0)))
        groups = (
            (_SCHEMA, b"".join(self._schemas)),
            (_CHANNEL, b"".join(self._channels)),
            (_STATISTICS, self._statistics()),
            (_CHUNK_INDEX, bytes(self._chunks)),
            (_ATTACHMENT_INDEX, bytes(self._attachments)),
        )
        start = place = self.size
        offsets = []
        for opcode, records in groups:
            if records:
                place_and_length = struct.pack("<BQQ", opcode, place, len(records))
                offsets.append(_record(_SUMMARY_OFFSET, place_and_length))
            place += len(records)
        summary = b"".join(records for _, records in groups) + b"".join(offsets)
        footer = struct.pack("<BQQQ", _FOOTER, 20, start, place)
        checksum = zlib.crc32(summary + footer)
        self._write(summary + footer + struct.pack("<I", checksum) + _MAGIC)

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._file.flush()  # a chunk at a time: what counts as written is
        self.size += len(data)

    def _append(self, record: bytes) -> None:
        self._parts.append(record)
        self._filled += len(record)

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", *each) for each in self._counts.items())
        told = (
            *(sum(self._counts.values()), len(self._schemas), len(self._channels)),
            *(self._attachment_count, 0, self._chunk_count, self._start, self._end),
        )
        return _record(_STATISTICS, struct.pack("<QHIIIIQQI", *told, len(counts)) + counts)
