"""`Recording`: an MCAP file's summary, and its messages in the order in which they came.

`read_recording` gives its states as NumPy columns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softfinger.daemon.errors import RecordingError
from softfinger.tools.extras import require
from softfinger.tools.recordings.channels import ENCODING, PROFILE, Converter, from_json, topic_of

if TYPE_CHECKING:
    from mcap.records import Chunk, McapRecord
    from mcap.summary import Summary
    from numpy.typing import NDArray

_RECORD_LIMIT = 256 * 1024 * 1024  # bytes; our own chunks are a thousandth of it


def read_recording(path: str | Path) -> dict[str, NDArray[Any]]:
    """Return a recording's states as one array a field, in the order in which they came.

    The names are those of `hand/state`, nested ones with a dot (``left.force``); ``t`` is the time
    from the first state on [s]. ``pandas.DataFrame(read_recording("run.mcap"))`` takes it as it is.
    Raises RecordingError for a file that is no recording or holds no state.
    """
    from softfinger.daemon.client.records import read, to_columns
    from softfinger.daemon.wire.schema import STATE, HandState

    recording = Recording(Path(path))
    states = [read(HandState, message) for _, message in recording.messages({STATE})]
    if not states:
        raise RecordingError(f"{path}: no {STATE.decode()} in it")
    columns = to_columns(states)
    return {"t": (columns["mono_ns"] - columns["mono_ns"][0]) * 1e-9, **columns}


class Recording:
    """A recording that exists. Raises RecordingError when it is none.

    ``counts`` messages by channel, and ``start`` and ``end`` [Unix s] (NaN when empty) come from
    the summary at the file's end. A file without one, as a killed recorder leaves it, is
    ``truncated``: it is read through once instead. Damaged chunks are left out. ``say`` is called
    once with what is wrong with the file, as soon as it is known.
    """

    def __init__(self, path: Path, say: Callable[[str], None] | None = None) -> None:
        require("record")
        self.path = path
        self.truncated = False
        self.damage = ""  # what is wrong with it, as far as it was read
        self._say = say
        self.counts: dict[str, int] = {}
        self.start = math.nan
        self.end = math.nan
        self.chunks = 0
        self._first = 0  # log time of the earliest message [ns]
        self._names: dict[int, str] = {}  # of the channels, by number
        try:
            self.size = path.stat().st_size
            if self.size == 0:
                raise RecordingError(f"{path}: empty")
            summary = self._summary()
        except OSError as error:
            raise RecordingError(f"{path}: {error.strerror}") from None
        if summary is None:
            self.truncated = True
            self._scan()
            if not self.damage:
                self._damaged(None)
        else:
            self._take(summary)

    @property
    def duration(self) -> float:
        """Time from the first message to the last [s]; 0 when empty."""
        return 0.0 if math.isnan(self.start) else self.end - self.start

    @property
    def total(self) -> int:
        """Messages of all channels."""
        return sum(self.counts.values())

    @property
    def topics(self) -> list[bytes]:
        """The topics that it has messages of."""
        return sorted({topic_of(name) for name, count in self.counts.items() if count})

    def count(self, topic: bytes) -> int:
        """Return the messages of one topic."""
        return sum(n for name, n in self.counts.items() if topic_of(name) == topic)

    def messages(
        self,
        topics: Collection[bytes] | None = None,
        start: float = -math.inf,
        end: float = math.inf,
        progress: Callable[[int], None] | None = None,
    ) -> Iterator[tuple[bytes, dict[str, Any]]]:
        """Yield topic and map of each message, as it came off the wire, from ``start`` to ``end``
        [s].

        Times count from the recording's first message. ``progress`` is called with the bytes read
        so far. A truncated file ends where its sound part ends; damaged chunks and messages that
        don't fit their topic are left out.
        """
        import orjson
        from mcap.records import Message

        loads = orjson.loads
        begin = self._first + int(start * 1e9) if math.isfinite(start) else 0
        finish = self._first + int(end * 1e9) if math.isfinite(end) else 2**63
        selected: dict[int, tuple[bytes, Converter]] = {}
        for number, name in self._names.items():
            topic = topic_of(name)
            if topics is None or topic in topics:
                selected[number] = topic, from_json(topic)
        for chunk in self._chunks(progress):
            if chunk.message_end_time < begin or chunk.message_start_time > finish:
                continue
            for record in self._records(chunk):
                if not isinstance(record, Message) or record.channel_id not in selected:
                    continue
                if not begin <= record.log_time <= finish:
                    continue
                topic, convert = selected[record.channel_id]
                try:
                    message = convert(loads(record.data))
                except (ValueError, TypeError, AttributeError) as error:
                    self._damaged(error)
                    continue
                yield topic, message

    def _chunks(self, progress: Callable[[int], None] | None = None) -> Iterator[Chunk]:
        from mcap.records import Chunk, DataEnd
        from mcap.stream_reader import StreamReader

        with self.path.open("rb") as file:
            reader = StreamReader(file, emit_chunks=True, record_size_limit=_RECORD_LIMIT)
            try:
                for record in reader.records:
                    if isinstance(record, Chunk):
                        if progress is not None:
                            progress(file.tell())
                        yield record
                    elif isinstance(record, DataEnd):
                        return
            except Exception as error:
                self._damaged(error)

    def _records(self, chunk: Chunk) -> list[McapRecord]:
        """A chunk's records; none where it is damaged."""
        from mcap.stream_reader import breakup_chunk

        try:
            return breakup_chunk(chunk, validate_crc=True)
        except Exception as error:  # the format's, the compression's and more kinds
            self._damaged(error)
            return []

    def check(self) -> bool:
        """Read every chunk; whether the file is whole and sound."""
        for chunk in self._chunks():
            self._records(chunk)
        return not self.truncated and not self.damage

    def _damaged(self, error: Exception | None) -> None:
        first = not self.damage
        usual = "its end is missing" if self.truncated else "a chunk can't be read"
        # What the format's reader says of a wrong length or checksum helps nobody.
        self.damage = self.damage or (str(error) if type(error) is ValueError else "") or usual
        if first and self._say is not None:
            what = "cut short" if self.truncated else "damaged"
            self._say(f"{self.path}: {what} ({self.damage}); what is sound in it is read")

    def _summary(self) -> Summary | None:
        from mcap.exceptions import EndOfFile, InvalidMagic
        from mcap.reader import SeekingReader

        with self.path.open("rb") as file:
            magic = file.read(8)
            if magic[:1] != b"\x89" or magic[1:5] != b"MCAP":
                raise RecordingError(f"{self.path}: not an MCAP file")
            file.seek(0)
            try:
                reader = SeekingReader(file, record_size_limit=_RECORD_LIMIT)
                header = reader.get_header()
                if header.profile != PROFILE:
                    raise RecordingError(
                        f"{self.path}: profile {header.profile!r}, expected {PROFILE!r}: "
                        "not a recording of this stream"
                    )
                summary = reader.get_summary()
                if summary is not None and summary.statistics is not None:
                    return summary
            except (InvalidMagic, EndOfFile):
                pass  # cut short: no summary
            except RecordingError:
                raise
            except Exception as error:
                self.truncated = True
                self._damaged(error)
        return None

    def _take(self, summary: Summary) -> None:
        statistics = summary.statistics
        assert statistics is not None
        for number, channel in summary.channels.items():
            if channel.message_encoding == ENCODING:
                self._names[number] = channel.topic
                self.counts[channel.topic] = statistics.channel_message_counts.get(number, 0)
        self.chunks = statistics.chunk_count
        if statistics.message_count:
            self._first = statistics.message_start_time
            self.start = self._first * 1e-9
            self.end = statistics.message_end_time * 1e-9

    def _scan(self) -> None:
        from mcap.records import Channel, Message

        names = self._names
        start, end = 2**63, 0
        for chunk in self._chunks():
            self.chunks += 1
            for record in self._records(chunk):
                if isinstance(record, Message) and record.channel_id in names:
                    name = names[record.channel_id]
                    self.counts[name] = self.counts.get(name, 0) + 1
                    start, end = min(start, record.log_time), max(end, record.log_time)
                elif isinstance(record, Channel) and record.message_encoding == ENCODING:
                    names[record.id] = record.topic
        if end:
            self._first = start
            self.start, self.end = start * 1e-9, end * 1e-9
