"""Test that replaying a recording publishes unchanged messages or recomputes identical states."""

import copy
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import pytest
import zmq

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.profile.load import load
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import pack
from softfinger.tools.recordings import replay
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.recomputed import recompute
from tests.conftest import until
from tests.harness.daemon_process import PATIENT, softfinger, started
from tests.harness.golden_recording import MADE_ON, RECORDING, machine_class
from tests.harness.golden_wire import sample
from tests.harness.recorded_hand import record_hand, write_recording

Messages = list[tuple[bytes, dict[str, Any]]]


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Messages:
    """Return all messages published during a grasp, a turn, a refused command and a stop."""
    due = {
        50: {"command": "arm"},
        51: {"command": "grasp", "force": 6.0},
        750: {"command": "move", "left": 0.1},  # A hand that holds an object refuses this command.
        800: {"command": "rotate", "angle": 0.1},
        1100: {"command": "stop"},
    }
    path = tmp_path_factory.mktemp("recorded") / "taken.mcap"
    assert len(record_hand(path, due, 2.3, ("stream.state_rate=500",))) == 1
    sent = list(Recording(path).messages())
    states = [message for topic, message in sent if topic == schema.STATE]
    assert states[-1]["mode"] == "disarmed"
    return sent


def test_equal_inputs_give_bitwise_equal_states(taken, tmp_path):
    result = recompute(write_recording(tmp_path / "a.mcap", taken))
    assert result.from_start
    assert result.ticks == result.states == 1150
    assert result.fields > 40
    assert (result.missing_ticks, result.missing_frames) == (0, 0)
    assert result.differences == {}


def test_other_settings_report_the_first_difference(taken, tmp_path):
    recording = write_recording(tmp_path / "a.mcap", taken)
    used = load(changes=["loop.clock=virtual", "stream.state_rate=500", "control.force_gain=0.5"])
    result = recompute(recording, used)
    assert "left.goal_current" in result.differences
    assert "left.q" not in result.differences  # The inputs are unchanged.
    different = result.differences["left.goal_current"]
    assert different.first_tick > 50  # The first difference occurs after arming.
    assert different.worst > 1e-3
    assert different.recorded != different.recomputed


def test_a_changed_reading_is_detected(taken, tmp_path):
    bent = copy.deepcopy(taken)
    for topic, message in bent:
        if topic == schema.INPUT and message["seq"] == 400:
            message["left"]["q"] += 1e-9
    result = recompute(write_recording(tmp_path / "a.mcap", bent))
    assert result.differences["left.q"].count == 1
    assert result.differences["left.q"].first_tick == 400
    assert min(each.first_tick for each in result.differences.values()) == 400


def test_missing_data_in_a_recording_is_reported(taken, tmp_path):
    def without(topic: bytes) -> Recording:
        path = tmp_path / f"{topic.decode().replace('/', '-')}.mcap"
        return write_recording(path, [each for each in taken if each[0] != topic])

    with pytest.raises(RecordingError, match="does not contain hand/settings"):
        recompute(without(schema.SETTINGS))
    with pytest.raises(RecordingError, match="does not contain hand/input"):
        recompute(without(schema.INPUT))
    blind = recompute(without(schema.TACTILE))
    assert blind.missing_frames > 100
    assert blind.differences
    late = recompute(write_recording(tmp_path / "late.mcap", taken[:1] + taken[2000:]))
    assert not late.from_start
    some = [each for k, each in enumerate(taken) if each[0] != schema.INPUT or k % 7]
    assert recompute(write_recording(tmp_path / "some.mcap", some)).missing_ticks > 10
    thinned = [(topic, {**message}) for topic, message in taken]
    for topic, message in thinned:
        if topic == schema.TACTILE:
            message["seq_step"] = 4
    with pytest.raises(RecordingError, match="found only 1 of 4 frames"):
        recompute(write_recording(tmp_path / "thinned.mcap", thinned))
    with pytest.raises(RecordingError, match="found tick 1 after tick"):
        recompute(write_recording(tmp_path / "restarted.mcap", taken[:200] + taken[:200]))
    other = load(changes=["tactile.rows=32", "tactile.cols=32"])
    with pytest.raises(RecordingError, match="44 × 44 cells, expected 32 × 32 as in the settings"):
        recompute(write_recording(tmp_path / "other.mcap", taken), other)


