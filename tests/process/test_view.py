"""``softfinger view``: what goes to Rerun is what was published, and what can go wrong."""

from __future__ import annotations

import http.client
import math
import os
import re
import select
import signal
import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import rerun as rr
import zmq
from rerun.chunk import RrdReader

from softfinger.daemon.wire import schema
from softfinger.daemon.wire.packer import pack
from softfinger.tools import cli
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.viewing.bridge import Bridge
from softfinger.tools.viewing.live_stream import TOPICS, LiveStream, ViewError
from softfinger.tools.viewing.viewer import WebPage, policy
from tests.conftest import until
from tests.harness.daemon_process import SOFTFINGER
from tests.harness.fake_daemon import FakeDaemon, event, frame, state
from tests.harness.recorded_hand import record_hand

GRASP = {
    30: {"command": "arm"},
    60: {"command": "grasp", "force": 8.0},
    800: {"command": "rotate", "angle": 0.1},
    1100: {"command": "release"},
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated hand at work for 2.6 s: grasps, turns, releases."""
    path = tmp_path_factory.mktemp("recorded") / "hand.mcap"
    record_hand(path, GRASP, 2.6)
    return path


@pytest.fixture(scope="module")
def shown(recorded: Path) -> Shown:
    """What of it goes to the viewer."""
    file = recorded.with_suffix(".rrd")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "nice", lambda _: 0)  # the tests' own priority stays
        assert cli.main(["view", str(recorded), "--save", str(file)]) == 0
    return Shown(file)


def _columns(batch: Any) -> list[tuple[str, Any]]:
    """Components alone, without times and row numbers."""
    both = zip(batch.schema.names, batch.columns, strict=True)
    return [(name, column) for name, column in both if ":" in name]


class Shown:
    """A .rrd read back: rows of (time, values) by entity and component, and the layout."""

    def __init__(self, path: Path) -> None:
        reader = RrdReader(str(path))
        self.rows: dict[tuple[str, str], list[tuple[float, Any]]] = {}
        self.still: dict[tuple[str, str], Any] = {}
        for chunk in reader.stream().to_chunks():
            batch = chunk.to_record_batch()
            names = batch.schema.names
            times = None
            if "time" in names:
                times = batch.column(names.index("time")).cast("int64").to_numpy() * 1e-9
            for name, column in _columns(batch):
                key = chunk.entity_path, name.split(":", 1)[1]
                if times is None:
                    self.still[key] = column[0].as_py()
                else:
                    rows = self.rows.setdefault(key, [])
                    rows += zip(times.tolist(), column.to_pylist(), strict=True)
        for rows in self.rows.values():
            rows.sort(key=lambda row: row[0])
        self.layout = "\n".join(
            str(column.to_pylist())
            for entry in reader.blueprints()
            for chunk in reader.stream(store=entry).to_chunks()
            for name, column in _columns(chunk.to_record_batch())
        )

    def entities(self) -> set[str]:
        return {entity for entity, _ in [*self.rows, *self.still]}


def recorded_states(path: Path) -> list[dict[str, Any]]:
    return [message for _, message in Recording(path).messages([schema.STATE])]


def test_every_state_is_in_the_plots(recorded: Path, shown: Shown) -> None:
    states = recorded_states(recorded)
    rows = shown.rows["/plots/force", "scalars"]
    assert len(rows) == len(states) > 200
    values = np.array([row for _, row in rows])
    for column, name in enumerate(("left", "right")):
        assert values[:, column].tolist() == [each[name]["force"] for each in states]
    assert [when for when, _ in rows] == pytest.approx(
        [each["timestamp"] for each in states], abs=1e-6
    )
    wanted = values[:, 2]
    gripping = [each["mode"] in ("grasping", "holding", "rotating") for each in states]
    assert sum(gripping) > 100
    assert wanted[gripping] == pytest.approx(8.0)
    assert np.isnan(wanted[np.logical_not(gripping)]).all()
    energy = np.array([row for _, row in shown.rows["/plots/energy", "scalars"]])
    assert energy[:, 0] == pytest.approx([1e3 * each["left"]["energy"] for each in states])
    # Pressed as wanted and almost upright, a tip holds almost the energy that goes with it.
    upright = np.array(gripping) & (abs(values[:, 0] - 8.0) < 0.1)
    assert energy[upright, 0] == pytest.approx(energy[upright, 2], rel=0.1)
    joints = np.array([row for _, row in shown.rows["/plots/q", "scalars"]])
    assert joints[:, 3] == pytest.approx([math.degrees(each["right"]["goal_q"]) for each in states])
    angles = np.array([row for _, row in shown.rows["/plots/object", "scalars"]])
    turning = [each["mode"] == "rotating" for each in states]
    assert angles[turning, 1] == pytest.approx(math.degrees(0.1))
    ticks = np.array([row for _, row in shown.rows["/plots/tick", "scalars"]])
    assert ticks[:, 0] == pytest.approx([1e6 * each["compute_s"] for each in states])


def test_modes_and_events_in_their_order(recorded: Path, shown: Shown) -> None:
    modes = [row[0] for _, row in shown.rows["/mode", "state"]]
    assert modes[:4] == ["disarmed", "armed", "grasping", "holding"]
    assert modes[-2:] == ["releasing", "armed"] or modes[-1] == "releasing"
    told = [message for _, message in Recording(recorded).messages([schema.EVENT])]
    logged = [
        (when, row[0])
        for (entity, component), rows in shown.rows.items()
        if entity.startswith("/events/") and component == "text"
        for when, row in rows
    ]
    assert len(logged) == len(told) > 3
    for when, line in sorted(logged):
        assert any(
            line.endswith(f"{each['kind']}: {each['text']}")
            and when == pytest.approx(each["timestamp"], abs=1e-6)
            for each in told
        )
    pages = shown.rows["/statistics", "text"]
    assert "ticks" in pages[-1][1][0]


def test_frames_are_the_boards_with_the_footprint_over_them(recorded: Path, shown: Shown) -> None:
    frames = [message for _, message in Recording(recorded).messages([schema.TACTILE])]
    for finger in ("left", "right"):
        sent = {each["data"] for each in frames if each["finger"] == finger}
        cells = shown.rows[f"/pressure/{finger}/cells", "buffer"]
        assert len(cells) > 40  # 20 a second
        assert all(bytes(row[0]) in sent for _, row in cells)
        outlines = shown.rows[f"/pressure/{finger}/footprint", "strips"]
        times = [when for when, row in outlines if row]
        touching = [
            each["timestamp"] for each in recorded_states(recorded) if each[finger]["contact"]
        ]
        assert times[0] == pytest.approx(touching[0], abs=0.1)
        assert len(times) == pytest.approx(20.0 * len(touching) / 100.0, rel=0.2)
        # The centroid of the pressed cells is where it is drawn.
        spots = dict(shown.rows[f"/pressure/{finger}/centroid", "positions"])
        when, row = cells[len(cells) // 2]
        counts = np.frombuffer(bytes(row[0]), "<u2").reshape(44, 44).astype(float)
        counts[counts < 0.25 * counts.max()] = 0.0
        centre = (counts * (np.indices(counts.shape) + 0.5)).sum(axis=(1, 2)) / counts.sum()
        assert spots[when][0] == pytest.approx(centre[::-1], abs=0.6)


def test_the_hand_moves_and_the_object_is_between_its_tips(recorded: Path, shown: Shown) -> None:
    assert len(shown.rows["/hand/left", "strips"]) > 40
    released = next(when for when, row in shown.rows["/mode", "state"] if row == ["releasing"])
    outlines = shown.rows["/hand/object", "strips"]
    held = [(when, row[0]) for when, row in outlines if row and when < released]
    simulated = [(when, row[0]) for when, row in shown.rows["/hand/simulated", "strips"]]
    assert len(held) > 20
    middles = np.array([np.mean(outline[:4], axis=0) for _, outline in held])
    places = np.array([np.mean(outline[:4], axis=0) for _, outline in simulated])
    times = [when for when, _ in simulated]
    true = np.column_stack(
        [np.interp([when for when, _ in held], times, places[:, k]) for k in range(2)]
    )
    assert middles[:, 0] == pytest.approx(true[:, 0], abs=0.5)  # mm
    # Along its faces only its way is known: from where it was gripped.
    assert middles[:, 1] - middles[0, 1] == pytest.approx(true[:, 1] - true[0, 1], abs=0.5)
    arrows = [row for _, row in shown.rows["/hand/force", "vectors"] if row]
    assert all(len(row) <= 2 for row in arrows)
    lengths = np.linalg.norm(np.array([row for row in arrows if len(row) == 2]), axis=2)
    assert lengths.max() == pytest.approx(1.6 * 8.0, rel=0.2)


def test_the_landscape_has_its_picture_points_and_trails(shown: Shown) -> None:
    assert len(shown.still["/landscape/picture", "buffer"][0]) == 480 * 400 * 3
    labels = shown.still["/landscape/scale", "labels"]
    assert "20 mJ" in labels
    assert "θ = 0°" in labels
    now = [row for _, row in shown.rows["/landscape/now", "positions"] if row]
    trails = [row for _, row in shown.rows["/landscape/trails", "strips"] if row]
    assert max(len(row) for row in now) == 2
    assert max(len(strip) for row in trails for strip in row) > 20
    for views in (
        "pressure/left",
        "pressure/right",
        "landscape",
        "plots/force",
        "plots/q",
        "events",
    ):
        assert views in shown.layout


@pytest.mark.parametrize(
    ("changes", "gone", "there"),
    [
        (
            ('scene.fingers=["left"]', "scene.object_model=false"),
            ("pressure/right", "plots/object"),
            "pressure/left",
        ),
        (("servos.backend=none",), ("plots/q", "plots/current"), "pressure/right"),
        (("tactile.backend=none",), ("pressure/left", "pressure/right"), "plots/q"),
    ],
)
def test_what_the_scene_lacks_has_no_place(
    tmp_path: Path, changes: tuple[str, ...], gone: tuple[str, ...], there: str
) -> None:
    record_hand(tmp_path / "a.mcap", {}, 0.5, changes)
    sink = rr.FileSink(tmp_path / "a.rrd")
    recording = rr.RecordingStream("softfinger")
    recording.set_sinks(sink)
    bridge = Bridge(recording)
    for topic, message in Recording(tmp_path / "a.mcap").messages():
        bridge.take(topic, message)
    bridge.draw(last=True)
    recording.disconnect()
    shown = Shown(tmp_path / "a.rrd")
    assert there in shown.layout
    for each in gone:
        assert each not in shown.layout
        assert not any(entity.startswith(f"/{each}") for entity in shown.entities())
    assert bridge.unreadable == 0
    assert bridge.shown > 20


# What can go wrong


def test_what_comes_too_fast_is_passed_over_and_told() -> None:
    recording = rr.RecordingStream("softfinger")
    recording.memory_recording()
    bridge = Bridge(recording, keep=10)
    for seq in range(100):
        bridge.take(schema.STATE, {**state(0.0, 5 * seq), "timestamp": 1e9 + seq})
        for side in (0, 1):
            bridge.take(schema.TACTILE, frame(0.0, side))
        bridge.take(schema.EVENT, event(seq, "late", "a tick came late"))
    bridge.draw(last=True)
    assert (bridge.shown, bridge.dropped, bridge.lost) == (10, 90, {})
    assert bridge.time == 1e9 + 99


def test_events_older_than_the_first_state_do_not_stretch_the_time_line(tmp_path: Path) -> None:
    recording = rr.RecordingStream("softfinger")
    recording.set_sinks(rr.FileSink(tmp_path / "a.rrd"))
    bridge = Bridge(recording)
    old = {**event(1, "start", "hours ago"), "timestamp": 1e9 - 7200.0, "again": True}
    bridge.take(schema.EVENT, old)
    bridge.draw()
    for seq in range(20):
        bridge.take(schema.STATE, {**state(0.0, 5 * seq), "timestamp": 1e9 + 0.1 * seq})
    bridge.draw(last=True)
    recording.disconnect()
    shown = Shown(tmp_path / "a.rrd")
    assert shown.rows["/events/start", "text"][0][1][0].endswith("start: hours ago")
    assert min(rows[0][0] for rows in shown.rows.values()) == pytest.approx(1e9)


def test_messages_of_any_kind_are_survived() -> None:
    recording = rr.RecordingStream("softfinger")
    recording.memory_recording()
    bridge = Bridge(recording)
    odd: list[Any] = [None, 3, {}, {"timestamp": "now"}, {"timestamp": math.inf, "schema": 1}]
    odd += [{"timestamp": 1e9, "schema": 1, "left": 3, "mode": 5, "seq": "a", "finger": "left"}]
    odd += [{"timestamp": 1e9, "left": {"contact": True, "d": math.nan, "q": math.inf}}]
    odd += [{"timestamp": 1e9, "left": {"contact": True, "d": 1.0, "theta": 9.0, "force": -1e300}}]
    odd += [{**frame(0.0, 0), "data": b"abc"}, {**frame(0.0, 0), "pitch": -1.0}]
    odd += [{"timestamp": 1e9, "settings": "{", "request": "{", "command": "grasp", "ok": True}]
    for topic in (*bridge._gaps, b"hand/news"):
        for message in odd:
            bridge.take(topic, message)
            bridge.draw(last=True)
    assert bridge.unreadable > 10


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # what is saved from a stream
def test_another_schema_is_told_once_and_what_is_known_is_shown(tmp_path: Path) -> None:
    with FakeDaemon() as fake:
        fake.changes = {"schema": 2, "news": 1.5}
        path = tmp_path / "a.rrd"
        words = ["view", "--address", fake.state_address, "--save", str(path)]
        process = subprocess.Popen([*SOFTFINGER, *words], stderr=subprocess.PIPE, text=True)
        until(lambda: path.exists() and path.stat().st_size > 300_000)
        process.terminate()
        said = process.communicate(timeout=120)[1]
    assert process.returncode == 0, said
    assert said.count("the stream is of schema 2, this viewer knows 1") == 1
    shown = Shown(path)
    forces = [row[0] for _, row in shown.rows["/plots/force", "scalars"]]
    assert len(forces) > 10
    assert 8.0 < np.min(forces) <= np.max(forces) <= 12.0
    assert "/pressure/left/footprint" in shown.entities()


def test_waiting_is_told_and_a_signal_ends_it(tmp_path: Path) -> None:
    with FakeDaemon() as fake:
        fake.silent.set()
        words = ["view", "--address", fake.state_address, "--save", str(tmp_path / "a.rrd")]
        process = subprocess.Popen([*SOFTFINGER, *words], stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        assert f"waiting for a stream from {fake.state_address}" in process.stderr.readline()
        fake.silent.clear()
        assert "the stream has begun" in process.stderr.readline()
        shown = fake.published + 50
        until(lambda: fake.published > shown)
        process.send_signal(signal.SIGTERM)
        said = process.stderr.read()
    assert process.wait(60) == 0
    process.stderr.close()
    assert "states shown" in said


def test_while_nothing_is_read_messages_wait_and_what_is_lost_of_them_is_told(
    context: zmq.Context[Any], addresses: tuple[str, str]
) -> None:
    """As while a busy machine draws for seconds: states wait, and frames push out no state."""
    publisher = context.socket(zmq.XPUB)
    publisher.setsockopt(zmq.SNDHWM, 2000)  # as the daemon's
    publisher.bind(addresses[0])
    bridge = Bridge(rr.RecordingStream("test"), keep=100)
    states, frames = 20_000, 6000
    with LiveStream(addresses[0]) as stream:
        until(lambda: {publisher.recv()[1:] for _ in TOPICS} == set(TOPICS))
        big = {**frame(0.0, 0), "rows": 64, "cols": 64, "data": bytes(2 * 64 * 64)}
        for k in range(1, states + 1):
            publisher.send_multipart([schema.STATE, pack({**state(0.0, k), **EVERY})])
            if k <= frames:
                publisher.send_multipart([schema.TACTILE, pack({**big, "seq": k})])
            if k % 100 == 0:
                select.select([], [], [], 0.005)  # as fast as libzmq's own thread takes them
        until(lambda: stream.drain(bridge, 0.0) == 0)
        publisher.send_multipart([schema.TACTILE, pack({**big, "seq": frames + 1})])
        seen = bridge.frames
        until(lambda: stream.drain(bridge, 0.0) and bridge.frames > seen)
    assert bridge.dropped == states - 100  # deliberately, and told as such
    assert list(bridge.lost) == ["hand/tactile"]
    assert bridge.frames + bridge.lost["hand/tactile"] == frames + 1


EVERY = {"seq_step": 1}


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("none.mcap",), "No such file"),
        (("empty.mcap",), "empty"),
        (("text.mcap",), "not an MCAP file"),
        (("text.mcap", "--port", "0"), "expected a port"),
        (("--save", "text.mcap"), "exists already"),
        (("--save", "none/a.rrd"), "No such file"),
        (("--no-wait",), "no display for a window"),
        (("--address", "tcp://nowhere", "--save", "b.rrd"), "tcp://nowhere"),
        (
            ("--address", "tcp://127.0.0.1:9", "--duration", "0.1", "--save", "d.rrd"),
            "nothing came",
        ),
        (("--rate", "fast"), "expected 0.1 to 100 Hz"),
        (("--address", "tcp://127.0.0.1:9", "--no-wait", "--save", "c.rrd"), "no stream from tcp"),
    ],
)
def test_bad_input_is_one_clear_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    reason: str,
) -> None:
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.mcap").write_text("no recording")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "nice", lambda _: 0)  # the tests' own priority stays
    monkeypatch.chdir(tmp_path)
    try:
        status = cli.main(["view", *words])
    except SystemExit as ended:  # argparse's
        status = ended.code
    assert status in (1, 2)
    assert reason in capsys.readouterr().err
    assert not list(tmp_path.glob("*.rrd"))  # no file without content, in the next one's way


def test_a_recording_that_was_cut_short_is_shown_as_far_as_it_goes(
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    data = recorded.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    monkeypatch.setattr(os, "nice", lambda _: 0)
    assert cli.main(["view", str(tmp_path / "cut.mcap"), "--save", str(tmp_path / "a.rrd")]) == 0
    said = capsys.readouterr().err
    assert "cut short" in said
    assert re.search(r"[1-9]\d* of [1-9]\d* frames drawn", said)
    assert "lost on the way: none" in said
    assert len(Shown(tmp_path / "a.rrd").rows["/plots/force", "scalars"]) > 20


# The web viewer's page


class _Source(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200 if self.path != "/none" else 404)
        self.send_header("Content-Type", "application/wasm")
        self.send_header("rerun-final-length", "8")
        self.end_headers()
        self.wfile.write(f"of {self.path}".encode())

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def page() -> Iterator[WebPage]:
    source = ThreadingHTTPServer(("127.0.0.1", 0), _Source)
    thread = threading.Thread(target=source.serve_forever, daemon=True)
    thread.start()
    page = WebPage(0, source.server_address[1], 4321)
    yield page
    page.close()
    source.shutdown()
    source.server_close()
    thread.join()


def got(page: WebPage, path: str, host: str = "127.0.0.1") -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=60)
    connection.putrequest("GET", path, skip_host=True)
    connection.putheader("Host", f"{host}:{page.port}")
    connection.endheaders()
    answer = connection.getresponse()
    result = answer.status, dict(answer.getheaders()), answer.read()
    connection.close()
    return result


def test_the_page_is_handed_on_with_a_policy_that_keeps_it_on_this_machine(page: WebPage) -> None:
    status, headers, body = got(page, "/re_viewer_bg.wasm")
    assert (status, body) == (200, b"of /re_viewer_bg.wasm")
    assert headers["Content-Type"] == "application/wasm"
    assert headers["Content-Security-Policy"] == policy(4321)
    sources = [word for word in policy(4321).split() if "//" in word]
    assert sources == ["http://127.0.0.1:4321", "http://localhost:4321"]
    status, headers, _ = got(page, "/")
    assert status == 302
    assert headers["Location"].startswith("/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A4321%2Fproxy&")
    assert got(page, headers["Location"])[0] == 200


def test_the_page_answers_this_machine_alone_and_no_other_path(page: WebPage) -> None:
    assert got(page, "/", host="evil.example")[0] == 403
    assert got(page, "/", host="localhost")[0] == 302
    assert got(page, "/none")[0] == 404
    for path in ("/../etc/passwd", "/a/b", "/%2e%2e", "/.."):
        assert got(page, path)[0] == 404
    listening = [
        each for each in psutil.Process().net_connections() if each.laddr.port == page.port
    ]
    assert {each.laddr.ip for each in listening if each.status == "LISTEN"} == {"127.0.0.1"}
    with pytest.raises(ViewError, match=f"port {page.port}"):
        WebPage(page.port, 1, 1)


def test_pages_whose_port_nobody_chose_get_one_each() -> None:
    pages = [WebPage(None, 1, 1) for _ in range(3)]  # the first one's is taken for the others
    assert len({page.port for page in pages}) == 3
    for page in pages:
        page.close()


def test_the_viewer_ends_with_its_parent_and_listens_on_the_loopback_alone(recorded: Path) -> None:
    words = ["view", str(recorded), "--web", "--no-browser"]
    process = subprocess.Popen(
        [*SOFTFINGER, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        told = process.stdout.readline()
        assert "view: http://127.0.0.1:" in told, told or process.stderr.read()
        assert "Ctrl-C ends" in process.stderr.readline()
        children = psutil.Process(process.pid).children()
        assert len(children) == 1
        listening = [
            each.laddr.ip
            for each in (
                *children[0].net_connections(),
                *psutil.Process(process.pid).net_connections(),
            )
            if each.status == "LISTEN"
        ]
        assert len(listening) == 3
        assert set(listening) == {"127.0.0.1"}
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        process.stderr.close()
    until(lambda: not children[0].is_running() or children[0].status() == psutil.STATUS_ZOMBIE)
