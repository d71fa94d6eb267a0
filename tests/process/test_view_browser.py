"""The page of ``softfinger view`` in a real browser: what it shows, and what its buttons do."""

import math
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from softfinger import Hand
from softfinger.tools.terminal.feed import MEANINGS
from softfinger.tools.viewing.planar import COLOURS
from tests.conftest import until
from tests.harness.daemon_process import PATIENCE
from tests.harness.daemon_process import ask as command
from tests.harness.headless_browser import Browser, browser_path
from tests.harness.recorded_hand import record_hand
from tests.harness.viewed import Viewed

pytestmark = [
    pytest.mark.extended,
    pytest.mark.skipif(browser_path() is None, reason="no Chromium on this machine"),
]

LEASE = 10.0  # s
PATIENT = "\n".join(f"{key} = {value}" for key, value in PATIENCE.items())
# The fraction of a canvas's pixels that nearly have a colour.
FRACTION = """((name, colour) => {
  const canvas = document.querySelector(`.${name} canvas`);
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let count = 0;
  for (let k = 0; k < data.length; k += 4)
    count += data[k + 3] > 200 && colour.every((value, c) => Math.abs(data[k + c] - value) < 30);
  return 4 * count / data.length;
})"""


class Page:
    """The browser's page, and what a test does there."""

    def __init__(self, browser: Browser) -> None:
        self.browser = browser

    def open(self, url: str) -> None:
        """Open, and wait for the first picture."""
        self.browser.open(url)
        until(lambda: self("document.body?.dataset.seq"))

    def __call__(self, script: str) -> Any:
        return self.browser.evaluate(script)

    def text(self, selector: str) -> str:
        return str(self(f"document.querySelector('{selector}')?.textContent"))

    def click(self, selector: str) -> None:
        """Once it may be pressed."""
        button = f"document.querySelector('footer {selector}')"
        until(lambda: self(f"!!{button} && !{button}.disabled"))
        self(f"{button}.click()")

    def key(self, code: str, **named: Any) -> None:
        for kind in ("keyDown", "keyUp"):
            self.browser.ask("Input.dispatchKeyEvent", type=kind, code=code, **named)

    def fraction(self, panel: str, colour: tuple[int, int, int]) -> float:
        return float(self(f"{FRACTION}('{panel}', {list(colour)})"))

    def lag(self) -> float:
        """How far the page is behind the stream [s]."""
        return float(self("Date.now() / 1000 - picture.time"))


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    path = browser_path()
    browser = Browser(path, tmp_path / "profile")
    yield Page(browser)
    browser.close()


def test_every_button_brings_its_mode_and_a_lost_page_gives_the_hand_back(
    start, profile, addresses, page
):
    start("--config", str(profile(f"{PATIENT}\ncommands.lease = {LEASE}")))
    stream, commands = addresses
    with (
        Viewed("--address", f"{stream},{commands}", "--timeout", "60") as viewed,
        Hand(*addresses, timeout=60.0) as hand,
    ):
        page.open(viewed.commanding)

        def press(button: str, mode: str) -> None:
            page.click(button)
            until(lambda: page.text(".mode") == mode)
            assert hand.state().mode == mode

        press("[name=arm]", "armed")
        assert "page" in command(commands, "release", client="another")["error"]  # it commands
        press("[name=grasp]", "holding")
        assert hand.state().goal_force == pytest.approx(5.0)
        for name, colour in COLOURS.items():
            for panel, seen, least in (
                ("hand", colour, 0.002),
                ("plot", colour, 0.0005),
                ("landscape", colour, 0.0003),
                (name, (255, 255, 255), 0.001),  # the footprint
                (name, (132, 198, 74), 0.0005),  # high pressure
            ):
                until(lambda: page.fraction(panel, seen) > least)  # noqa: B023
        until(lambda: page.fraction("hand", (0, 158, 115)) > 0.001)  # the object
        page.click("[name=rotate]:last-of-type")
        hand.wait_for(lambda state: state.goal_angle > math.radians(4.0), 60.0)
        hand.wait_for(lambda state: state.mode == "holding", 60.0)
        page.click("[name=disarm]")
        until(lambda: "lets the object fall" in page.text(".reply"))
        press("[name=release]", "armed")
        page("document.querySelector('[name=grasp]').focus()")
        page.key("Space", key=" ", text=" ")
        hand.wait_for(lambda state: state.mode == "disarmed", 60.0)
        until(lambda: page.text(".reply") == "✓ stop: ok")  # and grasp was not pressed
        page.click("[name=tare]")
        until(lambda: page.text(".reply") == "✓ tare: ok")
        hand.collect(1.0)  # the frames of which the tare is the mean
        press("[name=arm]", "armed")
        press("[name=grasp]", "holding")
        until(lambda: page("Date.now() > asked + 3000"))  # else it counts as pressed again
        page.click("[name=disarm]")
        until(lambda: "press it again" in page.text(".reply"))
        press("[name=disarm]", "disarmed")
        press("[name=arm]", "armed")
        press("[name=stop]", "disarmed")
        press("[name=arm]", "armed")
        page.browser.open("about:blank")
        hand.collect(LEASE + 0.5)  # by the daemon's clock, with no news of the page
        assert command(commands, "release", client="another")["ok"]
        viewed.end()


