"""Run any tactile backend with known images, for the conformance tests."""

from __future__ import annotations

import select
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.clock import Clock, RealClock, VirtualClock
from softfinger.daemon.errors import TactileError
from softfinger.daemon.profile.settings import Settings, TactileSettings
from softfinger.daemon.simulation.emulator.tactile_board import ENCODERS, TactileBoard
from softfinger.daemon.simulation.faults import parse_faults
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.tactile.base import TactileSensor, make_sensor
from softfinger.daemon.tactile.frame_files import FrameRecording, load_recording
from softfinger.daemon.types import Frame
from tests.conftest import until

ROWS = COLS = 32
BACKENDS = ("simulated", "flexitac", "glove", "cobs", "replay")
SERIAL = ("flexitac", "glove", "cobs")
RATE = 200.0  # Hz


def read_frames(
    path: Path,
    pascal_per_count: float,
    rate: float,
    noise: float = 0.0,
    full_count: int = 65535,
) -> FrameRecording:
    """Read a recording with these tactile settings."""
    changes = {
        "pascal_per_count": pascal_per_count,
        "rate": rate,
        "noise": noise,
        "full_count": full_count,
    }
    return load_recording(path, TactileSettings().model_copy(update=changes))


def image(number: int) -> NDArray[np.uint16]:
    """Return a different, asymmetric image for each number."""
    cells = np.arange(ROWS * COLS, dtype=np.uint16).reshape(ROWS, COLS)
    return (cells * 7 + 3 * (cells // COLS) + number) % 160


class _Images:
    """Source of board frames that returns a new image at each call."""

    def __init__(self) -> None:
        self.number = 0
        self.sent: dict[int, NDArray[np.uint16]] = {}

    def latest(self) -> Frame:
        self.number += 1
        self.sent[self.number] = image(self.number)
        return Frame(self.number, self.number / RATE, 0.0, True, self.sent[self.number])


def why_not_open(sensor: TactileSensor) -> str:
    """Open the sensor; return its error message, or "" on success."""
    try:
        sensor.open()
    except TactileError as error:
        return str(error)
    sensor.close()
    return ""


class Rig:
    """A backend, together with the board, hand or recording that generates its frames."""

    def __init__(
        self, backend: str, folder: Path, fault: str = "", rows: int = ROWS, source: Any = None
    ) -> None:
        """Set up the backend.

        ``source`` generates the frames of a serial board. By default, each frame is a new image.
        """
        self.backend = backend
        self._stack = ExitStack()
        self._stop = threading.Event()
        self._unplug = threading.Event()
        tactile: dict[str, object] = {
            "backend": backend,
            "rows": rows,
            "cols": COLS,
            "rate": RATE,
            "open_timeout": 0.5 if rows != ROWS else 60.0,
        }
        self.clock: Clock = RealClock() if backend in SERIAL else VirtualClock()
        hand = None
        if backend in SERIAL:
            self.images = source or _Images()
            self.board = TactileBoard(self.images, ENCODERS[backend])
            self._faults = parse_faults([f"right:{fault}"] if fault else [], ())
            self._stack.callback(self.board.unplug)
            tactile["port"] = ("/dev/none", self.board.path)
            thread = threading.Thread(target=self._serve, daemon=True)
            thread.start()
            self._stack.callback(thread.join)
            self._stack.callback(self._stop.set)
        elif backend == "replay":
            file = folder / "run.npz"
            np.savez(file, frames=np.stack([image(k) for k in range(20)]))
            tactile["recording"] = ("", str(file))
        settings = Settings.model_validate({"tactile": tactile, "scene": {"fingers": ("right",)}})
        if backend == "simulated":
            hand = SimulatedHand(settings, self.clock.now())
        sensor = make_sensor(settings, self.clock, hand, 1)
        self.sensor = sensor
        self._stack.callback(sensor.close)

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def wait(self, condition: Callable[[Frame], object]) -> Frame:
        """Advance the time until a frame satisfies ``condition``."""

        def holds() -> bool:
            if not isinstance(self.clock, RealClock):
                self.clock.sleep_until(self.clock.now() + 0.5 / RATE)
            frame = self.sensor.latest()
            return frame is not None and bool(condition(frame))

        until(holds)
        return self.sensor.latest()

    def unplug(self) -> None:
        """Let the thread that serves the board's port unplug the board."""
        self._unplug.set()

    def _serve(self) -> None:
        t = 0.0
        while not self._stop.is_set():
            if self._unplug.is_set():
                self.board.unplug()
                return
            if select.select([self.board], [], [], 0.5 / RATE)[0]:
                self.board.hear()
            t += 1.0 / RATE
            while self._faults and self._faults[0].after < t:
                begun = self._faults.pop(0)
                self.board.faults[begun.kind] = begun.value
            self.board.service()
