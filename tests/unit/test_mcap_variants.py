"""Test MCAP recordings that other programs have merged, filtered or written without an index."""

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire import schema
from softfinger.tools.recordings.analyse import analyse, open_source
from softfinger.tools.recordings.channels import topic_of
from softfinger.tools.recordings.export import CsvTable, export
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.record import recover

GOLDEN = Path(__file__).parents[1] / "golden" / "grasp_and_turn.mcap"
SHORT = 300  # messages
BARE: dict[str, Any] = {
    "index_types": IndexType.NONE,
    "use_statistics": False,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_summary_offsets": False,
}


def golden() -> Iterator[Any]:
    with GOLDEN.open("rb") as file:
        yield from islice(make_reader(file).iter_messages(log_time_order=False), SHORT)


def rewritten(
    path: Path,
    profile: str = "",
    others: bool = False,
    ids: int = 1,
    prefix: str = "",
    merged: bool = False,
    **options: Any,
) -> Path:
    """Rewrite the golden recording with ``ids`` channels per topic; ``others`` adds more topics.

    ``merged`` writes the frames of both fingers to the same channel.
    """
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile, "merged")
        schemas: dict[str, int] = {}
        channels: dict[tuple[str, int], int] = {}
        if others:
            image = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"uint8[] data")
            camera = writer.register_channel("/camera/image", "cdr", image)
            pose = writer.register_channel("/robot/pose", "json", 0)
            writer.add_attachment(0, 0, "notes.txt", "text/plain", b"notes")
            writer.add_metadata("bench", {"by": "somebody"})
        for k, (kind, channel, message) in enumerate(golden()):
            times = message.log_time + 10**13, message.publish_time
            if others and k % 10 == 0:
                # This camera started an hour earlier.
                early = times[0] if k else times[0] - 3600 * 10**9
                writer.add_message(camera, early, b"\0\1" * 500, early)
                writer.add_message(pose, times[0], json.dumps({"pose": [1, [2]]}).encode(), 0)
            if kind.name not in schemas:
                schemas[kind.name] = writer.register_schema(kind.name, kind.encoding, kind.data)
            key = channel.topic, k % ids
            if key not in channels:
                name = prefix + (topic_of(channel.topic).decode() if merged else channel.topic)
                channels[key] = writer.register_channel(name, "json", schemas[kind.name])
            writer.add_message(channels[key], times[0], message.data, times[1])
        writer.finish()
    return path


VARIANTS: dict[str, dict[str, Any]] = {
    "an empty profile": {},
    "another profile": {"profile": "ros2"},
    "other channels": {"others": True},
    "several channels of a topic": {"ids": 3},
    "names with a slash": {"prefix": "/"},
    "one channel of frames": {"merged": True},
    "no chunks": {"use_chunking": False, "others": True},
    "no index": {"index_types": IndexType.NONE},
    "no statistics": {"use_statistics": False},
    "no channels in the summary": {"repeat_channels": False},
    "no summary": BARE,
    "no chunks and no summary": {**BARE, "use_chunking": False},
    "lz4": {"compression": CompressionType.LZ4},
    "no compression": {"compression": CompressionType.NONE},
    "one chunk": {"chunk_size": 1 << 28},
    "a chunk a message": {"chunk_size": 1, "others": True},
    "no checksums": {"enable_crcs": False},
}


@pytest.mark.parametrize("options", VARIANTS.values(), ids=VARIANTS)
def test_all_variants_of_the_format_give_the_same_recording(tmp_path, options):
    path = rewritten(tmp_path / "a.mcap", **options)
    told: list[str] = []
    recording = Recording(path, told.append)
    original = Recording(GOLDEN)
    wanted = list(islice(original.messages(), SHORT))
    assert list(recording.messages()) == wanted
    assert recording.total == SHORT
    assert recording.count(schema.STATE) == sum(topic == schema.STATE for topic, _ in wanted)
    times = [message.log_time * 1e-9 for _, _, message in golden()]
    # The camera's earlier start has no effect.
    assert recording.start == pytest.approx(min(times) + 1e4)
    assert recording.duration == pytest.approx(max(times) - min(times))
    late = list(recording.messages([schema.STATE], start=0.1))
    assert 0 < len(late) < recording.count(schema.STATE)
    assert recording.check()
    others = SHORT // 10 * options.get("others", False)
    assert sum(recording.others.values()) == 2 * others
    assert len(told) == bool(others)
    if told:
        assert f"skipped {2 * others} messages on 2 channels from other programs" in told[0]
    assert [each.name for each in export(recording, tmp_path, CsvTable, [schema.STATE])]


