"""``softfinger view --web`` in a real browser: the picture has the hand in every panel."""

from __future__ import annotations

import re
import select
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger.tools.viewing.planar import COLOURS
from tests.conftest import until
from tests.harness.daemon_process import SOFTFINGER, Running, ask
from tests.harness.headless_browser import Browser, browser_path

Picture = NDArray[np.uint8]
Region = tuple[float, float, float, float]  # left, right, top, bottom, as shares of the picture

WIDTH, HEIGHT = 1400, 900
LEFT_MAP: Region = (0.0, 0.25, 0.06, 0.46)
HAND: Region = (0.27, 0.73, 0.06, 0.46)
RIGHT_MAP: Region = (0.75, 1.0, 0.06, 0.46)
LANDSCAPE: Region = (0.0, 0.31, 0.5, 0.96)
FORCE: Region = (0.32, 0.66, 0.52, 0.73)
ENERGY: Region = (0.32, 0.66, 0.76, 0.96)
TICK: Region = (0.67, 1.0, 0.5, 0.68)
MODE: Region = (0.67, 1.0, 0.69, 0.8)
EVENTS: Region = (0.67, 1.0, 0.84, 0.96)
GREEN = (0, 158, 115)  # the tick's work

# A hand that sits out a test machine's stalls: what is looked at is its picture.
PATIENT = """
servos.watchdog = 0.0
safety.frame_age_hold = 100.0
safety.frame_age_fault = 300.0
loop.rate = 100.0
"""


def part(picture: Picture, region: Region) -> Picture:
    left, right, top, bottom = region
    height, width = picture.shape[:2]
    return picture[int(top * height) : int(bottom * height), int(left * width) : int(right * width)]


def share(picture: Picture, region: Region, colour: tuple[int, int, int], apart: int = 40) -> float:
    """Share of a region's pixels that have nearly this colour."""
    distance = np.abs(part(picture, region).astype(int) - colour).max(axis=-1)
    return float((distance <= apart).mean())


def missing(picture: Picture) -> list[str]:
    """What should be in the picture of a hand that turns its object, and is not."""
    found = {}
    for name, region in (("left", LEFT_MAP), ("right", RIGHT_MAP)):
        pixels = part(picture, region).astype(int)
        hot = (pixels[..., 0] > 200) & (pixels[..., 1] > 90) & (pixels[..., 2] < 120)
        found[f"{name} tip's pressure"] = hot.mean() > 0.01
        found[f"{name} tip's footprint"] = share(picture, region, (255, 255, 255)) > 0.002
        found[f"{name} tip's rim"] = share(picture, region, COLOURS[name], 80) > 0.0015
        found[f"{name} finger"] = share(picture, HAND, COLOURS[name]) > 0.01
        found[f"{name} force"] = share(picture, FORCE, COLOURS[name]) > 0.001
        found[f"{name} energy"] = share(picture, ENERGY, COLOURS[name]) > 0.001
        found[f"{name} trail"] = share(picture, LANDSCAPE, COLOURS[name]) > 0.0003
    found["object"] = share(picture, HAND, GREEN) > 0.002
    found["wanted force"] = share(picture, FORCE, (140, 140, 140), 12) > 0.0005
    ramp = {"shallow": (42, 55, 110), "middle": (38, 130, 140), "deep": (150, 202, 102)}
    for name, colour in ramp.items():
        found[f"{name} energies"] = share(picture, LANDSCAPE, colour, 25) > 0.01
    found["tick"] = share(picture, TICK, GREEN) > 0.001
    strip = part(picture, MODE).astype(int)
    found["mode"] = (strip.max(axis=-1) - strip.min(axis=-1) > 60).mean() > 0.02
    ground = np.median(part(picture, EVENTS).reshape(-1, 3), axis=0)
    text = np.abs(part(picture, EVENTS) - ground).max(axis=-1) > 60
    found["events"] = text.any(axis=1).mean() > 0.2  # lines of text
    return [name for name, there in found.items() if not there]


@pytest.mark.parametrize("ground", [(0, 0, 0), (20, 22, 30), (255, 255, 255)])
def test_an_empty_page_has_nothing_of_it(ground: tuple[int, int, int]) -> None:
    empty = np.full((HEIGHT, WIDTH, 3), ground, dtype=np.uint8)
    absent = missing(empty)
    assert len(absent) >= 18
    assert {"left finger", "right force", "object", "middle energies", "events"} <= set(absent)


@pytest.mark.skipif(browser_path() is None, reason="no Chromium on this machine")
def test_every_panel_shows_the_hand(
    start: Callable[..., Running],
    profile: Callable[[str], Path],
    addresses: tuple[str, str],
    tmp_path: Path,
) -> None:
    daemon = start("--config", str(profile(PATIENT)))
    words = ["view", "--web", "--no-browser", "--rate", "5", "--address", addresses[0]]
    view = subprocess.Popen(
        [*SOFTFINGER, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    path = browser_path()
    assert path is not None
    assert view.stdout is not None
    browser = None
    try:
        found = re.search(r"http://127\.0\.0\.1:\d+/", view.stdout.readline())
        assert found is not None
        # A browser that draws on the processor takes all of it: it comes when there is all to see.
        assert ask(addresses[1], "arm")["ok"]
        assert ask(addresses[1], "grasp", force=10.0)["ok"]
        until(lambda: ask(addresses[1], "status")["mode"] == "holding")
        browser = Browser(path, tmp_path / "profile", WIDTH, HEIGHT)
        browser.open(found[0])
        angle = 0.1
        deadline = time.monotonic() + 300.0
        absent = missing(np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8))  # not seen so far
        while True:
            picture = browser.picture()
            absent = [each for each in missing(picture) if each in absent]
            if not absent or time.monotonic() > deadline:
                break
            angle = -angle
            ask(addresses[1], "rotate", angle=angle)  # refused while it still turns
            select.select([], [], [], 0.5)
        if absent:
            from PIL import Image

            Image.fromarray(picture).save(tmp_path / "seen.png")
        assert not absent, f"{absent} not in {tmp_path / 'seen.png'}"
        # Nothing was asked of another machine, but for what the page's policy kept back.
        foreign = [url for url in browser.requests if not url.startswith("http://127.0.0.1:")]
        assert len(foreign) <= browser.blocked.count("csp")
        assert any(url.endswith("re_viewer_bg.wasm") for url in browser.requests)
    finally:
        if browser is not None:
            browser.close()
        view.terminate()
        _, error = view.communicate(timeout=120)
    assert view.returncode == 0, error
    assert "states shown" in error
    assert daemon.end() == 0
