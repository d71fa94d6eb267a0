"""Test the monitor page's text for different page sizes, streams, states and key presses."""

import json
import math
import time
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.color import ColorTriplet
from rich.console import Console
from rich.style import Style
from rich.text import Text

from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.tools.terminal import heatmap
from softfinger.tools.terminal.heatmap import picture, resample
from softfinger.tools.terminal.monitor import HandKeys
from softfinger.tools.terminal.monitor_page import MonitorPage
from softfinger.tools.terminal.stream_state import Commander, ShownReply, StreamState, judge
from softfinger.tools.terminal.terminal import KeyDecoder
from tests.conftest import until
from tests.harness import fake_daemon


def fed(now: float = 0.0) -> StreamState:
    feed = StreamState()
    for k in range(50):
        give(feed, b"hand/state", fake_daemon.state(0.02 * k, k) | {"mono_ns": 20_000_000 * k}, now)
    for side in (0, 1):
        give(feed, b"hand/tactile", fake_daemon.frame(1.0, side), now)
    return feed


def give(feed: StreamState, topic: bytes, record: object, now: float = 0.0) -> None:
    feed.read([topic, msgpack.packb(record)], now)


def shown(
    feed: StreamState, now: float = 0.0, width: int = 80, height: int = 24, **more: Any
) -> str:
    reply = more.pop("reply", None)
    lines = MonitorPage(feed, "tcp://127.0.0.1:9872", **more).lines(width, height, now, reply)
    return check(lines, width, height)


def check(lines: Sequence[Text], width: int, height: int) -> str:
    assert [line.cell_len for line in lines] == [width] * height
    assert all(line.plain.isprintable() for line in lines)
    return "\n".join(line.plain for line in lines)


@pytest.mark.parametrize("size", [(80, 24), (81, 25), (100, 30), (120, 40), (200, 24), (80, 90)])
def test_the_page_fills_the_terminal_exactly(size):
    text = shown(fed(), width=size[0], height=size[1])
    for part in ("HOLDING", "LEFT contact", "RIGHT", "joint", "overruns", "events", "q quit"):
        assert part in text


@pytest.mark.parametrize("size", [(79, 24), (80, 23), (30, 8), (1, 1), (12, 3)])
def test_a_terminal_that_is_too_small_is_reported(size):
    text = shown(fed(), width=size[0], height=size[1])
    assert size[0] < 30 or f"this terminal: {size[0]} × {size[1]}" in text


def test_unknown_values_are_shown_as_dashes():
    text = shown(StreamState())
    assert "waiting for a daemon" in text
    assert text.count("—") >= 22
    assert "nan" not in text


def test_a_missing_finger_is_marked():
    feed = fed()
    state = fake_daemon.state(1.0, 100)
    state["right"] |= {"valid": False, "invalid": Invalid.ABOVE_ZERO.text}
    give(feed, b"hand/state", state)
    text = shown(feed)
    assert "right not valid: all cells read above zero: tare" in text
    assert "right —" in text
    assert "left —" not in text


def test_columns_are_kept_for_numbers_of_any_size():
    feed = fed()
    for value in (1e12, -1e12, 123456.0, -99.99, 1e-30, math.inf, math.nan):
        state = fake_daemon.state(1.0, 200)
        for name in ("left", "right"):
            state[name] = {
                key: value if isinstance(old, float) else old for key, old in state[name].items()
            }
        state |= {"tick_s": value, "compute_s": value, "overruns": value}
        state["object"] = {"valid": True, "angle": value, "width": value}
        give(feed, b"hand/state", state)
        lines = shown(feed).splitlines()
        assert any(line[23:].startswith("energy  ") and line[54:57] == "mJ " for line in lines)


def test_long_and_wide_texts_are_truncated():
    feed = fed()
    give(feed, b"hand/event", fake_daemon.event(1, "kind" * 9, "手指 force ÷ " * 40, "error"))
    give(feed, b"hand/state", fake_daemon.state(1.0, 99) | {"fault": "過 " * 90, "mode": "m" * 99})
    text = shown(feed, reply=ShownReply(0.0, False, "grasp: " + "長い " * 60))
    assert "…" in text
    assert "✗ grasp" in text
    assert "c clears it" in text