def test_frames_of_one_channel_are_analysed_for_each_finger(tmp_path):
    path = rewritten(tmp_path / "a.mcap", merged=True)
    contacts = analyse(open_source(path, Settings(), own=True), lambda _: None)
    assert [each.finger for each in contacts] == ["left", "right"]
    assert sum(each.t.size for each in contacts) == Recording(path).count(schema.TACTILE) > 0


def test_a_truncated_file_with_other_channels_is_read_up_to_the_cut_and_not_rewritten(tmp_path):
    path = rewritten(tmp_path / "a.mcap", others=True, use_chunking=False)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    recording = Recording(path)
    read = list(recording.messages())
    assert recording.truncated
    assert read == list(islice(Recording(GOLDEN).messages(), len(read)))
    assert len(read) > 50
    with pytest.raises(RecordingError, match="channels from other programs, which would be lost"):
        recover(path)
    assert path.read_bytes() == whole[: len(whole) // 2]


def test_a_message_of_another_channel_may_exceed_our_maximum_size(tmp_path):
    path = tmp_path / "a.mcap"
    state = next(message.data for _, channel, message in golden() if channel.topic == "hand/state")
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start("", "cloud")
        cloud = writer.register_channel("/points", "cdr", 0)
        states = writer.register_channel("hand/state", "json", 0)
        writer.add_message(cloud, 1, bytes(20 << 20), 1)
        writer.add_message(states, 2, state, 2)
        writer.finish()
    recording = Recording(path)
    assert [topic for topic, _ in recording.messages()] == [schema.STATE]
    assert recording.check()


def foreign(path: Path, *channels: tuple[str, str, bytes]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "x")
        for topic, encoding, data in channels:
            number = writer.register_channel(topic, encoding, 0)
            writer.add_message(number, 10**18, data, 10**18)
        writer.finish()
    return path


def test_a_file_without_our_channels_is_refused_with_a_list_of_its_channels(tmp_path):
    path = foreign(tmp_path / "a.mcap", ("/imu", "cdr", b"x"), ("hand/state", "protobuf", b"y"))
    with pytest.raises(RecordingError, match=r"\(channels: /imu, hand/state\), expected"):
        Recording(path)


@pytest.mark.parametrize("data", [b"[1]", b"3", b"\xff", b""])
@pytest.mark.parametrize("topic", ["hand/state", "hand/settings", "hand/tactile/left"])
def test_malformed_messages_on_our_channels_are_omitted(tmp_path, topic, data):
    path = foreign(tmp_path / "a.mcap", (topic, "json", data))
    told: list[str] = []
    recording = Recording(path, told.append)
    assert list(recording.messages()) == []
    assert len(told) == 1
    assert "the intact part is read" in told[0]


def test_view_and_replay_tolerate_malformed_messages(tmp_path, inline):
    state = next(message.data for _, channel, message in golden() if channel.topic == "hand/state")
    path = foreign(
        tmp_path / "a.mcap",
        ("hand/settings", "json", b"[]"),
        ("hand/state", "json", b'{"timestamp": "now"}'),
        ("/hand/state", "json", state),
    )
    done = inline("view", path, "--no-browser", "--duration", "0.5", "--port", "0")
    assert (done.returncode, "1 states received" in done.stderr) == (0, True)
    assert "Traceback" not in done.stderr
    address = f"ipc://{tmp_path}/stream"
    done = inline("replay", path, "--no-wait", "--address", address)
    assert (done.returncode, done.stdout) == (0, "1 of 3 messages published\n")
