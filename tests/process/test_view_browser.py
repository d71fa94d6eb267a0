"""Test the contents and controls of the ``softfinger view`` page in a real browser."""

import math
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from softfinger import Hand
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.terminal.stream_state import GLOSSARY
from softfinger.tools.viewing.hand_drawing import COLOURS
from tests.conftest import until
from tests.harness.daemon_process import PATIENCE, softfinger
from tests.harness.daemon_process import ask as command
from tests.harness.fake_daemon import FakeDaemon
from tests.harness.headless_browser import Browser, browser_path
from tests.harness.recorded_hand import record_hand
from tests.harness.viewed import Viewed

pytestmark = [
    pytest.mark.extended,
    pytest.mark.skipif(browser_path() is None, reason="no Chromium on this machine"),
]

LEASE = 10.0  # s
SHIM = Path(__file__).parents[2] / "docs" / "iframe-worker.js"
PATIENT = "\n".join(f"{key} = {value}" for key, value in PATIENCE.items())
# Fraction of a canvas's pixels that have approximately the given colour.
FRACTION = """((selector, colour) => {
  const canvas = document.querySelector(`${selector} canvas`);
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let count = 0;
  for (let k = 0; k < data.length; k += 4)
    count += data[k + 3] > 200 && colour.every((value, c) => Math.abs(data[k + c] - value) < 30);
  return 4 * count / data.length;
})"""
# Visible text whose contrast is below the WCAG AA minimum (3 for large text, 4.5 for other text).
PALE = """(() => {
  const linear = part => part <= 10.31 ? part / 3294.6 : ((part / 255 + 0.055) / 1.055) ** 2.4;
  const parts = colour => colour.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
  const ground = element => {
    for (; element; element = element.parentElement) {
      const colour = parts(getComputedStyle(element).backgroundColor);
      if ((colour[3] ?? 1) > 0.99) return colour;
    }
  };
  const found = [];
  for (const element of document.body.querySelectorAll("*")) {
    const style = getComputedStyle(element), box = element.getBoundingClientRect();
    const text = [...element.childNodes].filter(node => node.nodeType === 3 && node.data.trim());
    if (!text.length || !box.width || style.visibility === "hidden") continue;
    if (["SCRIPT", "STYLE", "OPTION"].includes(element.tagName)) continue;
    const both = [light(parts(style.color)), light(ground(element))].sort((a, b) => b - a);
    const contrast = (both[0] + 0.05) / (both[1] + 0.05), size = parseFloat(style.fontSize);
    const large = size >= 24 || (size >= 18.7 && style.fontWeight >= 700);
    if (contrast < (large ? 3 : 4.5)) found.push(`${element.textContent}: ${contrast.toFixed(2)}`);
  }
  return found;
})()"""
# Headline numbers that are covered by the age label.
OVER_NUMBERS = """(() => {
  const age = document.querySelector(".headline .age").getBoundingClientRect();
  return [...document.querySelectorAll(".headline :is(h2, span, small):not(.age)")].filter(each => {
    const { left, right, top, bottom } = each.getBoundingClientRect();
    return left < age.right && right > age.left && top < age.bottom && bottom > age.top;
  }).map(each => each.textContent);
})()"""
# Buttons and fields that are covered or outside the window.
COVERED = """[...document.querySelectorAll("button, input, select")].filter(each => {
  if (!each.offsetWidth || each.closest("dialog")) return false;
  each.scrollIntoView({ block: "center" });
  const { left, right, top, bottom } = each.getBoundingClientRect();
  const there = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
  return left < 0 || right > innerWidth || !(there === each || each.contains(there));
}).map(each => each.outerHTML)"""