def test_a_task_that_a_client_ends_recomputes_bitwise(tmp_path):
    """The live hand ignores silence during a task, but not after a client has taken over."""
    due = {1000: {"command": "grasp", "force": 5.0}}
    used = ("stream.state_rate=500", "commands.lease=0.2", "commands.on_silence=release")
    path = tmp_path / "task.mcap"
    assert record_hand(path, due, 2.5, (*used, "task.name=demo")) == []
    sent = list(Recording(path).messages())
    modes = [message["mode"] for topic, message in sent if topic == schema.STATE]
    assert [modes[k] for k in (998, 1098, 1110)] == ["holding", "holding", "releasing"]
    assert recompute(Recording(path)).differences == {}


def test_a_daemon_recorded_from_its_first_tick_recomputes_bitwise(profile, tmp_path, inline):
    path = tmp_path / "run.mcap"
    # At this low data rate, no messages are lost while the recorder waits for a processor.
    slow = "tactile.rows = 16\ntactile.cols = 16\ntactile.pitch = 0.0036\ntactile.rate = 20.0\n"
    words = ("--duration", "3", "--set", "task.name=demo", "--record", str(path))
    done = softfinger("run", "--config", str(profile(slow)), *words, *PATIENT)
    assert done.returncode == 0, done.stderr
    assert "lost: none" in done.stderr
    told = inline("replay", path, "--recompute")
    assert (told.returncode, told.stderr) == (0, "")
    assert "all states are bit-identical" in told.stdout
    assert "starts after the first tick" not in told.stdout
    ticks = re.search(r"(\d+) ticks, ", told.stdout)
    assert ticks is not None
    assert int(ticks[1]) > 100
    # The changed setting changes the goals, even if a slow machine prevented the grip.
    other = tmp_path / "other.toml"
    other.write_text(profile(slow + "safety.current_move = 0.3\n", "base.toml").read_text())
    told = inline("replay", path, "--recompute", "--config", other)
    assert told.returncode == 3
    assert "left.goal_current" in told.stdout


def test_a_recorder_that_cannot_start_prevents_the_first_tick(profile, tmp_path, inline):
    path = tmp_path / "run.mcap"
    path.write_text("mine")
    done = inline("run", "--config", profile(""), "--record", path, "--log", "json")
    assert done.returncode == 1
    last = json.loads(done.stderr.splitlines()[-1])
    assert last["level"] == "error"
    assert "already exists; choose another file" in last["text"]
    assert path.read_text() == "mine"


@pytest.fixture
def played(tmp_path: Path) -> tuple[Path, Messages]:
    sent: Messages = []
    for k in range(100):
        state = {**sample(schema.STATE), "seq": k, "timestamp": 1e9 + 0.01 * k}
        sent.append((schema.STATE, state))
    sent.append((schema.TACTILE, {**sample(schema.TACTILE), "timestamp": 1e9 + 0.5}))
    path = tmp_path / "a.mcap"
    write_recording(path, sent)
    return path, sent


def test_messages_are_published_unchanged(played, addresses, context):
    path, sent = played
    socket = context.socket(zmq.SUB)
    socket.setsockopt(zmq.SUBSCRIBE, b"")
    socket.connect(addresses[0])
    process = started("replay", path, "--address", addresses[0], "--speed", "20")
    came: list[list[bytes]] = []
    until(lambda: (socket.poll(10) and came.append(socket.recv_multipart()), len(came) == 101)[1])
    assert [(topic, msgpack.unpackb(payload)) for topic, payload in came] == sent
    assert [payload for _, payload in came] == [pack(message) for _, message in sent]
    assert "101 of 101 messages published" in process.communicate(timeout=300)[0]


