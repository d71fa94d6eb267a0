"""Test that untrusted files are rejected quickly, with a one-line message and little memory."""

import base64
import json
import os
import resource
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import lz4.frame
import numpy as np
import pytest
import zstandard

from softfinger.daemon.control.envelope import Envelope
from softfinger.daemon.errors import RecordingError, SettingsError, SoftfingerError
from softfinger.daemon.perception.calibration_file import load_calibration
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.recordings.export import CsvTable, export
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.record import recover
from tests.harness.tactile import read_frames

ROOM = 200e6  # number of bytes by which the address space may grow


@pytest.fixture(autouse=True)
def little_memory() -> Iterator[None]:
    """Limit the available memory."""
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (int(mapped + ROOM), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def envelope(path: Path) -> object:
    return Envelope(Settings().changed(control={"envelope": str(path)}))


READERS: dict[str, Callable[[Path], object]] = {
    "profile": load,
    "map": envelope,
    "calibration": load_calibration,
    "frames": lambda path: read_frames(path, 1.0, 100.0),
}


def fifo(path: Path) -> None:
    os.mkfifo(path)


def zeros(path: Path) -> None:
    path.symlink_to("/dev/zero")


def comments(path: Path) -> None:
    path.write_text("# nothing\n" * 3_000_000)


@pytest.mark.timeout(120)  # timeout [s] that suffices on a busy machine
@pytest.mark.parametrize("make", [fifo, zeros, comments])
@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_special_files_are_reported(tmp_path, make, read):
    path = tmp_path / "named"
    make(path)
    with pytest.raises(SoftfingerError) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


PROFILES = {
    "a hex integer": "loop.rate = 0x" + "f" * 200_000,
    "a key of 50,000 parts": ".".join(["a"] * 50_000) + " = 1",
    "a table of 50,000 parts": "[" + " . ".join(['"a"'] * 50_000) + "]",
    "20,000 keys": "\n".join(f"x{k} = 1" for k in range(20_000)),
    "50,000 wrong values": f"scene.fingers = [{'1,' * 50_000}]",
    "arrays in arrays": f"a = {'[' * 100_000}",
}


@pytest.mark.timeout(120)  # timeout [s] that suffices on a busy machine
@pytest.mark.parametrize("text", PROFILES.values(), ids=PROFILES)
def test_a_malformed_profile_is_reported_quickly_and_briefly(tmp_path, text):
    path = tmp_path / "my.toml"
    path.write_text(text)
    with pytest.raises(SettingsError) as caught:
        load(path)
    assert len(str(caught.value)) < 4000


def begin(file: IO[bytes], frames: int) -> None:
    """Write the header of an array that contains the given number of frames."""
    shape = {"descr": "<u2", "fortran_order": False, "shape": (frames, 44, 44)}
    np.lib.format.write_array_header_1_0(file, shape)


def claiming(path: Path) -> None:
    """Write a short array file whose header states a size of 3.5 TiB."""
    with path.open("wb") as file:
        begin(file, 10**9)
        file.write(bytes(100))


def holes(path: Path) -> None:
    with path.open("wb") as file:
        begin(file, 10**6)
        file.truncate(file.tell() + 2 * 44 * 44 * 10**6)


def packed(path: Path, method: int = zipfile.ZIP_DEFLATED, *, honest: bool = True) -> None:
    """Write an archive with 20 MB of zeros; if not ``honest``, the header states more data."""
    with zipfile.ZipFile(path, "w", method) as archive, archive.open("frames.npy", "w") as file:
        begin(file, 5_000 if honest else 10**9)
        for _ in range(20 if honest else 1):
            file.write(bytes(1 << 20))


FRAMES: dict[str, tuple[str, Callable[[Path], object]]] = {
    "a header of 3.5 TiB": ("a.npy", claiming),
    "4 GB of holes": ("a.npy", holes),
    "an archive of zeros": ("a.npz", packed),
    "an archive that claims": ("a.npz", lambda path: packed(path, honest=False)),
    "one line": ("a.asf", lambda path: path.write_text("1," * 8_000_000)),
    "a header that goes on": ("a.asf", lambda path: path.write_text("1,1,1,1,1,1\n" * 400_000)),
    "a row that goes on": (
        "a.asf",
        lambda path: path.write_text("ROWS 4\nCOLS 4\nASCII_DATA\n" + "1," * 8_000_000),
    ),
    "by another compression": ("a.npz", lambda path: packed(path, zipfile.ZIP_BZIP2, honest=False)),
}


@pytest.mark.timeout(120)  # timeout [s] that suffices on a busy machine
@pytest.mark.parametrize(("name", "make"), FRAMES.values(), ids=FRAMES)
def test_frames_beyond_the_end_of_the_file_are_reported(tmp_path, name, make):
    make(tmp_path / name)
    with pytest.raises(
        RecordingError,
        match=r"the file contains less data|suspiciously large|unsupported compression|"
        r"an ASCII_DATA line|expected 4",
    ):
        read_frames(tmp_path / name, 1.0, 100.0)


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
    """Return a finger's frame of 4096² cells, which takes 45 MB in base64."""
    data = base64.b64encode(bytes(2 * 4096 * 4096)).decode()
    fields = {"finger": "left", "unix": 1e9, "rows": 4096, "cols": 4096, "data": data}
    return channel("hand/tactile/left") + message(json.dumps(fields).encode())


def recording_of_holes(path: Path) -> None:
    path.write_bytes(head())
    os.truncate(path, 4 << 30)


def chunks_of_holes(path: Path) -> None:
    """Write 4 GB of chunks as a sparse file that contains only the beginning of each chunk."""
    with path.open("wb") as file:
        file.write(head())
        for _ in range(256):
            empty = record(7, bytes(9 << 20))  # Readers skip this record.
            packed = chunk("", empty, len(empty))
            file.write(packed[:100])
            file.seek(len(packed) - 100, os.SEEK_CUR)
        file.truncate()


SMALL, LARGE = message(b"{}") * 100_000, bytes(70 << 20)
# Functions that return the file's content after its header, or that write the whole file
BOMBS: dict[str, Callable[[], bytes] | Callable[[Path], None]] = {
    "zstd": lambda: squeezed(LARGE),
    "zstd that claims little": lambda: squeezed(LARGE, 1000),
    "zstd that says nothing": lambda: squeezed(LARGE, 1000, False),
    "lz4": lambda: chunk("lz4", lz4.frame.compress(LARGE), 1 << 20),
    "many chunks": lambda: squeezed(SMALL) * 400,
    "a frame of 4096²": lambda: squeezed(frame_of_zeros()),
    "lists": lambda: squeezed(message(b"[" + b"[]," * 2_000_000 + b"[]]")),
    "channels": lambda: squeezed(channel("hand/state") * 200_000),
    "topics": lambda: squeezed(
        b"".join(channel(f"hand/{k}", k) + message(b"{}") for k in range(9999))
    ),
    "maps in maps": lambda: squeezed(message(b'{"a":' * 990 + b"1" + b"}" * 990)),
    "50,000 fields": lambda: squeezed(
        message(json.dumps({str(k): k for k in range(50_000)}).encode()) + message(b"{}") * 10_000
    ),
    "holes": recording_of_holes,
    "chunks of holes": chunks_of_holes,
    "another compression": lambda: chunk("br", b"abcd", 1000),
    "a record of 4 GB": lambda: struct.pack("<BQ", 6, 4 << 30),
}


@pytest.fixture(params=BOMBS.values(), ids=BOMBS.keys())
def bomb(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "a.mcap"
    if request.param in (recording_of_holes, chunks_of_holes):
        request.param(path)
    else:
        path.write_bytes(head() + request.param())
    return path


@pytest.mark.timeout(300)
def test_a_decompression_bomb_is_reported_in_one_line(bomb):
    told: list[str] = []
    recording = Recording(bomb, told.append)
    export(recording, bomb.parent, CsvTable, recording.topics)
    assert len(told) == 1
    assert recording.total < 30_000, "too many messages were read"
    assert not told[0].count("\n")
    recover(bomb)
    assert Recording(bomb).check()