def test_stream_status_follows_the_age_of_data():
    feed = fed()
    assert [feed.status(now) for now in (0.4, 0.6, 1.9, 2.1)] == ["live", "stale", "stale", "lost"]
    assert "◐ stale" in shown(feed, 0.6)
    slow = StreamState()
    for k in range(100):  # With one state per second, a pause of 2 s is normal.
        give(slow, b"hand/state", fake_daemon.state(k, k) | {"mono_ns": k * 10**9}, float(k))
    assert [slow.status(99 + age) for age in (2.0, 4.0, 11.0)] == ["live", "stale", "lost"]


def test_rates_are_those_of_states_and_ticks():
    feed = StreamState()
    assert math.isnan(feed.rate)
    give(feed, b"hand/stats", {"rates": {"tick": 400.0}}, 0.0)
    assert "tick 400 Hz" in shown(feed)
    for k in range(300):
        state = fake_daemon.state(0.01 * k, k) | {"mono_ns": (k + 1) * 10**7}
        give(feed, b"hand/state", state, 0.01 * k)
    assert feed.rate == pytest.approx(100.0)


def test_a_busy_machine_is_reported_while_a_simulated_hand_waits():
    feed = StreamState()
    states = [fake_daemon.state(1.0, seq) | {"mono_ns": 10**9 * (seq - 98)} for seq in (99, 100)]
    give(feed, b"hand/state", states[0] | {"behind_s": 1.55}, 10.0)
    assert "busy" not in shown(feed, 10.0)
    give(feed, b"hand/state", states[1] | {"behind_s": 1.9}, 10.01)
    said = "this machine is busy: the simulated hand runs 0.35 s behind (1.90 s in total)"
    assert said in shown(feed, 10.02)
    assert "busy" not in shown(feed, 13.1)


def test_a_new_daemon_resets_the_rate():
    feed = StreamState()
    for k in range(10):
        state = fake_daemon.state(0.0, 1000 + k) | {"mono_ns": (k + 1) * 10**7}
        give(feed, b"hand/state", state, 3.0)
    assert feed.rate == pytest.approx(100.0)
    give(feed, b"hand/state", fake_daemon.state(0.0, 1), 3.0)
    assert math.isnan(feed.rate)


def test_servo_temperature_is_shown():
    feed = fed()
    state = fake_daemon.state(1.0, 99)
    state["left"]["temperature"], state["right"]["temperature"] = 0.0, 71.5
    state["right"]["time_to_limit"] = 42.0
    give(feed, b"hand/state", state)
    (line,) = [each for each in shown(feed).splitlines() if "servo" in each]
    assert line.split()[line.split().index("servo") :][:4] == ["servo", "—", "71.5", "°C"]
    warned = json.dumps({"safety": {"heat_warn": 60.0}, "commands": {"lease": 5.0}})

    def style_of_the_hot_one() -> object:
        lines = MonitorPage(feed, "").lines(80, 24, 0.0, None)
        segments = (part for each in lines for part in each.render(Console()))
        return next(part.style for part in segments if "71.5" in part.text)

    before = style_of_the_hot_one()
    give(feed, b"hand/settings", {"settings": warned})
    assert style_of_the_hot_one() != before


def told(seq: int, when: float, text: str, again: bool = False) -> dict[str, Any]:
    times = {"timestamp": when, "mono_ns": int(1e9 * when)}
    return fake_daemon.event(seq, "mode", text) | times | {"again": again}


TEXTS = ["first", "second", "third"]


def test_repeated_events_are_shown_once_and_in_order():
    feed = StreamState()
    # The third event arrives as a new event before the events are repeated.
    give(feed, b"hand/event", told(3, 103.0, "third"))
    for seq, text in enumerate(TEXTS, 1):
        give(feed, b"hand/event", told(seq, 100.0 + seq, text, True))
    assert [event.text for event in feed.events] == TEXTS
    assert [event.text for event in feed.news()] == ["third", "first", "second"]
    assert feed.news() == []
    for seq in (1, 2):  # A restarted daemon counts from 1 again.
        give(feed, b"hand/event", told(seq, 200.0 + seq, f"anew {seq}", True))
        give(feed, b"hand/event", told(seq, 200.0 + seq, f"anew {seq}", True))
    assert [event.text for event in feed.events][3:] == ["anew 1", "anew 2"]


