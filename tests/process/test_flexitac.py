"""Test the FlexiTac backend on real ptys through pyserial."""

import errno
import termios
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import serial

from softfinger.daemon.clock import RealClock
from softfinger.daemon.errors import TactileError
from softfinger.daemon.profile.settings import TactileSettings
from softfinger.daemon.simulation.emulator.tactile_board import FrameWriter
from softfinger.daemon.tactile.flexitac import FlexiTac
from tests.conftest import until
from tests.harness.tactile import why_not_open
from tests.unit.test_flexitac_decoder import CELLS, COLS, ROWS, frame, numbered

LATE = 1026 * 10 / 2e6 + 0.02  # time to transmit 32 × 32 cells, plus the latency [s]


class Board(FrameWriter):
    """Port of a board, and a thread that sends the board's frames."""

    def __init__(self) -> None:
        super().__init__()
        self._stop = threading.Event()
        self._thread = threading.Thread()

    def stream(self, images: Callable[[int], bytes]) -> None:
        """Send images 0, 1, … as frames until the board is closed."""

        def run() -> None:
            k = 0
            while not self._stop.wait(0.002):
                k += self.send(images(k))

        self._thread = threading.Thread(target=run)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self.unplug()


@pytest.fixture
def own_threads() -> Callable[[], set[threading.Thread]]:
    """Return a function that lists the threads started in this test."""
    before = set(threading.enumerate())
    return lambda: set(threading.enumerate()) - before


@pytest.fixture
def board() -> Iterator[Board]:
    board = Board()
    yield board
    board.close()


def sensor(path: object, rows: int = 32, cols: int = 32, timeout: float = 60.0) -> FlexiTac:
    tactile = TactileSettings(
        backend="flexitac",
        port=("/dev/none", str(path)),
        rows=rows,
        cols=cols,
        open_timeout=timeout,
    )
    return FlexiTac(tactile, RealClock(), 1)


def test_frames_are_received_through_a_port_with_their_times(own_threads, board):
    board.stream(lambda k: frame(numbered(1, 1024, k)[0]))
    tactile = sensor(board.path)
    assert tactile.latest() is None
    tactile.open()
    first = tactile.latest()
    until(lambda: tactile.latest().seq >= first.seq + 20)
    now = tactile.latest()
    # Wait until a read returns a single frame. If a read returns several frames, the earlier frames
    # were delayed in the buffer.
    until(lambda: (n := tactile.latest()).t_arrival - n.t_sample == pytest.approx(LATE))
    assert first.t_arrival <= now.t_arrival <= time.monotonic()
    assert len(set(now.data.ravel().tolist())) == 1
    counters = tactile.counters()
    assert counters["resyncs"] == counters["port_lost"] == 0
    tactile.close()
    assert len(own_threads()) == 1  # Only the board's own thread remains.


def test_a_frame_is_delivered_before_the_next_one_arrives(board):
    tactile = sensor(board.path, ROWS, COLS)
    opener = threading.Thread(target=tactile.open)
    opener.start()
    until(lambda: board.send(frame(bytes(CELLS)) * 2) and tactile.counters()["bytes"] > 0)
    opener.join()
    until(lambda: board.send(frame(b"\x07" * CELLS)))  # No further bytes follow.
    until(lambda: tactile.latest().data[0, 0] == 7)
    tactile.close()


def test_a_port_that_cannot_be_opened_is_reported(tmp_path, board):
    missing, file = tmp_path / "tactile-left", tmp_path / "file"
    assert "tactile-left: port not found: start `softfinger emulate`" in why_not_open(
        sensor(missing)
    )
    file.write_text("")
    assert "can't be opened as a serial port" in why_not_open(sensor(file))
    with serial.Serial(board.path, 2_000_000, exclusive=True):
        assert "the port is in use by another program" in why_not_open(sensor(board.path))
    board.stream(lambda k: bytes(1024))
    assert "no AA 55 marker" in why_not_open(sensor(board.path, timeout=1.0))


def test_a_port_that_is_lost_while_it_is_opened_is_reported(board, monkeypatch):
    def lost(_port: object, _queue: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr(termios, "tcflush", lost)
    assert "can't be opened as a serial port" in why_not_open(sensor(board.path))


def test_a_silent_port_is_reported_with_its_name_and_time_out(own_threads, board):
    tactile = sensor(board.path, timeout=0.05)
    with pytest.raises(
        TactileError, match=rf"{board.path}: no data within tactile.open_timeout = 0\.05 s"
    ):
        tactile.open()
    assert not own_threads()
    # Once the board sends frames, the next attempt to open the port must succeed.
    board.stream(lambda k: frame(bytes(1024)))
    tactile.settings = tactile.settings.model_copy(update={"open_timeout": 60.0})
    assert why_not_open(tactile) == ""
