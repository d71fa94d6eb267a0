"""Test the pictures, the access control and the errors of ``softfinger view``."""

import argparse
import asyncio
import base64
import gzip
import http.client
import math
import re
import signal
import socket
import threading
import time
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from email.message import Message
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgpack
import numpy as np
import orjson
import psutil
import pytest
import zmq
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from softfinger.daemon.client.command_client import NoAnswer
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import pack
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.stop_condition import StopCondition
from softfinger.tools.viewing import sources
from softfinger.tools.viewing.document import save
from softfinger.tools.viewing.page import Site, listen
from softfinger.tools.viewing.pictures import COLUMNS, TOPICS, Pictures, Row
from softfinger.tools.viewing.sources import Playback, ViewError, follow
from tests.conftest import until
from tests.harness.fake_daemon import FakeDaemon, event, finger, frame, now, state
from tests.harness.golden_wire import sample
from tests.harness.recorded_hand import record_hand, write_recording
from tests.harness.viewed import WAIT, Viewed, Watcher, masked, upgrade_request

GRASP = {
    30: {"command": "arm"},
    60: {"command": "grasp", "force": 8.0},
    800: {"command": "rotate", "angle": 0.1},
    1100: {"command": "release"},
}
GOALS = {"goal_force": 9.0, "goal_angle": 0.1}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record 2.6 s of the simulated hand, which grasps, turns and releases the object."""
    path = tmp_path_factory.mktemp("recorded") / "hand.mcap"
    record_hand(path, GRASP, 2.6)
    return path


class Kept:
    """Store the newest picture, scene and rows, which are computed in the test process."""

    def __init__(self, *, live: bool = False) -> None:
        self.newest: dict[str, Any] = {}
        self.scene: dict[str, Any] = {}
        self.rows: list[list[Any]] = []
        self.said: list[str] = []
        self.pictures = Pictures(self._take, lambda: True, self.said.append, live=live)

    def _take(self, scene: str, picture: str, rows: list[Row]) -> None:
        self.rows = [orjson.loads(row.text) for row in rows]
        # Store the picture last, because tests in another thread wait for it.
        self.scene = orjson.loads(scene)
        self.newest = orjson.loads(picture)


def view(fake: FakeDaemon, *words: str) -> Viewed:
    where = ("--address", f"{fake.state_address},{fake.command_address}")
    return Viewed(*where, *words)


def got(host: str, path: str, **headers: str) -> tuple[int, str, Message]:
    """Request a path; return the status, the body and the headers of the response."""
    connection = http.client.HTTPConnection(host, timeout=WAIT)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    body = answer.read().decode()
    connection.close()
    return answer.status, body, answer.headers


def location(host: str, path: str) -> str:
    """Request a path and return the address to which the server redirects."""
    status, _, headers = got(host, path)
    assert status == 303
    return str(headers["Location"])


def command_line(host: str, query: str, **more: Any) -> ClientConnection:
    """Open a connection for commands as a page does."""
    return connect(f"ws://{host}/command{query}", proxy=None, open_timeout=WAIT, **more)


def ask(host: str, query: str, asked: Any, **more: Any) -> str:
    """Send a command or any other text to the viewer as a page does; return the reply."""
    with command_line(host, query, **more) as line:
        line.send(orjson.dumps(asked).decode())
        return str(line.recv(timeout=WAIT))


ANSWERS = [("/", {}, 200), ("/nothing", {}, 404), ("/", {"Host": "evil.example"}, 403)]


@pytest.mark.parametrize(("path", "headers", "status"), ANSWERS)
def test_responses_are_not_cached_framed_or_revealed_to_other_sites(served, path, headers, status):
    found, _, sent = got(served[1].host, path, **headers)
    assert found == status
    assert sent["Referrer-Policy"] == "no-referrer"
    assert sent["Cache-Control"] == "no-store"
    assert "frame-ancestors 'none'" in sent["Content-Security-Policy"]


ODD = ["[" * 30_000, '{"command": ' + "[" * 30_000, '{"command":"a","x":' + "9" * 40 + "}"]
ODD += ['{"command": "\\ud800"}', "{"]


@pytest.mark.parametrize("odd", ODD)
def test_an_invalid_command_gets_a_reply(served, odd):
    fake, viewed = served
    with command_line(viewed.host, viewed.query) as line:
        for _ in range(2):  # The connection stays open after a refusal.
            line.send(odd)
            assert str(line.recv(timeout=WAIT)).startswith(
                "✗ invalid command: expected a JSON object"
            )
    assert fake.requests == []


def test_ctrl_c_ends_it_while_the_daemon_does_not_reply(addresses):
    with (
        Viewed("--address", ",".join(addresses), "--timeout", "100000") as viewed,
        command_line(viewed.host, viewed.query) as line,
    ):
        line.send(orjson.dumps({"command": "arm", "seen": time.monotonic()}).decode())
        # The viewer waits.
        assert any("no reply to arm" in line for line in viewed.process.stderr)
        viewed.process.send_signal(signal.SIGINT)
        assert viewed.process.wait(WAIT) == 1  # exit status without any picture


def test_ctrl_c_ends_it_while_a_page_does_not_read(served):
    with FakeDaemon() as fake, view(fake) as viewed:
        host, _, port = viewed.host.partition(":")
        with socket.socket() as page:
            page.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            page.connect((host, int(port)))
            page.settimeout(WAIT)
            page.sendall(upgrade_request(viewed.host, "/pictures"))
            page.setblocking(False)
            begun = fake.published

            def is_stuck() -> bool:
                with suppress(BlockingIOError):
                    page.send(masked(""))
                return fake.published > begun + 500  # A page's queue stores 5 s of pictures.

            until(is_stuck)
            viewed.process.send_signal(signal.SIGINT)
            assert viewed.process.wait(WAIT) == 0


# Contents


def test_a_picture_has_the_values_of_the_stream() -> None:
    left = {**finger(0.0, 0), "force": 7.5, "temperature": 66.0}
    with FakeDaemon() as fake:
        fake.changes = {"left": left, "schema": 2, "news": 1.5, **GOALS}
        with view(fake) as viewed, Watcher(viewed.host) as page:
            pictures = [page.next() for _ in range(5)]
            fake.send(schema.EVENT, msgpack.packb(event(7, "slip", "the object slips", "warning")))
            # If the publisher pauses on a busy machine, the picture shows old data.
            while not (picture := page.next())["events"] or (
                picture["age"] >= picture["patience"]["state"]
            ):
                pictures.append(picture)
            said = viewed.end()
    seqs = [each["seq"] for each in pictures]
    assert seqs == sorted(seqs)
    assert seqs[0] < picture["seq"]
    numbers = [row[0] for each in (*pictures, picture) for row in each["rows"]]
    assert numbers == [*range(numbers[0], picture["row"][0])]  # Each row appears once.
    expected = {
        "left.force": 7.5,
        "left.force_std": 0.05,
        "goal_force": 9.0,
        "right.d": 3.31,
        "right.d_std": 0.02,
        "object.angle": 4.98,
        "goal_angle": math.degrees(0.1),
        "object.width": 40.0,
        "right.energy": 12.34,
        "right.q": math.degrees(0.44),
        "right.current": 0.213,
        "compute_s": 11.0,
        "left.theta_std": 0.1,
    }
    shown = {path: picture["row"][COLUMNS[path]] for path in expected}
    assert shown == pytest.approx(expected, abs=1e-4)
    assert picture["row"][2] == picture["mode"] == "holding"
    assert picture["fault"] == ""
    assert picture["events"][-1][2:] == ["warning", "slip", "the object slips"]
    assert picture["notes"][0] == "the object slips"
    assert "left temperature at 94% of safety.temperature_max" in picture["notes"]
    # The right finger's values are far from their limits.
    assert not [note for note in picture["notes"] if "right" in note]
    facts = dict(zip(picture["facts"][::2], picture["facts"][1::2], strict=True))
    assert facts["Servos"] == "66 / 41 °C, 12.1 / 12.1 V"
    for name in ("left", "right"):
        image = picture["panels"][name]["image"]
        levels = np.frombuffer(base64.b64decode(image["data"]), np.uint8).reshape(44, 44)
        # The 31 levels represent up to 50 kPa, and the peak is 42 kPa.
        assert levels.max() > 20
        assert levels[20:24, 20:24].min() > 10
        assert levels[:8].max() < 6  # cells outside the footprint
        # One line is the rim, and the other line is the footprint.
        assert len(picture["panels"][name]["lines"]) == 2
        assert picture["panels"][name]["scale"] == ["≤ 3", "50 kPa"]
    assert len(picture["panels"]["landscape"]["dots"]) == 2
    assert picture["panels"]["hand"]["texts"][0][3] == "7.5 N"
    assert "the stream uses schema 2, but this page supports schema 1" in picture["notes"]
    assert "0 messages could not be read" in said


def test_the_true_object_disappears_with_the_simulated_hand() -> None:
    kept = Kept()

    def line_count(seq: int) -> int:
        kept.pictures.take(schema.STATE, state(0.0, seq))
        kept.pictures.draw()
        return len(kept.newest["panels"]["hand"]["lines"])

    without = line_count(5)
    kept.pictures.take(schema.TRUTH, sample(schema.TRUTH) | now())
    assert line_count(6) == without + 1
    assert line_count(1) == without  # Another daemon, which controls real servos, was started.


def test_images_of_tips_without_contact_are_blank() -> None:
    kept = Kept()
    noise = np.random.default_rng(1).normal(0.0, Settings().tactile.noise / 4.0, (44, 44))
    counts = np.clip(noise, 0.0, None).astype("<u2")  # One count corresponds to 4 Pa.
    kept.pictures.take(schema.TACTILE, {**frame(0.0, 0), "data": counts.tobytes()})
    kept.pictures.take(schema.STATE, state(0.0, 1))
    kept.pictures.draw()
    levels = np.frombuffer(base64.b64decode(kept.newest["panels"]["left"]["image"]["data"]), "u1")
    assert (levels == 0).mean() > 0.95
    assert levels.max() < 0.3 * (len(kept.scene["palette"]) - 1)


def test_pages_share_one_subscription_and_get_pictures_only_on_request():
    with FakeDaemon() as fake, view(fake) as viewed:
        with Watcher(viewed.host) as slow, ExitStack() as stack:
            begun = slow.next()["seq"]
            process = psutil.Process(viewed.process.pid)
            port = int(fake.state_address.rpartition(":")[2])

            def links() -> int:
                return sum(
                    bool(each.raddr) and each.raddr.port == port
                    for each in process.net_connections()
                )

            one = links()
            pages = [stack.enter_context(Watcher(viewed.host)) for _ in range(9)]
            for _ in range(10):
                seqs = [page.next()["seq"] for page in pages]
            assert links() == one > 0
            with pytest.raises(TimeoutError):
                slow.socket.recv(timeout=0.0)
            assert slow.next()["seq"] >= max(seqs) > begun
        viewed.end()


@pytest.mark.parametrize(
    ("changes", "gone", "there"),
    [
        (
            ('scene.fingers=["left"]', "scene.object_model=false"),
            {"right", "Object angle", "Object width"},
            "left",
        ),
        (("servos.backend=none",), {"Joint angles", "Motor current"}, "right"),
        (("tactile.backend=none",), {"left", "right"}, "Joint angles"),
    ],
)
def test_panels_for_missing_parts_are_omitted(tmp_path, changes, gone, there):
    record_hand(tmp_path / "a.mcap", {}, 0.5, changes)
    kept = Kept()
    for topic, message in Recording(tmp_path / "a.mcap").messages():
        kept.pictures.take(topic, message)
    kept.pictures.draw()
    names = {each["name"] for each in kept.scene["panels"]}
    names |= {each["title"] for each in kept.scene["plots"]}
    assert there in names
    assert not gone & names


# Access control


@pytest.fixture(scope="module")
def served() -> Iterator[tuple[FakeDaemon, Viewed]]:
    """Yield a fake daemon and a viewer; tests that share them must not change their state."""
    with FakeDaemon() as fake, view(fake) as viewed:
        yield fake, viewed


def test_other_hosts_and_origins_are_refused_and_no_other_port_is_open(served):
    _, viewed = served
    port = viewed.host.rpartition(":")[2]
    assert got(viewed.host, "/")[0] == 200
    for host in (f"localhost:{port}", f"[::1]:{port}"):
        assert got(viewed.host, "/", Host=host)[0] == 200
    hosts = ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", "")
    inexact = ("127.0.0.1", "localhost:1", f"{viewed.host}:evil", f"{viewed.host}@evil.example")
    for host in (*hosts, *inexact):
        assert got(viewed.host, "/", Host=host)[0] == 403
    for origin in (
        "http://evil.example",
        "null",
        f"https://{viewed.host}",
        "http://127.0.0.1:1",
    ):
        assert got(viewed.host, "/", Origin=origin)[0] == 403
        assert got(viewed.host, "/pictures", Origin=origin)[0] == 403
        with pytest.raises(InvalidStatus, match="403"), Watcher(viewed.host, origin=origin):
            pass
    with Watcher(viewed.host, origin=f"http://{viewed.host}") as page:
        assert page.next()["mode"] == "holding"
    for path in ("/docs", "/openapi.json", "/../etc/passwd"):
        assert got(viewed.host, path)[0] == 404
    listening = psutil.Process(viewed.process.pid).net_connections()
    assert [each.laddr.ip for each in listening if each.status == "LISTEN"] == ["127.0.0.1"]


def test_only_the_token_gives_access_to_commands(served):
    fake, viewed = served
    token, stop = viewed.query, {"command": "stop"}
    assert "STOP" in got(viewed.host, f"/{token}")[1]
    for query in ("", "?token=", "?token=None", "?token=%C3%A9", "?token=abc"):
        status, body, _ = got(viewed.host, f"/{query}")
        assert status == 200
        assert "STOP" not in body
        assert "Watching" in body
        assert (
            ask(viewed.host, query, stop) == "✗ commands require the token printed in the terminal"
        )
    with pytest.raises(InvalidStatus, match="403"):
        ask(viewed.host, token, stop, origin="http://evil.example")
    assert not fake.requests
    assert ask(viewed.host, token, stop) == "✓ stop: ok"
    assert fake.requests == [stop]
    fake.replies["stop"] = {"ok": True, "torque_off": "unconfirmed"}
    assert ask(viewed.host, token, stop)[:7] == "✗ stop:"


def test_a_command_is_sent_once_and_only_soon_after_its_picture() -> None:
    grasp = {"command": "grasp", "force": 5.0, "client": "page 1"}
    with (
        FakeDaemon() as fake,
        view(fake, "--timeout", "60") as viewed,
        Watcher(viewed.host) as page,
    ):

        def press() -> str:
            """Send a command with the time of a current picture."""
            return ask(viewed.host, viewed.query, {**grasp, "seen": page.next()["now"]})

        assert press() == "✓ grasp: ok"
        fake.replies["grasp"] = {
            "ok": False,
            "error": "grasp: not accepted in mode disarmed; arm first",
        }
        assert press() == "✗ grasp: not accepted in mode disarmed; arm first"
        assert fake.requests == [grasp, grasp]
        late = {"seen": page.next()["now"] - 60.0}
        assert ask(viewed.host, viewed.query, {**grasp, **late}).endswith("s behind")
        assert ask(viewed.host, viewed.query, grasp).startswith('✗ grasp: expected "seen"')
        for odd in (None, "grasp", [], {"seen": 1.0}, {**grasp, "seen": None}):
            assert ask(viewed.host, viewed.query, odd).startswith("✗ invalid command")
        fake.replies["grasp"] = b"\xc1"
        assert press().endswith("sent an invalid reply")
        assert fake.requests == [grasp] * 3


def test_a_reply_is_awaited_only_while_the_picture_is_recent() -> None:
    timeouts: list[float] = []

    def unanswered(_: dict[str, Any], timeout: float) -> dict[str, Any]:
        timeouts.append(timeout)
        raise NoAnswer("no reply")

    with closing(asyncio.new_event_loop()) as loop:
        site = Site(loop, "", unanswered, None, 1000.0, "")
        asked = {"command": "grasp", "seen": time.monotonic() - 400.0}
        assert site._answer(orjson.dumps(asked)) == "✗ grasp: no reply"
    assert 0.0 < timeouts[0] <= 600.0


def test_other_machines_need_a_one_time_code() -> None:
    # Any address other than 127.0.0.1 counts as reachable from other machines.
    with FakeDaemon() as fake, view(fake, "--host", "127.0.0.2") as viewed:
        code = viewed.address.removeprefix(f"http://{viewed.host}")
        for path in ("/", "/?code=", "/?code=abc", "/?token=", "/?token=abc"):
            status, body, _ = got(viewed.host, path)
            assert status == 403
            assert "newest address" in body
            with pytest.raises(InvalidStatus, match="403"), Watcher(viewed.host):
                pass
        place = location(viewed.host, code)
        assert place.startswith("/?token=")
        assert "STOP" in got(viewed.host, place)[1]
        query = place.removeprefix("/")
        assert ask(viewed.host, query, {"command": "stop"}) == "✓ stop: ok"
        with pytest.raises(InvalidStatus, match="403"):
            ask(viewed.host, query, {"command": "stop"}, origin="http://evil.example")
        assert got(viewed.host, code)[0] == 403  # A code is valid for only one browser.
        line = viewed.process.stdout.readline()  # The server prints a new code.
        assert location(viewed.host, line.split()[1].removeprefix(f"http://{viewed.host}")) == place
        listening = psutil.Process(viewed.process.pid).net_connections()
        assert [each.laddr.ip for each in listening if each.status == "LISTEN"] == ["127.0.0.2"]
        with Watcher(viewed.host, query) as page:
            until(lambda: page.next()["mode"] == "holding")
        viewed.end()


# A recording


def test_a_recording_can_be_shown_from_any_position(recorded):
    recording = Recording(recorded)
    states = [message for _, message in recording.messages([schema.STATE])]
    kept = Kept()
    playback = Playback(recording, kept.pictures, 0.01)
    with StopCondition() as ending:
        thread = threading.Thread(target=playback.run, args=(ending,))
        thread.start()
        try:
            until(lambda: playback.position > 0.3)  # The recording is playing.
            playback.ask("pause")
            for place in (2.0, 0.5, 1.5):
                playback.ask(str(place))
                when = recording.start + place
                until(lambda: abs(kept.newest["time"] - when) < 0.02)  # noqa: B023
                picture = kept.newest
                at = next(each for each in states if each["timestamp"] == picture["time"])
                assert (picture["mode"], kept.scene["live"]) == (at["mode"], False)
                past = {each["timestamp"]: each["left"]["force"] for each in states}
                rows = [row for row in kept.rows if row[0] >= picture["first"]]
                assert len(rows) == pytest.approx(10 * place, abs=2)
                for row in rows:
                    force, was = row[COLUMNS["left.force"]], past[row[1]]
                    assert force == (pytest.approx(was, abs=1e-4) if math.isfinite(was) else None)
            assert playback.position == 1.5
            playback.ask("play")
            until(lambda: not playback.playing)  # The playback stops at the end.
            assert playback.position == pytest.approx(recording.duration)
            drawn = kept.newest
            until(lambda: kept.newest is not drawn)  # The viewer still draws pictures at the end.
            for odd in ("speed 0", "speed fast", "speed 1e9", "speed nan", "nan", "later"):
                playback.ask(odd)
            playback.ask("speed 0.5")
            playback.ask("play")
            # Playback restarts from the beginning.
            until(lambda: 0.0 < playback.position < 1.0)
            until(lambda: kept.newest["place"]["speed"] == 0.5)
            marks = [(kind, text) for _, _, kind, text in kept.scene["marks"]]
            assert ("mode", "disarmed → armed") in marks
            assert ("mode", "holding → rotating") in marks
            assert [at for at, *_ in kept.scene["marks"]] == sorted(
                at for at, *_ in kept.scene["marks"]
            )
        finally:
            ending.end()
            thread.join()


def stored_in(page: str) -> list[Any]:
    """Return all scenes, pictures and rows in a saved page."""
    (packed,) = re.findall('id="stored">(.*?)</script>', page)
    return [orjson.loads(line) for line in gzip.decompress(base64.b64decode(packed)).splitlines()]


def test_a_recording_is_saved_as_a_page(recorded, tmp_path):
    recording, path = Recording(recorded), tmp_path / "run.html"
    save(path, recording, 0.1, print)
    page = path.read_text("utf-8")
    # The page loads nothing from other addresses.
    assert "://" not in re.sub("ws://|xmlns=.[^ ]*", "", page)
    assert 'name="stop"' not in page
    scene, *pictures, rows = stored_in(page)
    assert [mark[3] for mark in scene["marks"]][:2] == ["disarmed → armed", "armed → grasping"]
    places = [each["place"]["position"] for each in pictures]
    assert places == pytest.approx([*np.arange(0.0, recording.duration, 0.1), recording.duration])
    for place, picture in zip(places[1:], pictures[1:], strict=True):
        assert recording.start + place - picture["time"] == pytest.approx(0.0, abs=0.02)
    assert {"disarmed", "holding", "rotating"} <= {each["mode"] for each in pictures}
    assert [row[0] for row in rows] == [*range(len(rows))]
    assert rows[-1][1] == pytest.approx(recording.end, abs=0.2)


def test_a_recording_is_saved_as_a_moving_picture(recorded, tmp_path):
    path = tmp_path / "run.svg"
    save(path, Recording(recorded), 0.1, print)
    assert path.stat().st_size < 100_000
    lines = [each for each in ElementTree.parse(path).getroot().iter() if "values" in each.attrib]
    counts = {len(each.attrib["values"].split(";")) for each in lines}
    assert counts == {1 + math.ceil(Recording(recorded).duration / 0.1)}
    for line in lines:  # Chromium draws stray lines if the number of points changes.
        assert len({len(value.split()) for value in line.attrib["values"].split(";")}) == 1
    assert len(lines) >= 6 + 5  # The lines show the fingers, tips, contacts, arrows and object.


def test_a_long_recording_is_saved_with_a_valid_duration(recorded, tmp_path):
    save(tmp_path / "run.svg", Recording(recorded), 3000.0, print)
    # A duration in SVG has no exponent.
    assert set(re.findall(r'dur="(.*?)"', (tmp_path / "run.svg").read_text())) == {"6000s"}


def test_a_recording_that_cannot_be_saved_is_refused(recorded, tmp_path, inline):
    with pytest.raises(ViewError, match="pictures, expected at most 6000; choose a lower --rate"):
        save(tmp_path / "a.html", Recording(recorded), 1e-4, print)
    with pytest.raises(ViewError, match="No such file or directory"):
        save(tmp_path / "none" / "a.svg", Recording(recorded), 0.1, print)
    empty = write_recording(tmp_path / "empty.mcap")
    with pytest.raises(ViewError, match="the recording does not contain hand/state"):
        save(tmp_path / "a.html", empty, 0.1, print)
    assert not (tmp_path / "a.html").exists()
    for words, message in (
        ((recorded, "--save", "a.gif"), "expected a name ending in .html or .svg, found 'a.gif'"),
        (("--save", "a.html"), "--save requires a recording"),
    ):
        done = inline("view", *words)
        assert done.returncode == 2
        assert message in done.stderr


# Errors


def test_invalid_messages_are_tolerated() -> None:
    odd: list[Any] = [None, 3, {}, {"timestamp": "now"}, {"timestamp": math.inf, "schema": 1}]
    odd += [{"timestamp": 1e9, "schema": 1, "left": 3, "mode": 5, "seq": "a", "finger": "left"}]
    odd += [{"timestamp": 1e9, "left": {"contact": True, "d": math.nan, "q": math.inf}}]
    odd += [{"timestamp": 1e9, "left": {"contact": True, "d": 1.0, "theta": 9.0, "force": -1e300}}]
    odd += [{**frame(0.0, 0), "data": b"abc"}, {**frame(0.0, 0), "pitch": -1.0}]
    odd += [{"timestamp": 1e9, "settings": "{", "request": "{", "command": "grasp", "ok": True}]
    odd += [{**state(0.0, 1), "mode": "\x1b[31m", "left": {**finger(0.0, 0), "q": 1e308}}]
    odd += [{**state(0.0, 1), "left": {**finger(0.0, 0), "q": math.inf}}]
    kept = Kept(live=True)
    for topic in (*TOPICS, b"hand/news"):
        for message in odd:
            kept.pictures.take(topic, message)
            kept.pictures.draw()
    assert kept.pictures.unreadable > 10
    kept.pictures.take(schema.STATE, {**state(0.0, 5), **GOALS})
    kept.pictures.draw()
    assert kept.newest["mode"] == "holding"
    facts = kept.newest["facts"]
    assert facts[facts.index("Messages unreadable") + 1] == str(kept.pictures.unreadable)


def test_states_are_queued_while_a_picture_is_drawn(context, addresses):
    publisher = context.socket(zmq.XPUB)
    publisher.setsockopt(zmq.SNDHWM, 2000)  # same limit as in the daemon
    # If the queue is full, `send` waits for libzmq's thread.
    publisher.setsockopt(zmq.XPUB_NODROP, 1)
    publisher.setsockopt(zmq.SNDTIMEO, 60_000)
    publisher.bind(addresses[0])
    kept, drawn = Kept(live=True), threading.Event()
    kept.pictures.draw, draw = drawn.wait, kept.pictures.draw
    arguments = argparse.Namespace(address=addresses[0], keys=None, rate=100.0, no_wait=False)
    with StopCondition() as ending:
        words = arguments, None, kept.pictures, ending, kept.said.append
        thread = threading.Thread(target=follow, args=words)
        thread.start()
        try:
            until(lambda: {publisher.recv()[1:] for _ in TOPICS} == set(TOPICS))
            for k in range(1, 5001):
                publisher.send_multipart([schema.STATE, pack({**state(0.0, k), "seq_step": 1})])
            drawn.set()
            until(lambda: kept.pictures.states == 5000)
        finally:
            drawn.set()
            ending.end()
            thread.join()
    draw()
    facts = kept.newest["facts"]
    assert facts[facts.index("Messages lost") + 1] == "0"
    assert facts[facts.index("Messages unreadable") + 1] == "0"


def test_waiting_is_reported_and_ended_by_a_signal() -> None:
    with FakeDaemon() as fake:
        fake.silent.set()
        with view(fake) as viewed, Watcher(viewed.host) as page:
            assert page.next()["age"] is None
            waiting = f"waiting for a stream from {fake.state_address}"
            assert any(waiting in line for line in viewed.process.stderr)
            fake.silent.clear()
            assert any("the stream has started" in line for line in viewed.process.stderr)
            until(lambda: (page.next()["age"] or 1.0) < 0.1)
            fake.silent.set()
            until(lambda: page.next()["age"] > 1.0)
            viewed.process.send_signal(signal.SIGINT)
            assert "states received" in viewed.process.stderr.read()
            assert viewed.process.wait(300) == 0


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("text.mcap",), "not an MCAP file"),
        (("text.mcap", "--port", "-1"), "expected a port"),
        (("--address", "nowhere"), "nowhere: malformed address"),
        (("--address", "tcp://127.0.0.1:9", "--duration", "0.1"), "received no hand/state"),
        (("--address", "tcp://127.0.0.1:9", "--no-wait"), "no stream from tcp"),
        (("--foxglove", "0", "--port", "0", "--duration", "0.1"), "use --foxglove PORT without"),
        (("--rate", "fast"), "expected 0.1 to 100 Hz"),
    ],
)
def test_invalid_input_is_reported_in_one_line(tmp_path, inline, monkeypatch, words, reason):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sources, "WAIT_MAX", 0.1)
    (tmp_path / "text.mcap").write_text("no recording")
    done = inline("view", "--no-browser", *words)
    assert done.returncode in (1, 2)
    assert reason in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("display", ["", ":0"])
def test_a_browser_is_opened_only_on_a_display(addresses, inline, monkeypatch, display):
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    done = inline("view", "--address", ",".join(addresses), "--port", "0", "--duration", "0.1")
    assert ["to view the hand" in done.stdout, len(opened)] == [True, len(display) // 2]


def test_pages_without_a_chosen_port_get_different_ports() -> None:
    with ExitStack() as stack:  # All ports stay open until the end.
        here = "127.0.0.1"
        ports = [stack.enter_context(listen(here, None)).getsockname()[1] for _ in range(3)]
        assert len(set(ports)) == 3
        with pytest.raises(ViewError, match=f"port {ports[0]}"):
            listen(here, ports[0])
        with pytest.raises(ViewError, match=r"--host 192\.0\.2\.1 can't be used"):
            listen("192.0.2.1", None)  # address reserved for documentation