def test_a_time_range_is_replayed_at_the_original_rate(played, addresses, inline):
    words = ("--address", addresses[0], "--no-wait", "--from", "0.2", "--to", "0.4")
    done = inline("replay", played[0], *words)
    assert done.stdout.startswith(("20 of", "21 of"))


def test_the_settings_are_published_before_a_later_part(tmp_path, inline, monkeypatch):
    messages = [(schema.SETTINGS, sample(schema.SETTINGS) | {"timestamp": 1e9, "mono_ns": 10**11})]
    for k in range(100):
        times = {"timestamp": 1e9 + 0.01 * k, "mono_ns": 10**11 + k * 10**7}
        messages.append((schema.STATE, sample(schema.STATE) | times | {"seq": k}))
    write_recording(tmp_path / "a.mcap", messages)
    sent: Messages = []
    monkeypatch.setattr(replay, "Wire", SilentWire)
    monkeypatch.setattr(SilentWire, "send", lambda _, *message: sent.append(message))
    clock = SimpleNamespace(monotonic=lambda: SilentWire.waited)
    monkeypatch.setattr(replay, "time", clock)
    inline("replay", tmp_path / "a.mcap", "--no-wait", "--from", "0.5")
    assert [topic for topic, _ in sent] == [schema.SETTINGS] + 50 * [schema.STATE]
    assert sent[0][1]["again"] is True
    assert SilentWire.waited == pytest.approx(0.49, abs=0.02)
    sent.clear()
    inline("replay", tmp_path / "a.mcap", "--no-wait", "--from", "0")
    assert [message for _, message in sent] == [message for _, message in messages]


class SilentWire:
    """Replace `Wire`: publish nothing, and count the time that the replay would wait."""

    def __init__(self, *_: object) -> None:
        SilentWire.waited = 0.0

    def subscribed(self, seconds: float) -> None:
        SilentWire.waited += seconds

    def send(self, *_: object) -> None:
        pass

    def __enter__(self) -> "SilentWire":
        return self

    def __exit__(self, *_: object) -> None:
        pass


@pytest.mark.parametrize("step", [{"timestamp": 12.0}, {"mono_ns": -(10**10)}])
def test_the_pace_does_not_depend_on_changes_of_a_clock(tmp_path, inline, monkeypatch, step):
    messages = []
    for k in range(100):
        message = sample(schema.STATE) | {
            "timestamp": 1e9 + 0.01 * k,
            "mono_ns": 10**11 + k * 10**7,
        }
        if k >= 50:
            message |= {name: message[name] + size for name, size in step.items()}
        messages.append((schema.STATE, message))
    write_recording(tmp_path / "a.mcap", messages)
    monkeypatch.setattr(replay, "Wire", SilentWire)
    clock = SimpleNamespace(monotonic=lambda: SilentWire.waited)
    monkeypatch.setattr(replay, "time", clock)
    done = inline("replay", tmp_path / "a.mcap", "--no-wait")
    assert done.stdout == "100 of 100 messages published\n"
    assert SilentWire.waited == pytest.approx(0.99, abs=0.02)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--recompute", "--from", "0"), "remove --from, --to and --speed"),
        (("--recompute", "--to", "2"), "remove --from, --to and --speed"),
        (("--recompute", "--speed", "3"), "remove --from, --to and --speed"),
        (("--config", "sim", "--no-wait", "--to", "0.01"), "--config requires --recompute"),
    ],
)
def test_options_without_effect_are_rejected(played, addresses, inline, words, reason):
    done = inline("replay", played[0], "--address", addresses[0], *words)
    assert (done.returncode, reason in done.stderr) == (2, True)


def test_the_golden_recording_gives_the_same_states() -> None:
    result = recompute(Recording(RECORDING))
    assert result.from_start
    assert (result.ticks, result.states) == (1000, 1000)
    assert (result.missing_ticks, result.missing_frames) == (0, 0)
    if json.loads(MADE_ON.read_text(encoding="utf-8")) == machine_class():
        assert result.differences == {}, "states are not bit-identical"
    for name, difference in result.differences.items():
        assert isinstance(difference.recorded, float), f"{name}: {difference}"
        assert difference.worst < 1e-9, f"{name}: {difference}"
