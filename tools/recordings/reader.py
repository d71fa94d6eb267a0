"""Read an MCAP file's summary, and its messages in order of arrival.

`Recording` is the reader, and `read_recording` returns the states as NumPy columns. The file may
have been written by any MCAP writer, and may contain other programs' channels. Sizes and counts
stated in the file are not trusted. The file's size on disk limits the memory use and the run time.
"""

from __future__ import annotations

import io
import math
import os
import struct
import zlib
from collections.abc import Callable, Collection, Generator, Iterator
from functools import cached_property
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO, Protocol

from softfinger.daemon.client.stream import read, to_columns
from softfinger.daemon.errors import RecordingError
from softfinger.daemon.own_files import SIZE_MAX, open_regular, unpacked_size_max
from softfinger.daemon.wire import schema
from softfinger.tools.extras import require
from softfinger.tools.recordings.channels import ENCODING, PROFILE, Converter, from_json, topic_of

if TYPE_CHECKING:
    from mcap.records import Chunk, Statistics
    from numpy.typing import NDArray

__all__ = ["Recording", "read_recording"]

_MESSAGE_SIZE_MAX = 1 << 20  # maximum message size [bytes]; the largest frame has 0.2 MB
# Settings include per-cell calibrations [bytes].
_SIZES_MAX = {schema.SETTINGS: 4 << 20}
_CHUNK_SIZE_MAX = 64 << 20  # maximum unpacked chunk size [bytes]; chunks usually take 1 to 8 MB
# Reading even a short record takes time, so each channel or message counts as at least this number
# of bytes.
_RECORD_SIZE_MIN = 512
_CHANNEL_COUNT_MAX = 64
_OTHERS_NAMED_MAX = 3  # maximum number of foreign channels that a message lists
_FIELD_COUNT_MAX = 500  # maximum number of fields per message
_HEADER, _FOOTER, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS, _DATA_END = 1, 2, 4, 5, 6, 11, 15
_RECORD = struct.Struct("<BQ")  # record header with kind and content size
_BEFORE_DATA = struct.Struct("<HIQQ")  # message header: channel, number, log time, publish time
_MAGIC = b"\x89MCAP0\r\n"
_END = struct.Struct("<BQQQI8s")  # footer and magic


