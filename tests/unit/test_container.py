"""MCAP files as `recordings.container` writes them, read by the mcap package's own reader."""

from __future__ import annotations

import io
import struct
import zlib
from typing import Any

import numpy as np
from mcap.reader import SeekingReader, make_reader
from mcap.records import Chunk, DataEnd, MessageIndex
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from softfinger.tools.recordings.container import Container

CHUNK = 20_000
SECOND = 10**9


def pieces(count: int = 3000) -> list[tuple[int, int, int, bytes]]:
    """Channel, time, sequence and data of messages on two channels, not all in order."""
    rng = np.random.default_rng(3)
    return [
        (1 + (k % 7 == 0), SECOND * (k + int(rng.integers(-3, 4)) + 10), k, b'{"a":%d}' % k * 4)
        for k in range(count)
    ]


def ours(messages: list[tuple[int, int, int, bytes]]) -> bytes:
    file = io.BytesIO()
    container = Container(file, "softfinger", "a library", CHUNK)
    container.channel("one", "json", container.schema("first", "jsonschema", b"{}"))
    container.attachment(5, "settings", "application/json", b'{"x":1}')
    container.channel("two", "json", container.schema("zweites: ä", "jsonschema", b"{ }"))
    for channel, when, sequence, data in messages:
        container.message(channel, when, sequence, data)
    container.finish()
    assert container.size == len(file.getvalue())
    return file.getvalue()


def theirs(messages: list[tuple[int, int, int, bytes]]) -> bytes:
    file = io.BytesIO()
    writer = Writer(file, chunk_size=CHUNK)
    writer.start(profile="softfinger", library="a library")
    schema = writer.register_schema("first", "jsonschema", b"{}")
    writer.register_channel("one", "json", schema)
    writer.add_attachment(5, 5, "settings", "application/json", b'{"x":1}')
    schema = writer.register_schema("zweites: ä", "jsonschema", b"{ }")
    writer.register_channel("two", "json", schema)
    for channel, when, sequence, data in messages:
        writer.add_message(channel, when, data, when, sequence)
    writer.finish()  # type: ignore[no-untyped-call]
    return file.getvalue()


def summary(content: bytes) -> Any:
    found = SeekingReader(io.BytesIO(content), validate_crcs=True).get_summary()
    assert found is not None
    return found


def test_the_summary_is_the_one_that_the_mcap_package_writes() -> None:
    messages = pieces()
    mine, reference = summary(ours(messages)), summary(theirs(messages))
    assert mine.statistics == reference.statistics
    assert mine.statistics.message_count == len(messages)
    assert mine.schemas == reference.schemas
    assert mine.channels == reference.channels
    assert len(mine.chunk_indexes) == len(reference.chunk_indexes) > 5
    for ours_, theirs_ in zip(mine.chunk_indexes, reference.chunk_indexes, strict=True):
        assert ours_.message_start_time == theirs_.message_start_time
        assert ours_.message_end_time == theirs_.message_end_time
        assert ours_.uncompressed_size == theirs_.uncompressed_size
        assert ours_.message_index_offsets.keys() == theirs_.message_index_offsets.keys()
    [mine_attached] = mine.attachment_indexes
    [reference_attached] = reference.attachment_indexes
    assert mine_attached == reference_attached


def test_every_record_of_the_data_is_the_one_that_the_mcap_package_writes() -> None:
    messages = pieces()

    def records(content: bytes) -> tuple[list[Any], list[MessageIndex]]:
        found: list[Any] = []
        indices = []  # of the channels of one chunk, which may stand in any order
        for record in StreamReader(io.BytesIO(content), validate_crcs=True).records:
            if isinstance(record, MessageIndex):
                indices.append(record)
                continue
            found.append(record)
            if isinstance(record, DataEnd):
                break
        return found, sorted(indices, key=lambda each: each.channel_id)

    mine, indices = records(ours(messages))
    assert (mine, indices) == records(theirs(messages))
    assert len(mine) > len(messages)
    assert len(indices) > 10


def test_checksums_hold() -> None:
    content = ours(pieces())
    footer = struct.pack("<BQ", 0x02, 20)
    begin = content.rindex(footer)
    start, _, checksum = struct.unpack("<QQI", content[begin + 9 : begin + 29])
    assert checksum == zlib.crc32(content[start : begin + 25])
    reader = StreamReader(io.BytesIO(content), emit_chunks=True)
    chunks = [each for each in reader.records if isinstance(each, Chunk)]
    assert all(each.uncompressed_crc for each in chunks)


def test_the_index_leads_to_each_message() -> None:
    messages = pieces()
    reader = make_reader(io.BytesIO(ours(messages)))
    found = [
        (channel.id, message.log_time, message.sequence, message.data)
        for _, channel, message in reader.iter_messages(["two"])
    ]
    wanted = [each for each in messages if each[0] == 2]
    assert found == sorted(wanted, key=lambda each: each[1])
    assert len(found) > 400
    [attachment] = reader.iter_attachments()
    assert (attachment.name, attachment.data) == ("settings", b'{"x":1}')


def test_a_file_without_messages_is_whole() -> None:
    file = io.BytesIO()
    Container(file, "softfinger", "a library", CHUNK).finish()
    found = summary(file.getvalue())
    assert found.statistics is not None
    assert found.statistics.message_count == 0
    assert not found.chunk_indexes


def test_large_numbers_and_data() -> None:
    large = 2**64 - 1
    messages = [(1, large, 2**32 - 1, b"x" * 10 * CHUNK), (1, 0, 0, b"")]
    found = summary(ours(messages))
    assert (found.statistics.message_start_time, found.statistics.message_end_time) == (0, large)
    assert found.statistics.channel_message_counts == {1: 2, 2: 0}