def test_the_commander_is_shown_during_its_lease():
    feed = fed()
    give(feed, b"hand/settings", {"settings": json.dumps({"commands": {"lease": 5.0}})})
    carried_out = {"command": "grasp", "client": "note\x1bbook", "ok": True, "error": ""}
    give(feed, b"hand/command", carried_out, 0.0)
    assert "note book commands the hand" in shown(feed, 4.9)
    assert "commands the hand" not in shown(feed, 5.1)
    # A stop neither requires a lease nor takes one.
    give(feed, b"hand/command", carried_out | {"command": "stop"}, 6.0)
    assert "commands the hand" not in shown(feed, 6.1)
    give(feed, b"hand/command", carried_out | {"client": ""}, 7.0)
    # A client without a name may be the page itself.
    assert "commands the hand" not in shown(feed, 7.1)
    refused = carried_out | {"ok": False, "error": "grasp: arm first", "timestamp": 5.0}
    give(feed, b"hand/command", refused, 8.0)
    assert "refused   grasp: arm first (to note book)" in shown(feed, 8.0)


@pytest.mark.parametrize("keys", [True, False])
def test_long_reasons_are_shown_in_full_at_the_minimum_size(keys):
    feed = fed()
    fault = "left: no sound tactile frame for 0.31 s while gripping, more than 0.3 s: torque is off"
    give(feed, b"hand/state", fake_daemon.state(1.0, 99) | {"mode": "fault", "fault": fault})
    why = "clear: left: no sound tactile frame for 12.42 s while gripping, more than 0.3 s allowed"
    text = shown(feed, reply=ShownReply(0.0, False, why), keys=keys)
    flat = " ".join(text.split())
    assert fault in flat
    assert ("c clears it" if keys else "softfinger send clear") in flat
    assert f"✗ {why[:60]}" in flat


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=6,
)
FIELDS = ["schema", "seq", "mode", "fault", "tick_s", "left", "right", "object", "level", "text"]
FIELDS += ["timestamp", "mono_ns", "finger", "rows", "cols", "scale", "data", "kind"]
FIELDS += ["settings", "command", "client", "ok", "error", "again", "wake", "compute"]


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(
                [
                    *(b"hand/state", b"hand/tactile", b"hand/event", b"else"),
                    *(b"hand/stats", b"hand/command", b"hand/settings"),
                ]
            ),
            st.dictionaries(st.sampled_from(FIELDS), VALUES, max_size=8) | VALUES,
        ),
        max_size=4,
    ),
    st.lists(st.lists(st.binary(max_size=20), max_size=4), max_size=3),
)
def test_no_stream_content_breaks_the_page(records, garbage):
    feed = StreamState()
    for topic, record in records:
        give(feed, topic, record)
    for message in garbage:
        feed.read(message, 0.0)
    shown(feed)
    give(feed, b"hand/state", fake_daemon.state(1.0, 2**63))
    assert "HOLDING" in shown(feed)


def test_a_frame_with_a_wrong_size_is_skipped():
    feed = StreamState()
    good = fake_daemon.frame(0.0, 0, size=8)
    for change in ({"rows": 9}, {"cols": -8, "rows": -8}, {"rows": True}, {"finger": "thumb"}):
        give(feed, b"hand/tactile", good | change)
    assert (feed.skipped_count, feed.frames) == (4, {})
    give(feed, b"hand/tactile", good)
    assert feed.frames["left"].grid.shape == (8, 8)


