"""Test the bytes, the timing and the faults of the emulated tactile board on a pty."""

import os
import select

import numpy as np
import pytest

from softfinger.daemon.simulation.emulator.tactile_board import (
    ENCODERS,
    FrameWriter,
    TactileBoard,
    encode_flexitac,
)
from softfinger.daemon.tactile.flexitac import FlexiTacDecoder
from softfinger.daemon.types import Frame
from tests.conftest import until

ROWS, COLS = 8, 6
SIZE = ROWS * COLS + 2


class Source:
    """Frame source controlled by the test."""

    def __init__(self) -> None:
        self.frame: Frame | None = None

    def latest(self) -> Frame | None:
        return self.frame

    def make(self, seq: int) -> Frame:
        counts = np.full((ROWS, COLS), seq % 150, np.uint16)
        self.frame = Frame(seq, 0.0, 0.0, True, counts)
        return self.frame


class Client:
    """Client of a board."""

    def __init__(self, path: str) -> None:
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    def read(self) -> bytes:
        parts = []
        while True:
            try:
                parts.append(os.read(self.fd, 65536))
            except BlockingIOError:
                return b"".join(parts)

    def expect(self, size: int) -> bytes:
        """Wait for ``size`` bytes, which the kernel may deliver with a delay."""
        got = b""
        while len(got) < size:
            assert select.select([self.fd], [], [], 60.0)[0], f"only {len(got)} of {size} bytes"
            got += os.read(self.fd, size - len(got))
        return got


def board(source: Source) -> TactileBoard:
    return TactileBoard(source, ENCODERS["flexitac"], seed=4)


def test_each_frame_is_sent_once_and_decoded():
    source = Source()
    made = board(source)
    client = Client(made.path)
    decoder = FlexiTacDecoder(ROWS, COLS)
    made.service()
    assert made.sent == 0
    for k in range(5):
        source.make(k + 1)
        made.service()
        made.service()
        decoder.feed(client.expect(SIZE), 0.0)
    decoded = decoder.settle()
    assert np.array_equal(decoded.data, np.full((ROWS, COLS), 5))
    assert decoder.counters()["frames"] == made.sent == 5
    os.close(client.fd)
    made.unplug()


@pytest.mark.parametrize("cells", [48, 1024, 44 * 44, 128 * 128])
def test_without_a_reader_only_whole_frames_are_dropped(cells):
    writer = FrameWriter()
    rng = np.random.default_rng(0)
    frame = rng.bytes(cells)
    # The kernel's count of unread bytes lags.
    sent: list[bool] = []
    until(lambda: sent.append(writer.send(frame)) or writer.dropped >= 150)
    assert writer.dropped == sent.count(False)
    assert len(frame) * sent.count(True) < 100_000
    client = Client(writer.path)
    got = b""
    while len(got) < cells * sent.count(True):
        writer.flush()
        got += client.expect(1) + client.read()
    assert got == frame * sent.count(True)
    assert client.read() == b""
    assert writer.send(frame)  # The board sends again once its output is read.
    os.close(client.fd)
    writer.unplug()


def test_client_bytes_are_consumed_without_echo():
    made = board(Source())
    client = Client(made.path)
    os.write(client.fd, b"\x03abc\n" * 100)
    made.hear()
    assert client.read() == b""
    os.close(client.fd)
    made.unplug()


@pytest.mark.parametrize("kind", ["noisy", "saturated", "zero"])
def test_bytes_on_the_line_during_faults(kind):
    source = Source()
    made = board(source)
    client = Client(made.path)
    made.faults[kind] = 1.0
    for k in range(40):
        source.make(k)
        made.service()
        data = client.read()
        if kind == "noisy":
            assert len(data) > SIZE
        else:
            assert data == encode_flexitac(np.full((ROWS, COLS), 255 * (kind == "saturated")))
    os.close(client.fd)
    made.unplug()
