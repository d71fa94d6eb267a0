"""The FlexiTac backend on real ptys through pyserial."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import threading
import time
import tty
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import serial

from softfinger.daemon.clock import RealClock
from softfinger.daemon.errors import TactileError
from softfinger.daemon.profile.settings import TactileSettings
from softfinger.daemon.tactile.flexitac import FlexiTac
from softfinger.daemon.types import Frame
from tests.conftest import until
from tests.harness.tactile import why_not_open
from tests.unit.test_flexitac_decoder import CELLS, COLS, ROWS, frame, numbered

LATE = 1026 * 10 / 2e6 + 0.005  # s that 32 × 32 cells take on the wire, and the latency


class Board:
    """The far end of a pty, written to by the test; can stream in a thread of its own."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def send(self, data: bytes) -> None:
        while data:
            select.select([], [self.master], [])
            data = data[os.write(self.master, data) :]

    def stream(self, images: Callable[[int], bytes], period: float = 0.002) -> None:
        """Send the frames of images 0, 1, … until closed."""

        def run() -> None:
            k, rest = 0, b""
            os.set_blocking(self.master, False)
            while not self._stop.wait(period):
                rest = rest or images(k)
                with contextlib.suppress(OSError):  # full: nobody reads for the moment
                    rest = rest[os.write(self.master, rest) :]
                    k += not rest

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def still(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def close(self) -> None:
        self.still()
        for end in (self.master, self.slave):
            if end >= 0:
                os.close(end)
        self.master = self.slave = -1


@pytest.fixture
def own_threads() -> Callable[[], set[threading.Thread]]:
    """The threads of this test: others of this process may be a shared rig's."""
    before = set(threading.enumerate())
    return lambda: set(threading.enumerate()) - before


@pytest.fixture
def board() -> Iterator[Board]:
    board = Board()
    yield board
    board.close()


def sensor(path: str, rows: int = 32, cols: int = 32, timeout: float = 60.0) -> FlexiTac:
    tactile = TactileSettings(
        backend="flexitac", port=("/dev/none", path), rows=rows, cols=cols, open_timeout=timeout
    )
    return FlexiTac(tactile, RealClock(), 1)


def newest(tactile: FlexiTac) -> Frame:
    found = tactile.latest()
    assert found is not None
    return found


def test_frames_come_through_a_port_with_their_times(own_threads, board):
    board.stream(lambda k: frame(numbered(1, 1024, k)[0]))
    tactile = sensor(board.path)
    assert tactile.latest() is None
    tactile.open()
    first = newest(tactile)
    until(lambda: newest(tactile).seq >= first.seq + 20)
    now = newest(tactile)
    # A frame that was read alone; one with others behind it in the same read came earlier.
    until(lambda: (n := newest(tactile)).t_arrival - n.t_sample == pytest.approx(LATE))
    assert first.t_arrival <= now.t_arrival <= time.monotonic()
    assert len(set(now.data.ravel().tolist())) == 1
    counters = tactile.counters()
    assert counters["resyncs"] == counters["port_lost"] == 0
    tactile.close()
    assert len(own_threads()) == 1  # the board's


def test_a_frame_is_handed_over_while_the_line_is_quiet(board):
    tactile = sensor(board.path, ROWS, COLS)
    opener = threading.Thread(target=tactile.open)
    opener.start()
    until(lambda: tactile.counters()["bytes"] > 0 or _send(board, frame(bytes(CELLS)) * 2))
    opener.join()
    board.send(frame(b"\x07" * CELLS))  # nothing follows
    until(lambda: newest(tactile).data[0, 0] == 7)
    tactile.close()


def _send(board: Board, data: bytes) -> bool:
    board.send(data)
    return False


def test_a_missing_port_is_told(tmp_path):
    with pytest.raises(TactileError, match=r"tactile-left: no such port; is `softfinger emulate`"):
        sensor(str(tmp_path / "tactile-left")).open()


def test_a_path_that_is_no_port_is_told(tmp_path):
    path = tmp_path / "file"
    path.write_text("")
    with pytest.raises(TactileError, match="can't be opened as a serial port"):
        sensor(str(path)).open()


def test_a_busy_port_is_told(board):
    with (
        serial.Serial(board.path, 2_000_000, exclusive=True),
        pytest.raises(TactileError, match="busy: another program"),
    ):
        sensor(board.path).open()


def test_a_silent_port_is_told_with_its_name_and_the_timeout(own_threads, board):
    tactile = sensor(board.path, timeout=0.05)
    with pytest.raises(TactileError, match=rf"{board.path}: no byte came within 0\.05 s"):
        tactile.open()
    assert not own_threads()
    # And it can be opened once the board talks.
    board.stream(lambda k: frame(bytes(1024)))
    until(lambda: not why_not_open(tactile))


def test_bytes_without_a_marker_are_told(board):
    board.stream(lambda k: bytes(1024))
    until(lambda: "no marker AA 55" in why_not_open(sensor(board.path, timeout=0.1)))


def test_a_stream_that_turns_to_noise_gives_an_invalid_frame(board):
    rng = np.random.default_rng(0)
    board.stream(lambda k: frame(bytes(1024)) if k < 10 else rng.bytes(1000))
    tactile = sensor(board.path)
    tactile.open()
    until(lambda: not newest(tactile).valid)
    assert newest(tactile).data.shape == (32, 32)
    assert tactile.counters()["resyncs"] >= 1
    assert "AA 55" in tactile.error
    tactile.close()