def test_key_sequences():
    keys = KeyDecoder()
    assert keys.decode(b"ag \x1b[C\x1bOD\x1b[A\x1b[1;5Cq\xc3\xa9\x07") == [
        *("a", "g", " "),
        *("right", "left", "q"),
    ]
    assert keys.decode(b"\x1b") == []
    assert keys.decode(b"[") == []
    assert keys.decode(b"D") == ["left"]  # Three reads together form one key sequence.
    keys.decode(b"\x1b")
    keys.settle()
    assert keys.decode(b"g") == ["g"]  # The earlier Escape has no effect on the key.
    assert keys.decode(b"a\x1b[200~go") == ["a"]
    assert keys.decode(b"go\x1b[20") == []
    assert keys.decode(b"1~q") == ["q"]


def test_resampling_equals_the_area_average():
    grid = np.random.default_rng(1).random((44, 44))
    blocks = grid.reshape(22, 2, 11, 4).mean(axis=(1, 3))
    assert resample(grid, 22, 11) == pytest.approx(blocks, abs=1e-12)
    assert resample(grid, 88, 132) == pytest.approx(np.kron(grid, np.ones((2, 3))), abs=1e-12)
    # If one size is not a multiple of the other, the reference uses a finer grid, whose size is a
    # multiple of both.
    fine = np.kron(grid, np.ones((17, 9)))
    twin = fine.reshape(17, 44, 9, 44).mean(axis=(1, 3))
    assert resample(grid, 17, 9) == pytest.approx(twin, abs=1e-12)


def test_row_0_is_at_the_bottom_and_column_0_on_the_left():
    grid = np.zeros((4, 4))
    grid[0, 0] = 1.0
    lines = picture(grid, 1.0, 2, 4, True)
    lowest = lines[-1].spans[0]
    assert (lowest.start, lowest.end) == (0, 1)
    assert isinstance(lowest.style, Style)
    brightest = heatmap.colour_map()[-1]
    assert lowest.style.bgcolor.get_truecolor() == ColorTriplet(*brightest)
    assert [line.plain for line in picture(grid, 1.0, 4, 4, False)] == [
        "    ",
        "    ",
        "    ",
        "█   ",
    ]


@pytest.mark.parametrize("label", ["", " "])
def test_a_refusal_of_a_command_without_a_name_is_shown(label):
    shown = judge(1.0, label, {"ok": False, "error": "found no command"})
    assert shown.text.endswith("found no command")


def test_a_turn_starts_at_the_goal_that_another_client_has_set():
    feed, sent = fed(), []
    commander: Any = SimpleNamespace(reply=None, send=lambda *_, **more: sent.append(more["angle"]))
    keys = HandKeys(feed, commander)

    def rotated(goal: float) -> None:
        give(feed, b"hand/state", fake_daemon.state(1.0, 50) | {"goal_angle": math.radians(goal)})

    rotated(5.0)
    keys.press("right", 0.0)
    keys.press("right", 0.1)  # The stream still contains the old goal.
    rotated(14.98)
    keys.press("right", 5.0)
    rotated(-10.0)  # Another client has rotated the object.
    keys.press("right", 10.0)
    assert np.degrees(sent) == pytest.approx([9.98, 14.98, 19.98, -5.0])


def test_a_stop_overtakes_and_discards_waiting_commands(tmp_path):
    def received() -> tuple[list[bytes], str]:
        assert daemon.poll(60_000)
        *route, request = daemon.recv_multipart()
        return route, msgpack.unpackb(request)["command"]

    with zmq.Context() as context, context.socket(zmq.ROUTER) as daemon:
        address = f"ipc://{tmp_path}/commands"
        daemon.bind(address)
        commander = Commander(address)
        for name in ("arm", "grasp"):
            commander.send(time.monotonic(), name, name)
        arm, name = received()
        assert name == "arm"
        commander.send(time.monotonic(), "stop", "stop")
        assert received()[1] == "stop"
        daemon.send_multipart([*arm, msgpack.packb({"ok": True})])
        until(lambda: commander.reply is not None)
        assert commander.reply == (commander.reply.at, True, "arm: ok")
        commander.send(time.monotonic(), "release", "release")
        assert received()[1] == "release"  # The grasp was discarded.
        daemon.setsockopt(zmq.LINGER, 0)
