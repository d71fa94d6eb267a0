"""Test that a recording contains all messages published until the recorder was interrupted."""

import contextlib
import errno
import json
import math
import os
import re
import resource
import signal
import subprocess
import tracemalloc
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import psutil
import pytest
import zmq

from softfinger import Hand, read_recording
from softfinger.daemon.errors import RecordingError
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import pack
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.record import RecordingWriter, recover
from tests.conftest import until
from tests.harness.daemon_process import ask, started
from tests.harness.fake_daemon import frame
from tests.harness.golden_wire import sample
from tests.harness.recorded_hand import write_recording

TOPICS = tuple(schema.TOPICS)
EVENT = schema.EVENT


def record(*words: object, **options: Any) -> subprocess.Popen[str]:
    return started("record", *words, **options)


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, error = process.communicate(timeout=300)
    return process.returncode, out, error


def interrupted(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Stop a recorder with Ctrl-C."""
    process.send_signal(signal.SIGINT)
    return ended(process)


def is_filled(path: Path) -> bool:
    """Return True if the file contains a complete chunk of messages."""
    return path.exists() and path.stat().st_size > 3000 and Recording(path).total > 0


def written(path: Path, count: int = 400) -> list[tuple[bytes, dict[str, Any]]]:
    """Write a recording of ``count`` states and one frame per ten states; return all messages."""
    sent: list[tuple[bytes, dict[str, Any]]] = []
    for k in range(count):
        times = {"timestamp": 1e9 + k, "mono_ns": k * 10**9}
        sent.append((schema.STATE, {**sample(schema.STATE), "seq": k, **times}))
        if k % 10 == 0:
            sent.append((schema.TACTILE, frame(k / 25, k % 20 // 10) | times))
    write_recording(path, sent)
    return sent


def test_read_messages_equal_the_published_ones(tmp_path):
    sent = written(tmp_path / "a.mcap")
    recording = Recording(tmp_path / "a.mcap")
    read = list(recording.messages())
    assert read == sent
    # All values keep their types, so the messages can be published again byte for byte.
    for (_, before), (_, after) in zip(sent, read, strict=True):
        assert {key: type(value) for key, value in before.items()} == {
            key: type(after[key]) for key in before
        }
    assert not recording.truncated
    assert recording.duration == 399.0
    assert recording.count(schema.STATE) == 400
    assert recording.counts["hand/tactile/left"] == 20


def test_states_of_a_recording_are_columns(tmp_path):
    states = [message for topic, message in written(tmp_path / "a.mcap") if topic == schema.STATE]
    columns = read_recording(tmp_path / "a.mcap")
    assert columns["seq"].tolist() == list(range(400))
    assert columns["left.force"].tolist() == [each["left"]["force"] for each in states]
    assert columns["mode"][0] == states[0]["mode"]
    assert columns["t"].tolist() == pytest.approx(range(400))
    assert {len(column) for column in columns.values()} == {400}
    write_recording(tmp_path / "b.mcap", [(schema.TACTILE, frame(0.0, 0) | {"timestamp": 1e9})])
    with pytest.raises(RecordingError, match=r"b\.mcap: the recording does not contain hand/state"):
        read_recording(str(tmp_path / "b.mcap"))


@pytest.mark.parametrize("topic", TOPICS)
def test_every_topic_keeps_its_bytes_and_has_a_schema(tmp_path, topic):
    from mcap.reader import make_reader

    path = tmp_path / "a.mcap"
    [(told, message)] = write_recording(path, [(topic, sample(topic))]).messages()
    assert told == topic
    golden = msgpack.unpackb(pack(sample(topic)))
    assert message == golden
    with path.open("rb") as file:
        [(schema, channel, raw)] = make_reader(file).iter_messages()
    assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
    described = json.loads(schema.data)["properties"]
    assert set(json.loads(raw.data)) == set(described)
    assert raw.log_time == int(golden["timestamp"] * 1e9)
    if topic == EVENT:  # Foxglove requires this layout.
        line = json.loads(raw.data)
        assert schema.name == "foxglove.Log"
        assert (golden["level"], line["level"]) == ("warning", 3)
        assert (line["message"], line["name"]) == (golden["text"], golden["kind"])
        seconds = line["timestamp"]["sec"] + 1e-9 * line["timestamp"]["nsec"]
        assert seconds == pytest.approx(golden["timestamp"])


def test_the_layout_uses_only_published_fields():
    folder = Path(__file__).parents[2] / "tools" / "viewing"
    fields = {
        f"{topic.decode()}/{each.name.replace('.', '/')}"
        for topic in TOPICS
        for each in schema.TOPICS[topic].fields
    }
    paths = re.findall(
        r'"value": *"(hand/\w+\.[^"]+)"', (folder / "foxglove_layout.json").read_text()
    )
    assert paths
    assert {each.replace(".", "/") for each in paths} <= fields


def test_non_finite_numbers_are_read_as_nan(tmp_path):
    message = sample(schema.STATE)
    message["left"]["force"] = math.nan
    message["tick_s"] = math.inf
    messages = [(schema.STATE, each) for each in (message, {"seq": 2**70, "left": {1, 2}})]
    recording = write_recording(tmp_path / "a.mcap", messages)
    assert recording.total == 1
    [(_, read)] = recording.messages()
    assert math.isnan(read["left"]["force"])
    assert math.isnan(read["tick_s"])  # JSON cannot represent infinity.


@pytest.mark.extended
def test_reading_a_time_range_and_selected_topics(tmp_path):
    sent = written(tmp_path / "a.mcap", 2000)  # The recording contains several chunks.
    recording = Recording(tmp_path / "a.mcap")
    part = [each for each in sent if 499.5 <= each[1]["timestamp"] - 1e9 <= 600.5]
    assert list(recording.messages(start=499.5, end=600.5)) == part
    seen: list[int] = []
    frames = list(recording.messages([schema.TACTILE], progress=seen.append))
    assert frames == [each for each in sent if each[0] == schema.TACTILE]
    assert seen == sorted(seen)
    assert len(seen) > 3


def test_a_truncated_recording_is_readable_up_to_the_cut_and_can_be_closed(tmp_path):
    sent = written(tmp_path / "whole.mcap", 1500)
    whole = (tmp_path / "whole.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    rng = np.random.default_rng(1)
    longest = 0
    for cut in [9, 40, len(whole) - 1, *rng.integers(50, len(whole), 3)]:
        path.write_bytes(whole[:cut])
        recording = Recording(path)
        assert recording.truncated
        read = list(recording.messages())
        assert read == sent[: len(read)]
        longest = max(longest, len(read))
        count, damage = recover(path)
        assert (count, bool(damage)) == (len(read), True)
        closed = Recording(path)
        assert not closed.truncated
        assert list(closed.messages()) == read
    assert longest > 1000
    assert recover(path) == (len(read), "")  # An intact file is not changed.
    assert sorted(each.name for each in tmp_path.iterdir()) == ["cut.mcap", "whole.mcap"]


def test_a_recording_that_cannot_be_repaired_is_unchanged(tmp_path, monkeypatch):
    def full_disk(_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "cut.mcap"
    written(path)
    path.write_bytes(cut := path.read_bytes()[:-100])
    monkeypatch.setattr(RecordingWriter, "_wrote", full_disk)
    why = (
        r"cut\.mcap: .* can't be written: No space left on device; the original file is unchanged$"
    )
    with pytest.raises(RecordingError, match=why):
        recover(path)
    assert (path.read_bytes(), [*tmp_path.iterdir()]) == (cut, [path])


def test_a_recording_with_flipped_bits_raises_only_its_documented_error(tmp_path):
    written(tmp_path / "whole.mcap", 300)
    whole = (tmp_path / "whole.mcap").read_bytes()
    path = tmp_path / "bent.mcap"
    rng = np.random.default_rng(2)
    whole_again = 0
    for _ in range(50):
        bent = bytearray(whole)
        for place in rng.integers(0, len(whole), 3):
            bent[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bent)
        with contextlib.suppress(RecordingError):
            recording = Recording(path)
            read = list(recording.messages())
            whole_again += len(read) == 330 and not recording.truncated
    assert whole_again < 25


def test_other_files_are_rejected(tmp_path):
    path = tmp_path / "a.mcap"
    for content, reason in ((b"", "empty"), (b"seq,d\n1,2\n", "not an MCAP file")):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=reason):
            Recording(path)
    with pytest.raises(RecordingError, match="No such file"):
        Recording(tmp_path / "none.mcap")
    with pytest.raises(RecordingError, match="already exists"):
        RecordingWriter(path)
    from mcap.writer import Writer

    with (tmp_path / "other.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="x")
        writer.finish()
    with pytest.raises(
        RecordingError,
        match=r"profile 'ros2' \(channels: none\), expected the profile 'softfinger'",
    ):
        Recording(tmp_path / "other.mcap")


def test_messages_lost_while_recording_a_daemon_are_counted(start, profile, addresses, tmp_path):
    start("--config", str(profile("loop.rate = 500.0\nstream.state_rate = 500.0\n")))
    path = tmp_path / "run.mcap"
    process = record(path, "--address", addresses[0])
    until(lambda: is_filled(path))
    assert ask(addresses[1], "arm")["ok"]
    with Hand(*addresses, timeout=60.0) as hand:
        hand.collect(0.5)
    status, out, error = interrupted(process)
    assert (status, error) == (0, "")
    recording = Recording(path)
    assert not recording.truncated
    seqs = [m["seq"] for _, m in recording.messages([schema.STATE])]
    assert len(seqs) > 10
    # The gateway loses messages if it gets no processor time. The recorder must report the exact
    # number of lost messages.
    told = re.search(rf"(\d+) of {schema.STATE}", out)
    assert seqs[-1] - seqs[0] + 1 - len(seqs) == (int(told[1]) if told else 0)
    kinds = {message["kind"] for _, message in recording.messages([schema.EVENT])}
    assert "mode" in kinds
    assert recording.count(schema.TACTILE) > 0


def test_a_full_disk_ends_the_recording_with_a_message_and_keeps_earlier_data(fake, tmp_path):
    path = tmp_path / "run.mcap"
    fake.changes = {"padding": os.urandom(10_000).hex()}  # These data are incompressible.

    def small_disk() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))

    process = record(path, "--address", fake.state_address, preexec_fn=small_disk)
    status, out, error = ended(process)
    assert status == 1
    assert "File too large" in error
    assert "--recover" in error
    total = Recording(path).total
    assert total > 10
    assert f"{total} messages written of " in out, (
        "the message must state the number of messages in the file"
    )


def test_messages_sent_before_the_end_are_written(addresses, tmp_path):
    context: zmq.Context[Any] = zmq.Context()
    publisher = context.socket(zmq.XPUB)
    publisher.setsockopt(zmq.SNDHWM, 0)
    publisher.bind(addresses[0])
    path = tmp_path / "run.mcap"
    process = record(path, "--address", addresses[0], "--topics", "state")
    assert publisher.poll(60_000)
    assert publisher.recv() == b"\x01hand/state"
    message = sample(schema.STATE)
    for k in range(4000):
        publisher.send(schema.STATE, zmq.SNDMORE)
        publisher.send(pack({**message, "seq": k}))
    context.destroy(linger=-1)  # The call returns after all messages are sent.
    process.send_signal(signal.SIGTERM)
    status, out, _ = ended(process)
    assert status == 0
    assert "4000 messages written; lost: none" in out
    seqs = [read["seq"] for _, read in Recording(path).messages()]
    assert seqs == list(range(4000))


def test_split_files_are_contiguous_and_contain_the_settings(fake, tmp_path):
    path = tmp_path / "run.mcap"
    files = [path, *(tmp_path / f"run-{number}.mcap" for number in range(2, 5))]
    fake.silent.set()
    process = record(path, "--address", fake.state_address, "--split-time", "0.2")
    settings = pack(sample(schema.SETTINGS))
    until(lambda: fake.send(schema.SETTINGS, settings) or files[1].exists())
    fake.silent.clear()
    until(files[-1].exists)
    status, out, _ = interrupted(process)
    assert status == 0
    files = sorted(tmp_path.iterdir(), key=lambda file: (len(file.name), file.name))
    read = [list(Recording(file).messages()) for file in files]
    seqs = [m["seq"] for each in read for topic, m in each if topic == schema.STATE]
    assert seqs == list(range(seqs[0], seqs[-1] + 5, 5))
    assert all(schema.SETTINGS in dict(each) for each in read)
    assert f"{sum(map(len, read))} messages written; lost: " in out


def test_the_recorder_waits_for_a_daemon_except_with_no_wait(
    addresses, tmp_path, inline, monkeypatch
):
    for limit in ("WAIT_MAX", "_SILENCE_TIME"):
        monkeypatch.setattr(f"softfinger.tools.recordings.record.{limit}", 0.1)
    done = inline("record", tmp_path / "a.mcap", "--address", addresses[0], "--no-wait")
    assert done.returncode == 1
    assert f"no stream from {addresses[0]} within 5 s" in done.stderr
    process = record(tmp_path / "b.mcap", "--address", addresses[0])
    assert "waiting for a stream" in process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    assert ended(process)[0] == 0
    assert not list(tmp_path.iterdir())  # The recorder deletes its empty file.


def test_invalid_messages_on_the_stream_are_counted_and_omitted(fake, tmp_path):
    path = tmp_path / "run.mcap"
    process = record(path, "--address", fake.state_address)
    until(lambda: is_filled(path))
    for _ in range(20):
        fake.send(b"hand/state", b"\xc1")
        fake.send(b"hand/else", msgpack.packb([1]))
    before = fake.published
    until(lambda: fake.published > before + 1)
    status, out, _ = interrupted(process)
    assert status == 0
    assert "could not be read and were skipped" in out


def test_topics_are_selected_by_name(fake, tmp_path):
    path = tmp_path / "a.mcap"
    process = record(path, "--address", fake.state_address, "--topics", "hand/tactile")
    until(lambda: path.exists() and path.stat().st_size > 20_000)
    assert interrupted(process)[0] == 0
    assert set(Recording(path).counts) == {"hand/tactile/left", "hand/tactile/right"}
    status, _, error = ended(record(tmp_path / "b.mcap", "--topics", "dreams"))
    assert status == 2
    assert "found topic 'dreams', expected 'all' or one of state, tactile" in error


def test_repeated_messages_do_not_extend_the_time_range(tmp_path):
    """If a recorder starts late, the daemon repeats the first events and the settings."""
    old = {"schema": 1, "seq": 1, "again": True, "timestamp": 1.7e9 - 7200.0, "mono_ns": 5}
    repeated = [(b"hand/settings", old)]
    states = [{"schema": 1, "seq": k, "timestamp": 1.7e9 + 0.25 * k} for k in range(3)]
    messages = [*repeated, *((b"hand/state", state) for state in states)]
    messages.append((b"hand/event", {**old, "seq": 2}))
    recording = write_recording(tmp_path / "a.mcap", messages)
    assert (recording.start, recording.duration) == (pytest.approx(1.7e9), pytest.approx(0.5))
    kept = [message for topic, message in recording.messages() if b"state" not in topic]
    # The messages keep their original times.
    assert [each["timestamp"] for each in kept] == [1.7e9 - 7200.0] * 2
    assert write_recording(tmp_path / "b.mcap", repeated).count(b"hand/settings") == 1


@pytest.mark.extended
def test_a_damaged_chunk_is_reported_and_skipped_and_the_file_can_be_recovered(
    tmp_path, addresses, inline
):
    path = tmp_path / "bent.mcap"
    sent = written(path, 2000)
    assert Recording(path).check()
    bent = bytearray(path.read_bytes())
    # A chunk starts with zstd's magic number.
    place = bent.index(b"\x28\xb5\x2f\xfd", len(bent) // 2) + 100
    bent[place : place + 4] = bytes(each ^ 0x55 for each in bent[place : place + 4])
    path.write_bytes(bent)
    told: list[str] = []
    recording = Recording(path, told.append)
    read = list(recording.messages())
    assert not recording.truncated
    assert len(told) == 1
    assert "damaged (" in told[0]
    assert 500 < len(read) < len(sent)
    assert read[0] == sent[0]
    assert read[-1] == sent[-1]  # The chunks after the damaged chunk are readable.
    fast = ("--no-wait", "--speed", "1e6", "--address", addresses[0])
    for words in (("export", "--topics", "state"), ("replay", *fast)):
        assert "damaged (" in inline(words[0], path, *words[1:]).stderr, words
    assert recover(path)[0] == len(read)
    assert Recording(path).check()


def test_a_closed_file_frees_its_memory(tmp_path):
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        writer = RecordingWriter(tmp_path / "a.mcap")
        for _ in range(2000):
            writer.add(schema.STATS, {"timestamp": 1e9})
            writer.flush()
        grown = tracemalloc.get_traced_memory()[0] - before
        writer.close()
        assert tracemalloc.get_traced_memory()[0] - before < 0.3 * grown
    finally:
        tracemalloc.stop()


# --- `run --record` --------------------------------------------------------------------------


def killed(recorder: psutil.Process, _: Path) -> None:
    recorder.kill()


def disk_full(recorder: psutil.Process, path: Path) -> None:
    most = path.stat().st_size + 1000
    recorder.rlimit(psutil.RLIMIT_FSIZE, (most, most))


@pytest.mark.parametrize(
    ("end", "why"),
    [
        pytest.param(
            killed,
            "ended by SIGKILL; `softfinger record --recover",
            marks=pytest.mark.extended,
        ),
        (disk_full, "File too large; the messages written so far can be read"),
    ],
    ids=["killed", "disk full"],
)
def test_a_recorder_failure_is_reported_immediately_and_by_the_exit_status(
    start, profile, addresses, tmp_path, end, why
):
    path = tmp_path / "run.mcap"
    daemon = start("--config", str(profile("")), "--record", str(path))
    children = psutil.Process(daemon.process.pid).children()
    [recorder] = [each for each in children if "record" in each.cmdline()]
    until(lambda: path.stat().st_size > 10_000)
    with Hand(*addresses, timeout=60.0) as hand, hand.events(timeout=60.0) as events:
        hand.state()
        end(recorder, path)
        event = next(event for event in events if event.kind == "record")
        assert (event.level, why in event.text) == ("error", True), event.text
    assert daemon.end() == 1
    assert any("is incomplete" in line for line in daemon.lines)
    assert Recording(path).total > 0
    assert recover(path)[0] > 0