def test_the_page_keeps_up_survives_sleep_and_reload_and_asks_nobody_else(page, fake):
    addresses = f"{fake.state_address},{fake.command_address}"
    where = ("--address", addresses, "--timeout", "60")
    fake.changes = {"mode": "fault", "fault": "<b>tip.force</b>: 31 N"}
    with Viewed(*where) as viewed:
        page.open(viewed.address)  # fills the browser's cache, as a second visit finds it
        assert "Watching" in page.text("footer")
        page("document.querySelector('summary').click()")
        explained = page("document.querySelector('details').innerText")
        assert not [each for each in sum(MEANINGS, ()) if each not in explained]
        until(lambda: page.text(".fault") == "<b>tip.force</b>: 31 N")
        page.key("Space", key=" ", text=" ")
        page("send('stop')")
        page.open(viewed.commanding)
        page.click("[name=clear]")
        until(lambda: page.text(".reply") == "✓ clear: ok")
        assert [each["command"] for each in fake.requests] == ["clear"]  # no stop without it
        until(lambda: page.lag() < 0.5)

        os.killpg(page.browser.process.pid, signal.SIGSTOP)
        asleep = fake.published
        until(lambda: fake.published > asleep + 1000)  # 10 s of the stream
        os.killpg(page.browser.process.pid, signal.SIGCONT)
        until(lambda: page.lag() < 0.5)
        page.click("[name=stop]")  # heard although the page's connection was given up meanwhile
        until(lambda: fake.requests[-1]["command"] == "stop")

        fake.silent.set()
        until(lambda: page("document.querySelector('[name=clear]').disabled"))
        assert not page("document.querySelector('[name=stop]').disabled")
        fake.silent.clear()

        page("location.reload()")
        until(lambda: page("performance.getEntriesByType('navigation')[0].type") == "reload")
        until(lambda: page("document.body?.dataset.seq"))
        page.click("[name=clear]")
        until(lambda: fake.requests[-1]["command"] == "clear")
        assert fake.requests[0]["client"] != fake.requests[-1]["client"]

        page.browser.resize(390, 844, 2)
        until(lambda: page("document.documentElement.scrollWidth") <= 390)
        edges = page(
            "(({left, right, bottom}) => [left, right, bottom])"
            "(document.querySelector('[name=stop]').getBoundingClientRect())"
        )
        assert 0 <= edges[0] < edges[1] <= 390
        assert edges[2] <= 844
        foreign = [
            url
            for url in page.browser.requests
            if not url.startswith((f"http://{viewed.host}/", f"ws://{viewed.host}/", "data:"))
        ]
        assert not foreign

        page.browser.open("data:text/html,another page")  # of an origin of its own
        until(lambda: page("location.protocol") == "data:")
        socket = f"new WebSocket('ws://{viewed.host}/pictures')"
        page(f"({socket}).onopen = event => window.came = event.type")
        page(f"({socket}).onerror = event => window.came = event.type")
        until(lambda: page("window.came"))
        assert page("window.came") == "error"
        viewed.end()


def test_a_recordings_slider_goes_to_its_place(page, tmp_path):
    path = tmp_path / "a.mcap"
    record_hand(path, {30: {"command": "arm"}, 60: {"command": "grasp", "force": 8.0}}, 2.0)
    with Viewed(str(path)) as viewed:
        page.open(viewed.address)
        until(lambda: page.text(".reply").startswith("2.0 of 2.0"))
        assert page("document.querySelector('[name=stop]')") is None
        assert page.text(".mode") == "holding"
        page("document.querySelector('#place').focus()")
        page.key("Home", key="Home", windowsVirtualKeyCode=36)
        until(lambda: page.text(".mode") == "disarmed")
        viewed.end()