class Page:
    """The page in the browser, with the actions that tests perform on the page."""

    def __init__(self, browser: Browser) -> None:
        self.browser = browser

    def open(self, url: str) -> None:
        """Open an address and wait for the first picture."""
        self.browser.open(url)
        until(lambda: self("document.body?.dataset.seq"))

    def __call__(self, script: str) -> Any:
        return self.browser.evaluate(script)

    def text(self, selector: str) -> str:
        return str(self(f"document.querySelector('{selector}')?.textContent"))

    def click(self, selector: str) -> None:
        """Click an element once it is enabled."""
        button = f"document.querySelector('{selector}')"
        until(lambda: self(f"!!{button} && !{button}.disabled"))
        self(f"{button}.click()")

    def focus(self, selector: str) -> None:
        self(f"document.querySelector('{selector}').focus()")

    def key(self, code: str, key: str = "", **named: Any) -> None:
        for kind in ("keyDown", "keyUp"):
            self.browser.ask("Input.dispatchKeyEvent", type=kind, code=code, key=key, **named)

    def letter(self, key: str) -> None:
        self.key(f"Key{key.upper()}", key, text=key)

    def arrow(self, where: str) -> None:
        number = {"Left": 37, "Up": 38, "Right": 39, "Down": 40}[where]
        self.key(f"Arrow{where}", f"Arrow{where}", windowsVirtualKeyCode=number)

    def type(self, selector: str, text: str) -> None:
        """Replace a field's text and press Enter."""
        self(f"document.querySelector('{selector}').select()")
        self.browser.ask("Input.insertText", text=text)
        self.key("Enter", "Enter", text="\r")

    def mouse(self, kind: str, at: tuple[float, float], **named: Any) -> None:
        self.browser.ask("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], **named)

    def place(self, selector: str, across: float) -> tuple[float, float]:
        """Return an element's point at mid-height and at the fraction ``across`` of the width."""
        left, width, top, height = self(
            "(({left, width, top, height}) => [left, width, top, height])"
            f"(document.querySelector('{selector}').getBoundingClientRect())"
        )
        return left + across * width, top + 0.5 * height

    def fraction(self, selector: str, colour: tuple[int, int, int]) -> float:
        return float(self(f"{FRACTION}('{selector}', {list(colour)})"))

    def lag(self) -> float:
        """Return the age [s] of the picture on the page."""
        return float(self("Date.now() / 1000 - picture.time"))


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    path = browser_path()
    assert path is not None
    browser = Browser(path, tmp_path / "profile")
    browser.prefer("dark")
    yield Page(browser)
    browser.close()


def viewing(fake: FakeDaemon, *words: str, folder: Path | None = None) -> Viewed:
    where = f"{fake.state_address},{fake.command_address}"
    return Viewed("--address", where, "--timeout", "60", *words, folder=folder)


def forces(fake: FakeDaemon) -> list[float]:
    return [each["force"] for each in fake.requests if each["command"] == "grasp"]


# Contents


def test_every_button_reaches_its_mode_and_a_lost_page_frees_the_hand(
    start, profile, addresses, page
):
    start("--config", str(profile(f"{PATIENT}\ncommands.lease = {LEASE}")))
    stream, commands = addresses
    with (
        Viewed("--address", f"{stream},{commands}", "--timeout", "60") as viewed,
        Hand(*addresses, timeout=60.0) as hand,
    ):
        page.open(viewed.commanding)

        def mode_is(mode: str) -> None:
            until(lambda: page.text(".mode") == mode)
            assert hand.state().mode == mode

        def press(button: str, mode: str) -> None:
            page.click(button)
            mode_is(mode)

        press("[name=arm]", "armed")
        # The page holds the lease for commands.
        assert "page" in command(commands, "release", client="another")["error"]
        press("[name=grasp]", "holding")
        assert hand.state().goal_force == pytest.approx(5.0)
        page("document.querySelector('#more').open = true")
        for name, colour in COLOURS.items():
            if name == "goal":
                continue
            until(lambda: page.fraction(".hand", colour) > 0.001)  # noqa: B023
        for name in ("left", "right"):
            until(lambda: page.fraction(".plot", COLOURS[name]) > 0.0005)  # noqa: B023
            until(lambda: page.fraction(f".{name}", (255, 255, 255)) > 0.001)  # noqa: B023
            until(lambda: page.fraction(f".{name}", (132, 198, 74)) > 0.0005)  # noqa: B023
        until(lambda: page.fraction(".landscape", (88, 166, 255)) > 0.0001)
        until(lambda: page.text(".headline").count("±") == 4)
        page.click("[name=rotate]:last-of-type")
        hand.wait_for(lambda state: state.goal_angle > math.radians(4.0), 60.0)
        hand.wait_for(lambda state: state.mode == "holding", 60.0)
        modes = "[...document.querySelectorAll('.legend li')].map(each => each.dataset.mode)"
        until(lambda: {"holding", "rotating"} <= set(page(modes)))
        press("[name=release]", "armed")
        page.focus("[name=grasp]")
        page.key("Space", " ", text=" ")
        hand.wait_for(lambda state: state.mode == "disarmed", 60.0)
        until(lambda: page.text(".reply") == "✓ stop: ok")  # The button was not pressed.
        page.click("[name=tare]")
        until(lambda: page.text(".reply") == "✓ tare: ok")
        hand.collect(1.0)  # Collect frames for the tare to average.
        press("[name=arm]", "armed")
        press("[name=grasp]", "holding")
        page.click("[name=disarm]")
        until(lambda: page("document.querySelector('#sure').open"))
        page.click("#sure [value=no]")
        until(lambda: not page("document.querySelector('#sure').open"))
        assert hand.state().mode == "holding"
        page.click("[name=disarm]")
        press("#sure [value=disarm]", "disarmed")
        page("document.activeElement.blur()")
        for key, mode in (("a", "armed"), ("g", "holding"), ("r", "armed"), ("d", "disarmed")):
            page.letter(key)
            mode_is(mode)
        press("[name=arm]", "armed")
        press("[name=stop]", "disarmed")
        press("[name=arm]", "armed")
        page.browser.open("about:blank")
        # The daemon's clock keeps advancing even if the page sends no messages.
        hand.collect(LEASE + 0.5)
        assert command(commands, "release", client="another")["ok"]
        viewed.end()


def test_stale_data_are_marked(page, fake):
    with viewing(fake) as viewed:
        page.open(viewed.commanding)

        def old() -> set[str]:
            names = "[...document.querySelectorAll('.old')].map(each => each.className)"
            return set(" ".join(page(names)).split()) - {"old", "card"}

        assert page.text(".mode") == "holding"
        # A state becomes stale after at most 0.5 s.
        assert page("picture.patience.state + scene.period") <= 0.5
        until(lambda: not old())
        fake.dead.add("left")
        until(lambda: old() == {"left"})
        assert "s old" in page.text(".left .age")
        fake.dead.clear()
        until(lambda: not old())
        fake.silent.set()
        until(lambda: page.text(".mode") == "No stream")
        everything = {"left", "right", "hand", "plot", "headline", "landscape"}
        assert old() == everything
        assert page(OVER_NUMBERS) == []
        assert page("[...document.querySelectorAll('.old .age')].every(each => each.textContent)")
        assert page("getComputedStyle(document.querySelector('.mode')).backgroundColor") == (
            "rgb(198, 40, 40)"
        )
        until(lambda: page("document.querySelector('[name=release]').disabled"))
        assert not page("document.querySelector('[name=stop]').disabled")
        assert page(PALE) == []
        fake.silent.clear()
        until(lambda: page.text(".mode") == "holding" and not old())
        viewed.process.kill()
        until(lambda: old() == everything)
        until(lambda: "server does not respond" in page.text(".stream"))


def test_plots_have_axes_cursor_zoom_and_pause(page, fake):
    with viewing(fake) as viewed:
        page.open(viewed.address)
        until(lambda: page("past.rows.length") > 40)
        visible = "charts.filter(chart => !chart.plot.detail)"
        spans = page(f"{visible}.map(chart => [chart.high - chart.low, chart.plot.span])")
        assert len(spans) == 4
        assert all(shown >= least for shown, least in spans)
        scales = f"JSON.stringify({visible}.map(chart => [chart.low, chart.high]))"
        assert page(scales) == page(scales)
        assert page("view.label(view.range[1], 1)") == "now"
        assert page("view.label(view.range[1] - 5, 1)") == "−5 s"
        plot = ".plots figure:first-child canvas"
        page.mouse("mouseMoved", page.place(plot, 0.9))
        until(lambda: page("view.cursor") is not None)
        shown = page("charts[0].values[0].textContent")
        there = page("past.near(view.cursor)[charts[0].plot.lines[0].column]")
        assert shown == f"left {there:.1f} ± 0.05"
        assert page("charts[1].canvas.getAttribute('aria-label')").startswith("Object angle")
        white = (231, 234, 241)
        for k in (1, 2, 3, 4):
            until(lambda: page.fraction(f".plots figure:nth-child({k})", white) > 0.001)  # noqa: B023
        page.mouse("mouseMoved", (1, 1))
        until(lambda: page("view.cursor") is None)

        page.mouse("mouseMoved", page.place(plot, 0.6))
        page.mouse("mousePressed", page.place(plot, 0.6), button="left", clickCount=1)
        page.mouse("mouseMoved", page.place(plot, 0.9), button="left", buttons=1)
        page.mouse("mouseReleased", page.place(plot, 0.9), button="left", clickCount=1)
        until(lambda: page("view.end") is not None)
        assert 5.0 < page("view.span") < 8.0  # The view shows 30 % of 20 s, plus margins.
        assert page.text("#hold") == "Resume"
        # The labels are times of day.
        assert page("/^[0-9:.]+$/.test(view.label(view.range[0], 1))")
        page.click("#follow")
        assert page("[view.span, view.end]") == [20, None]
        page.mouse("mouseWheel", page.place(plot, 0.5), deltaX=0, deltaY=-100, modifiers=2)
        until(lambda: page("view.span") < 20)
        page("document.activeElement.blur()")
        page.letter("p")
        until(lambda: page.text("#hold") == "Resume")
        shown, seen = page("view.range"), page("picture.seq")
        until(lambda: page("picture.seq") > seen)
        assert page("view.range") == shown
        page.focus(".plots")
        page.arrow("Left")
        assert shown[0] < page("view.cursor") < shown[1]
        page.key("Escape", "Escape")
        until(lambda: page("[view.span, view.end, view.cursor]") == [20, None, None])
        assert page("scene.modes.includes('holding')")
        until(lambda: page.text(".legend") == "holding")
        for name in ("left", "right"):
            scale = page.text(f".{name} .scale")  # The scale adapts to noisy peaks.
            assert re.fullmatch(r"≤ 3[3-7]0 kPa", scale), scale
        viewed.end()


# Commands


def test_controls_follow_the_hand_and_the_last_value_is_always_sent(page, fake):
    fake.changes = {"goal_force": 9.0}
    with viewing(fake) as viewed:
        page.open(viewed.commanding)
        number, slider = "#force [type=number]", "#force [type=range]"

        def shows(force: float) -> bool:
            value = f"[...document.querySelectorAll('{number}, {slider}')].map(each => +each.value)"
            return bool(page(value) == [force, force])

        until(lambda: shows(9.0))
        fake.changes = {"goal_force": 12.0}  # Another client commands this force.
        until(lambda: shows(12.0))
        page.focus(slider)
        page.arrow("Right")
        until(lambda: forces(fake) == [12.5])
        fake.changes = {"goal_force": 12.5}
        until(lambda: page.text("#force output") == "✓ 12.5 N accepted")

        fake.deaf.set()  # The daemon is slow.
        for _ in range(8):
            page.arrow("Right")
        assert shows(16.5)
        assert "is being sent" in page.text("#force output")
        fake.deaf.clear()
        until(lambda: forces(fake)[-1] == 16.5)
        assert len(forces(fake)) <= 3  # The page sends few of the intermediate values.
        until(lambda: page.text("#force output") == "✓ 16.5 N accepted")
        fake.changes = {"goal_force": 16.5}
        until(lambda: page("settings.force.wanted") is None)
        assert shows(16.5)

        page.type(number, "7.3")
        until(lambda: forces(fake)[-1] == 7.3)
        fake.changes = {"goal_force": 7.3}
        until(lambda: page("settings.force.wanted") is None)
        fake.changes = {"goal_force": 11.0}  # Another client commands this force.
        until(lambda: page.text("#force output") == "" and shows(11.0))
        fake.changes = {"goal_force": 7.3}
        until(lambda: page("settings.force.value") == 7.3)
        page.type(number, "99")
        until(lambda: "bad" in page("document.querySelector('#force output').className"))
        assert forces(fake)[-1] == 7.3
        page.focus("body")
        page("document.activeElement.blur()")

        page.arrow("Left")  # The hand holds the object at 5°.
        until(lambda: fake.requests[-1]["command"] == "rotate")
        assert fake.requests[-1]["angle"] == pytest.approx(0.0, abs=1e-3)

        fake.replies["grasp"] = {"ok": False, "error": "grasp: too hot for that"}
        page.key("Equal", "+", text="+")
        until(lambda: page.text("#force output") == "✗ grasp: too hot for that")
        until(lambda: page("settings.force.wanted") is None)  # The page discards the refused force.
        del fake.replies["grasp"]
        until(lambda: page("document.querySelector('#force [type=number]').value") == "7.3")

        fake.deaf.set()
        for _ in range(2):
            page.key("Equal", "+", text="+")
        before = page("lanes.grasp.next !== null")
        page.key("Space", " ", text=" ")
        until(lambda: "was not sent: stop was sent first" in page.text("#force output"))
        assert before
        fake.deaf.clear()
        until(lambda: [each["command"] for each in fake.requests].count("stop") == 1)
        viewed.end()


def test_the_page_keeps_up_survives_sleep_and_reload_and_is_self_contained(page, fake):
    fake.changes = {"mode": "fault", "fault": "<b>tip.force</b>: 31 N"}
    with viewing(fake) as viewed:
        page.open(viewed.address)  # The browser caches the page.
        assert "Watching" in page.text("aside")
        page.click("#help")
        explained = page("document.querySelector('#explained').innerText")
        assert not [each for each in sum(GLOSSARY, ()) if each not in explained]
        page.click("#explained button")
        until(lambda: page.text(".fault") == "Fault: <b>tip.force</b>: 31 N")
        page.key("Space", " ", text=" ")
        page("send('stop')")
        page.open(viewed.commanding)
        page.click("[name=clear]")
        until(lambda: page.text(".reply") == "✓ clear: ok")
        # The page did not send a stop when it opened.
        assert [each["command"] for each in fake.requests] == ["clear"]
        until(lambda: page.lag() < 0.5)

        os.killpg(page.browser.process.pid, signal.SIGSTOP)
        asleep = fake.published
        # Wait for 10 s of states.
        until(lambda: fake.published > asleep + 1000)
        os.killpg(page.browser.process.pid, signal.SIGCONT)
        until(lambda: page.lag() < 0.5)
        rows = page("past.rows.map(row => row[0])")
        # The rows include the states that were published while the browser was suspended.
        assert rows == [*range(rows[0], rows[0] + len(rows))]
        page.click("[name=stop]")  # The page has reconnected.
        until(lambda: fake.requests[-1]["command"] == "stop")

        page("location.reload()")
        until(lambda: page("performance.getEntriesByType('navigation')[0].type") == "reload")
        until(lambda: page("document.body?.dataset.seq"))
        page.click("[name=clear]")
        until(lambda: fake.requests[-1]["command"] == "clear")
        assert fake.requests[0]["client"] != fake.requests[-1]["client"]
        foreign = [
            url
            for url in page.browser.requests
            if not url.startswith((f"http://{viewed.host}/", f"ws://{viewed.host}/", "data:"))
        ]
        assert not foreign

        page.browser.open("data:text/html,another page")  # a page with another origin
        until(lambda: page("location.protocol") == "data:")
        socket = f"new WebSocket('ws://{viewed.host}/pictures')"
        page(f"({socket}).onopen = event => window.came = event.type")
        page(f"({socket}).onerror = event => window.came = event.type")
        until(lambda: page("window.came"))
        assert page("window.came") == "error"
        viewed.end()


def test_the_record_button_writes_a_recording(page, fake, tmp_path):
    with viewing(fake, folder=tmp_path) as viewed:
        page.open(viewed.commanding)
        page.click("[name=record]")
        until(lambda: page.text("[name=record]").startswith("End recording"))
        (path,) = tmp_path.glob("softfinger-*.mcap")
        seen = fake.published
        until(lambda: fake.published > seen + 50)
        page.click("[name=record]")
        until(lambda: page.text("[name=record]") == "Record")
        assert Recording(path).count(b"hand/state") > 0
        assert not Recording(path).truncated
        page.click("[name=record]")  # The recording stops when the page's server exits.
        until(lambda: len(list(tmp_path.glob("softfinger-*.mcap"))) == 2)
        viewed.end()
        assert not any(Recording(each).truncated for each in tmp_path.glob("*.mcap"))


# Accessibility


def test_colours_labels_and_keys_are_accessible(page, fake):
    with viewing(fake) as viewed:
        page.open(viewed.commanding)
        page("document.querySelectorAll('details').forEach(each => each.open = true)")
        for preferred in ("light", "dark"):
            page.browser.prefer(preferred)
            until(lambda: page("document.documentElement?.dataset.theme") == preferred)  # noqa: B023
            fake.send_event("slip", "the object slips", "warning")
            fake.send_event("fault", "as a test has it", "error")
            until(lambda: "as a test has it" in page.text(".events"))
            assert page(PALE) == []
        page.click("#theme")
        until(lambda: page("document.documentElement?.dataset.theme") == "light")
        page.open(viewed.commanding)  # The browser stores the selected theme.
        assert page("document.documentElement?.dataset.theme") == "light"

        tree = page.browser.ask("Accessibility.getFullAXTree")["nodes"]
        controls = {"button", "slider", "spinbutton", "combobox", "checkbox", "img"}
        unnamed = [
            each
            for each in tree
            if each.get("role", {}).get("value") in controls
            and not each.get("name", {}).get("value")
        ]
        assert not unnamed
        order = []
        for _ in range(9):
            page.key("Tab", "Tab", windowsVirtualKeyCode=9)
            order.append(page("document.activeElement.name || document.activeElement.id"))
        assert order == [
            *("record", "theme", "help", "stop", "release", "disarm"),
            *("force-number", "", "grasp"),
        ]
        viewed.end()


def test_a_phone_opens_the_page_with_the_code_and_can_use_all_controls(page, fake):
    with viewing(fake, "--host", "127.0.0.2") as viewed:
        page.browser.resize(390, 844, 2)
        page.open(viewed.address)
        assert page("location.search").startswith("?token=")
        page("location.reload()")
        until(lambda: page("document.body?.dataset.seq"))
        until(lambda: page("document.documentElement?.scrollWidth ?? 1e9") <= 390)
        assert page(COVERED) == []
        left, right, top, bottom = page(
            "(({left, right, top, bottom}) => [left, right, top, bottom])"
            "(document.querySelector('.urgent').getBoundingClientRect())"
        )
        assert 0 <= left < right <= 390
        assert bottom <= 844
        assert bottom - top < 0.1 * 844
        small = (
            "[...document.querySelectorAll('aside button')]"
            ".filter(each => each.offsetHeight < 44).length"
        )
        assert page(small) == 0
        page.click("[name=stop]")
        until(lambda: fake.requests and fake.requests[-1]["command"] == "stop")
        page.browser.resize(1280, 800)
        assert page(COVERED) == []
        viewed.end()


# A recording


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record 2 s of the simulated hand, which grasps the object."""
    path = tmp_path_factory.mktemp("recorded") / "a.mcap"
    record_hand(path, {30: {"command": "arm"}, 60: {"command": "grasp", "force": 8.0}}, 2.0)
    return path


def test_a_recording_is_played(page, recorded):
    with Viewed(str(recorded)) as viewed:
        page.open(viewed.address)
        until(lambda: page.text("#clock") == "2.0 of 2.0 s")
        until(lambda: page.text("#playing") == "Play")
        assert page("document.querySelector('[name=stop]')") is None
        assert page.text(".mode") == "holding"
        until(lambda: page("scene.marks.length") == 3)
        # Colours for disarmed, grasping and holding.
        for colour in ((100, 109, 124), (158, 93, 0), (0, 122, 90)):
            until(lambda: page.fraction(".track", colour) > 0.001)  # noqa: B023
        page.focus("#place")
        page.key("Home", "Home", windowsVirtualKeyCode=36)
        until(lambda: page.text(".mode") == "disarmed")
        assert page("past.rows.every(row => row[1] - view.start < 0.5)")
        page("document.activeElement.blur()")
        page.key("Period", ".", text=".")
        until(lambda: page.text("#mark") == "disarmed → armed")
        page.arrow("Right")
        until(lambda: page("picture.place.position") > 1.0)
        # In one script, because the next picture sets the value to the current speed.
        page("Object.assign(document.querySelector('#speed'), { value: '0.1' }).onchange()")
        page.key("Space", " ", text=" ")
        until(lambda: page("picture.place.playing && picture.place.speed === 0.1"))
        page.key("Space", " ", text=" ")
        until(lambda: not page("picture.place.playing"))
        assert page(PALE) == []
        page.browser.resize(390, 844, 2)
        until(lambda: page("document.documentElement?.scrollWidth ?? 1e9") <= 390)
        assert page(COVERED) == []
        viewed.end()


def test_a_saved_recording_is_played_from_its_file(page, recorded, tmp_path):
    path = tmp_path / "a.html"
    assert softfinger("view", recorded, "--save", path).returncode == 0
    page.open(path.as_uri())
    until(lambda: page.text("#clock") == "2.0 of 2.0 s")
    until(lambda: page.text("#playing") == "Play")
    assert page.text(".mode") == "holding"
    assert page("past.rows.length") == pytest.approx(19, abs=1)
    page.focus("#place")
    page.key("Home", "Home", windowsVirtualKeyCode=36)
    until(lambda: page.text(".mode") == "disarmed")
    # The value appears even during a pause.
    until(lambda: page.text(".headline p span") == "0.0")
    assert page("past.rows.every(row => row[1] - view.start < 0.5)")
    page("document.activeElement.blur()")
    page.key("Period", ".", text=".")
    until(lambda: page.text("#mark") == "disarmed → armed")
    page.key("Space", " ", text=" ")
    until(lambda: page("picture.place.playing"))
    until(lambda: page.text(".mode") == "holding")
    assert page(PALE) == []
    assert page.browser.requests == [path.as_uri()]
    page.browser.ask(
        "Emulation.setEmulatedMedia",
        features=[{"name": "prefers-reduced-motion", "value": "reduce"}],
    )
    page.open(path.as_uri() + "?")
    assert page("[picture.place.playing, picture.place.position]") == [False, 0]


def test_the_search_of_the_site_works_on_pages_opened_as_files(page, tmp_path):
    (tmp_path / "worker.js").write_text(
        "addEventListener('message', ({ data }) => postMessage(data + ' found'));"
    )
    (tmp_path / "a.html").write_text(f"<body><script>{SHIM.read_text('utf-8')}</script>")
    page.browser.open((tmp_path / "a.html").as_uri())
    until(lambda: page("!!document.body"))
    page("window.worker = new Worker(new URL('worker.js', location))")
    page("worker.addEventListener('message', ({ data }) => window.came = data)")
    page("worker.postMessage('grip')")
    until(lambda: page("window.came") == "grip found")
