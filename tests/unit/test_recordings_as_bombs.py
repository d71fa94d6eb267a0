"""Recordings that unpack to far more than they are end in a line, soon and in little memory."""

from __future__ import annotations

import base64
import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from softfinger.tools.recordings.export import CsvTable, export
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.record import recover
from tests.unit.test_files_from_strangers import little_memory as little_memory  # a fixture

MAGIC = b"\x89MCAP0\r\n"


def text(words: str | bytes) -> bytes:
    words = words.encode() if isinstance(words, str) else words
    return struct.pack("<I", len(words)) + words


def record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def channel(topic: str, number: int = 1) -> bytes:
    return record(4, struct.pack("<HH", number, 0) + text(topic) + text("json") + text(b""))


def message(data: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", 1, 0, 10**18, 10**18) + data)


def chunk(method: str, packed: bytes, size: int, crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", 10**18, 10**18, size, crc) + text(method)
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


def squeezed(inside: bytes, size: int | None = None, named: bool = True) -> bytes:
    packed = zstandard.ZstdCompressor(9, write_content_size=named).compress(inside)
    return chunk("zstd", packed, len(inside) if size is None else size, zlib.crc32(inside))


def head() -> bytes:
    return MAGIC + record(1, text("softfinger") + text("")) + squeezed(channel("hand/state"))


def frame_of_zeros() -> bytes:
    """A finger's frame of 4096² cells, 45 MB of base64."""
    data = base64.b64encode(bytes(2 * 4096 * 4096)).decode()
    fields = {"finger": "left", "unix": 1e9, "rows": 4096, "cols": 4096, "data": data}
    return channel("hand/tactile/left") + message(json.dumps(fields).encode())


def holes(path: Path) -> None:
    path.write_bytes(head())
    os.truncate(path, 4 << 30)


def chunks_of_holes(path: Path) -> None:
    """4 GB of records in chunks that are holes but for their beginnings."""
    with path.open("wb") as file:
        file.write(head())
        for _ in range(256):
            empty = record(7, bytes(9 << 20))  # passed over
            begin = chunk("", empty, len(empty))
            file.write(begin[:100])
            file.seek(len(begin) - 100, os.SEEK_CUR)
        file.truncate()


SMALL, LARGE = message(b"{}") * 100_000, bytes(70 << 20)
BOMBS: dict[str, Callable[[Path], object]] = {
    "zstd": lambda path: path.write_bytes(head() + squeezed(LARGE)),
    "zstd that claims little": lambda path: path.write_bytes(head() + squeezed(LARGE, 1000)),
    "zstd that says nothing": lambda path: path.write_bytes(head() + squeezed(LARGE, 1000, False)),
    "lz4": lambda path: path.write_bytes(head() + chunk("lz4", lz4.frame.compress(LARGE), 1 << 20)),
    "many chunks": lambda path: path.write_bytes(head() + squeezed(SMALL) * 400),
    "a frame of 4096²": lambda path: path.write_bytes(head() + squeezed(frame_of_zeros())),
    "lists": lambda path: path.write_bytes(
        head() + squeezed(message(b"[" + b"[]," * 2_000_000 + b"[]]"))
    ),
    "channels": lambda path: path.write_bytes(head() + squeezed(channel("hand/state") * 200_000)),
    "topics": lambda path: path.write_bytes(
        head() + squeezed(b"".join(channel(f"hand/{k}", k) + message(b"{}") for k in range(9999)))
    ),
    "maps in maps": lambda path: path.write_bytes(
        head() + squeezed(message(b'{"a":' * 990 + b"1" + b"}" * 990))
    ),
    "50,000 fields": lambda path: path.write_bytes(
        head()
        + squeezed(
            message(json.dumps({str(k): k for k in range(50_000)}).encode())
            + message(b"{}") * 10_000
        )
    ),
    "holes": holes,
    "chunks of holes": chunks_of_holes,
    "a record of 4 GB": lambda path: path.write_bytes(head() + struct.pack("<BQ", 6, 4 << 30)),
}


@pytest.fixture(params=BOMBS.values(), ids=BOMBS.keys())
def bomb(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    request.param(tmp_path / "a.mcap")
    return tmp_path / "a.mcap"


@pytest.mark.timeout(300)
@pytest.mark.usefixtures("little_memory")
def test_a_bomb_is_told_in_a_line(bomb: Path) -> None:
    told: list[str] = []
    recording = Recording(bomb, told.append)
    export(recording, bomb.parent, CsvTable, recording.topics)
    assert len(told) == 1
    assert recording.total < 30_000, "messages, which take time"
    assert not told[0].count("\n")
    recover(bomb)
    assert Recording(bomb).check()
