"""``softfinger view`` in its own window, on a display that is drawn on the processor."""

from __future__ import annotations

import os
import re
import select
import shutil
import signal
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.harness.daemon_process import SOFTFINGER, Running
from tests.process.test_view_browser import HEIGHT, PATIENT, WIDTH, Picture, missing

_SOFTWARE = list(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"))


class Display:
    """A virtual X display. Without the Composite extension, or the window stays transparent."""

    def __init__(self, folder: Path) -> None:
        read, write = os.pipe()
        words = ["Xvfb", "-displayfd", str(write), "-screen", "0", f"{WIDTH}x{HEIGHT}x24"]
        words += ["-extension", "Composite", "-nolisten", "tcp", "-fbdir", str(folder)]
        self._process = subprocess.Popen(words, pass_fds=(write,), stderr=subprocess.DEVNULL)
        os.close(write)
        with os.fdopen(read) as told:
            self.name = f":{told.readline().strip()}"
        self._file = folder / "Xvfb_screen0"

    def picture(self) -> Picture:
        """What is on the display: [HEIGHT, WIDTH, 3]. The file is a window dump (xwd)."""
        data = self._file.read_bytes()
        header = struct.unpack(">25I", data[:100])
        begin, stride = header[0] + 12 * header[19], header[12]
        pixels = np.frombuffer(data, np.uint8, stride * HEIGHT, begin)
        return pixels.reshape(HEIGHT, stride // 4, 4)[:, :WIDTH, 2::-1].copy()

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(60)


@pytest.fixture
def display(tmp_path: Path) -> Iterator[Display]:
    folder = tmp_path / "display"
    folder.mkdir()
    display = Display(folder)
    yield display
    display.close()


@pytest.mark.skipif(
    not (shutil.which("Xvfb") and _SOFTWARE), reason="no Xvfb with software Vulkan (Mesa's lvp)"
)
def test_the_window_shows_the_hand_and_reaches_no_other_machine(
    start: Callable[..., Running],
    profile: Callable[[str], Path],
    addresses: tuple[str, str],
    tmp_path: Path,
    display: Display,
) -> None:
    daemon = start("--config", str(profile(PATIENT)))
    view = subprocess.Popen(
        [*SOFTFINGER, "view", "--rate", "5", "--address", addresses[0]],
        env={**os.environ, "DISPLAY": display.name, "XDG_DATA_HOME": str(tmp_path)},
        stderr=subprocess.PIPE,
        text=True,
    )
    assert view.stderr is not None
    try:
        deadline = time.monotonic() + 120.0
        absent = missing(np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8))
        foreign = set()
        while absent and time.monotonic() < deadline:
            picture = display.picture()
            absent = [each for each in missing(picture) if each in absent]
            for process in [psutil.Process(view.pid), *psutil.Process(view.pid).children()]:
                ends = [each.raddr.ip for each in process.net_connections("inet") if each.raddr]
                foreign |= set(ends) - {"127.0.0.1", "::1"}
            select.select([], [], [], 0.5)
        if absent:
            from PIL import Image

            Image.fromarray(picture).save(tmp_path / "seen.png")
        assert not absent, f"{absent} not in {tmp_path / 'seen.png'}"
        assert not foreign
        view.send_signal(signal.SIGTERM)
        assert view.wait(120) == 0
        assert re.search(r"\d+ states shown", view.stderr.read())
    finally:
        view.kill()
        view.wait(60)
        view.stderr.close()
    assert daemon.end() == 0