def read_recording(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read a recording's states as one array per field, in order of arrival.

    Each array has the name of its `hand/state` field; names of nested fields contain a dot
    (``left.force``). The first array, ``t``, is the time since the recording's first message [s].
    Files written by ``softfinger export`` contain the same column ``t``.
    ``pandas.DataFrame(read_recording("run.mcap"))`` accepts the result.

    Raises RecordingError if the file is not a recording or does not contain states.
    """
    states = Recording(Path(path)).states()
    if not states["t"].size:
        raise RecordingError(f"{path}: the recording does not contain {schema.STATE.decode()}")
    return states


class MessageSource(Protocol):
    """Source of recorded messages, in a file or in memory; ``path`` appears in error messages."""

    path: Path

    def messages(
        self, topics: Collection[bytes] | None = None
    ) -> Iterator[tuple[bytes, dict[str, Any]]]:
        """Yield the topic and the map of each message in order; ``topics`` selects the topics."""


class Recording:
    """Reader for an existing recording. Raises RecordingError if the file is not a recording.

    The summary at the end of the file provides ``counts`` (messages per channel), ``start`` and
    ``end`` (Unix times [s]). In an empty recording, ``start`` and ``end`` are NaN. If the summary
    is incomplete, or if the file contains other programs' channels, the whole file is read once
    instead. ``truncated`` is True if the end of the file is missing, for example because the
    recorder was killed. Corrupted chunks are skipped. Messages on other programs' channels are
    ignored and counted in ``others``. ``say`` is called once for each kind of problem found.
    """

    def __init__(self, path: Path, say: Callable[[str], None] = lambda _: None) -> None:
        require("record")
        self.path = path
        self.truncated = False
        self.damage = ""  # description of the first defect found so far
        self._say = say
        self.counts: dict[str, int] = {}
        self.others: dict[str, int] = {}  # number of messages in each channel of other programs
        self.start = math.nan
        self.end = math.nan
        self._first = 0  # log time of the earliest message [ns]
        self._left = 0  # remaining number of bytes that may be unpacked
        self._names: dict[int, str] = {}  # maps channel numbers to channel names
        self._other_names: dict[int, str] = {}
        try:
            with open_regular(path) as file:
                self.size = os.fstat(file.fileno()).st_size
                if self.size == 0:
                    raise RecordingError(f"{path}: empty")
                self._profile = self._begin(file)
                statistics = self._summary(file)
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror}") from None
        if statistics is None or self._other_names:
            self._scan()
        else:
            self._take(statistics)
        if self.truncated and not self.damage:
            self._damaged(None)
        if self._profile != PROFILE and not self._names:
            damage = f"; {self.damage}" if self.damage else ""
            raise RecordingError(
                f"{path}: found the profile {self._profile!r} (channels: "
                f"{_listed(sorted(self._other_names.values()))}), expected the profile {PROFILE!r} "
                f"or channels of this stream, such as hand/state in JSON{damage}"
            )
        if self.others:
            self._say(
                f"{path}: skipped {sum(self.others.values())} messages on {len(self.others)} "
                f"channels from other programs ({_listed([*self.others])})"
            )

    @property
    def duration(self) -> float:
        """Time from the first to the last message [s], or 0 for an empty recording."""
        return 0.0 if math.isnan(self.start) else self.end - self.start

    @property
    def total(self) -> int:
        """Number of messages in all channels."""
        return sum(self.counts.values())

    @property
    def topics(self) -> list[bytes]:
        """Topics with at least one message."""
        return sorted({topic_of(name) for name, count in self.counts.items() if count})

    def count(self, topic: bytes) -> int:
        """Return the number of messages with this topic."""
        return sum(n for name, n in self.counts.items() if topic_of(name) == topic)

    @cached_property
    def zero(self) -> int:
        """Time of the first message on the daemon's clock [ns], which is the origin of ``t``."""
        left = self._left  # `messages` changes this variable.
        for _, message in self.messages():
            mono, stamp = message.get("mono_ns"), message.get("timestamp")
            if isinstance(mono, int) and isinstance(stamp, float) and not message.get("again"):
                # A frame's mono_ns is the scan time, but its timestamp is the arrival time.
                delay = message.get("delay_s", 0.0)
                if not isinstance(delay, int | float) or not math.isfinite(stamp - delay):
                    continue
                after = stamp - self.start - delay
                self._left = left
                # The timestamp is a float with a resolution of 0.2 µs, so round to 1 µs.
                return mono - round(after * 1e6) * 1000
        return 0

    def time(self, message: dict[str, Any]) -> float:
        """Return a message's time, or a frame's scan time, since the first message [s]."""
        mono, stamp = message.get("mono_ns"), message.get("timestamp")
        if isinstance(mono, int):
            return (mono - self.zero) * 1e-9
        return stamp - self.start if isinstance(stamp, int | float) else math.nan

    def messages(
        self,
        topics: Collection[bytes] | None = None,
        start: float = -math.inf,
        end: float = math.inf,
        progress: Callable[[int], None] | None = None,
    ) -> Generator[tuple[bytes, dict[str, Any]], None, None]:
        """Yield the topic and stream map of each message from ``start`` to ``end`` [s].

        Times are relative to the recording's first message. ``progress`` is called with the number
        of bytes read so far. A truncated file is read up to its first incomplete record. Corrupted
        chunks, and messages that do not match their topic, are skipped.
        """
        import orjson

        loads = orjson.loads
        begin = self._first + int(start * 1e9) if math.isfinite(start) else 0
        finish = self._first + int(end * 1e9) if math.isfinite(end) else 2**63
        selected: dict[int, tuple[bytes, Converter]] = {}
        for number, name in self._names.items():
            topic = topic_of(name)
            if topics is None or topic in topics:
                selected[number] = topic, from_json(topic)
        for channel, log_time, data in self._messages((begin, finish), progress):
            if channel not in selected or not begin <= log_time <= finish:
                continue
            topic, convert = selected[channel]
            try:
                if len(data) > _SIZES_MAX.get(topic, _MESSAGE_SIZE_MAX):
                    raise ValueError(f"a message of {len(data) >> 20} MB, which is too large")
                message = convert(_plain(loads(data)))
            except ValueError as error:
                self._damaged(error)
                continue
            except (TypeError, AttributeError):
                self._damaged(ValueError(f"an invalid {topic.decode()} message"))
                continue
            yield topic, message

    def states(
        self,
        start: float = -math.inf,
        end: float = math.inf,
        progress: Callable[[int], None] | None = None,
    ) -> dict[str, NDArray[Any]]:
        """Read the states as one array per field, with the time ``t``; see `read_recording`."""
        messages = self.messages([schema.STATE], start, end, progress)
        columns = to_columns(read(schema.HandState, message) for _, message in messages)
        return {"t": (columns["mono_ns"] - self.zero) * 1e-9, **columns}

    def _messages(
        self, times: tuple[int, int] = (0, 2**64), progress: Callable[[int], None] | None = None
    ) -> Iterator[tuple[int, int, bytes]]:
        """Yield the channel number, log time [ns] and data of each message; register new channels.

        Chunks outside ``times`` are skipped.
        """
        with open_regular(self.path) as file:
            file.seek(len(_MAGIC))
            self._left = unpacked_size_max(file)
            try:
                for kind, content in _records(file, (_CHANNEL, _MESSAGE, _CHUNK, _DATA_END)):
                    if kind == _DATA_END:
                        return
                    if kind == _CHUNK:
                        yield from self._messages_in(content, times)
                    elif (message := self._take_record(kind, content)) is not None:
                        yield message
                    if progress is not None:
                        progress(file.tell())
            except Exception as error:
                self._damaged(error)
            else:
                self._damaged(None)

    def _messages_in(
        self, content: bytes, times: tuple[int, int]
    ) -> Iterator[tuple[int, int, bytes]]:
        """Yield a chunk's messages, up to the first corrupted record."""
        chunk = _parsed("Chunk", content)
        self._count(chunk.uncompressed_size)
        if chunk.message_end_time < times[0] or chunk.message_start_time > times[1]:
            return
        try:
            data = _unpacked(chunk)
            for kind, content in _records(io.BytesIO(data), (_CHANNEL, _MESSAGE)):
                if (message := self._take_record(kind, content)) is not None:
                    yield message
        # Format errors and compression errors have no common exception class.
        except Exception as error:
            self._damaged(error)

    def _take_record(self, kind: int, content: bytes) -> tuple[int, int, bytes] | None:
        """Process a channel record or a message; return None for a channel record."""
        if kind == _CHANNEL:
            self._count(max(0, _RECORD_SIZE_MIN - len(content)))
            self._learn(content)
            return None
        channel, _, log_time, _ = _BEFORE_DATA.unpack_from(content)
        if channel not in self._other_names:
            self._count(max(0, _RECORD_SIZE_MIN - len(content)))
        return channel, log_time, content[_BEFORE_DATA.size :]

    def _count(self, unpacked: int) -> None:
        self._left -= unpacked
        if self._left < 0:
            raise ValueError("the unpacked data are suspiciously large for a file of this size")

    def _learn(self, content: bytes) -> None:
        channel = _parsed("Channel", content)
        name = channel.topic.removeprefix("/")
        known = topic_of(name) in schema.TOPICS
        # If softfinger wrote the file, an unknown topic means that a newer version wrote the file.
        if channel.message_encoding != ENCODING or not (known or self._profile == PROFILE):
            self._other_names[channel.id] = channel.topic
            return
        self._names[channel.id] = name if known else channel.topic
        if len(self._names) > _CHANNEL_COUNT_MAX:
            raise ValueError(f"more than {_CHANNEL_COUNT_MAX} channels")

    def check(self) -> bool:
        """Read all messages; return True if the file is complete and not corrupted."""
        for _ in self._messages():
            pass
        return not self.truncated and not self.damage

    def _damaged(self, error: Exception | None) -> None:
        first = not self.damage
        usual = "the end of the file is missing" if self.truncated else "a chunk can't be read"
        # The MCAP library's messages about lengths and checksums would not help the user.
        self.damage = self.damage or (str(error) if type(error) is ValueError else "") or usual
        if first:
            what = "cut short" if self.truncated else "damaged"
            self._say(f"{self.path}: {what} ({self.damage}); only the intact part is read")

    def _begin(self, file: BinaryIO) -> str:
        """Check the file's end; return the header's profile, or PROFILE if there is no header."""
        if file.read(5) != _MAGIC[:5]:
            raise RecordingError(f"{self.path}: not an MCAP file")
        file.seek(max(0, self.size - _END.size))
        end = file.read(_END.size)
        self.truncated = len(end) < _END.size or (end[0], end[-8:]) != (_FOOTER, _MAGIC)
        file.seek(len(_MAGIC))
        try:
            _, content = next(_records(file, (_HEADER,)))
            return str(_parsed("Header", content).profile)
        except Exception:
            self.truncated = True
            return PROFILE

    def _summary(self, file: BinaryIO) -> Statistics | None:
        """Return the summary's statistics, or None if statistics or channels are missing."""
        if self.truncated:
            return None
        try:
            file.seek(self.size - _END.size)
            start = _END.unpack(file.read(_END.size))[2]
            if start == 0:
                return None
            file.seek(start)
            found: Statistics | None = None
            for kind, content in _records(file, (_CHANNEL, _STATISTICS, _FOOTER)):
                if kind == _CHANNEL:
                    self._learn(content)
                elif kind == _STATISTICS:
                    found = _parsed("Statistics", content)
                else:
                    break
        except Exception as error:
            self.truncated = True
            self._damaged(error)
            return None
        known = self._names.keys() | self._other_names.keys()
        return None if found is None or found.channel_message_counts.keys() - known else found

    def _take(self, statistics: Statistics) -> None:
        for number, name in self._names.items():
            count = statistics.channel_message_counts.get(number, 0)
            self.counts[name] = self.counts.get(name, 0) + count
        if statistics.message_count:
            self._first = statistics.message_start_time
            self.start = self._first * 1e-9
            self.end = statistics.message_end_time * 1e-9

    def _scan(self) -> None:
        """Read all messages to determine their number and time range."""
        start, end = 2**64, -1
        for channel, log_time, _ in self._messages():
            if channel in self._names:
                name = self._names[channel]
                self.counts[name] = self.counts.get(name, 0) + 1
                start, end = min(start, log_time), max(end, log_time)
            else:
                name = self._other_names.get(channel, "a channel without a name")
                self.others[name] = self.others.get(name, 0) + 1
        if end >= 0:
            self._first = start
            self.start, self.end = start * 1e-9, end * 1e-9


def _listed(names: list[str]) -> str:
    more = ", …" if len(names) > _OTHERS_NAMED_MAX else ""
    return ", ".join(names[:_OTHERS_NAMED_MAX]) + more or "none"


def _records(file: IO[bytes], wanted: Collection[int]) -> Iterator[tuple[int, bytes]]:
    """Yield the kind and content of each record whose kind is in ``wanted``.

    For an overlong message, the content is only the message header. An incomplete record raises
    EOFError. A record of unknown type, or an overlong record that is not a message, raises
    ValueError.
    """
    while head := file.read(_RECORD.size):
        if len(head) < _RECORD.size:
            raise EOFError
        kind, length = _RECORD.unpack(head)
        if kind == 0:
            raise ValueError("a record of unknown type")
        if kind not in wanted:
            file.seek(length, os.SEEK_CUR)
            continue
        skipped = 0
        if length > SIZE_MAX and kind == _MESSAGE:
            length, skipped = _BEFORE_DATA.size, length - _BEFORE_DATA.size
        elif length > (_CHUNK_SIZE_MAX if kind == _CHUNK else SIZE_MAX):
            raise ValueError(f"a record of {length >> 20} MB, which is too large")
        content = file.read(length)
        if len(content) < length:
            raise EOFError
        file.seek(skipped, os.SEEK_CUR)
        yield kind, content


def _parsed(kind: str, content: bytes) -> Any:
    """Parse a record's content with the class ``kind`` of the mcap library."""
    from mcap import data_stream, records

    return getattr(records, kind).read(data_stream.ReadDataStream(io.BytesIO(content)))


def _plain(message: dict[str, Any]) -> dict[str, Any]:
    """Check that a map has few fields, no lists, and at most two levels of nested maps.

    Raises ValueError if the check fails, and AttributeError if ``message`` is not a map.
    """
    count, maps = 0, [message]
    for _ in range(3):
        values = [value for each in maps for value in each.values()]
        maps = [value for value in values if isinstance(value, dict)]
        count += len(values)
        if count > _FIELD_COUNT_MAX or list in map(type, values):
            break
    else:
        if not maps:
            return message
    raise ValueError("a message with more fields than any topic has")


def _unpacked(chunk: Chunk) -> bytes:
    """Unpack a chunk's records. Raises ValueError for an incorrect checksum or excessive size."""
    size, method = chunk.uncompressed_size, chunk.compression
    if size > _CHUNK_SIZE_MAX:
        raise ValueError(f"a chunk of {size >> 20} MB, which is too large")
    if method == "zstd":
        import zstandard

        if zstandard.frame_content_size(chunk.data) not in (-1, size):
            raise ValueError("a chunk that is larger than its header states")
        data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    elif method == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif method == "":
        data = chunk.data
    else:
        raise ValueError(f"a chunk compressed with {method[:20]!r}, expected zstd, lz4 or none")
    if len(data) != size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("a chunk that does not match its header")
    return data
