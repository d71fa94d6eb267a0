"""``softfinger export``: a recording's numbers in the files that others read."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from softfinger.daemon.wire import schema
from softfinger.tools.recordings.export import export
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.record import RecordingWriter
from tests.harness.golden_wire import flat, sample
from tests.process.test_record import written

STATES = 2050


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "a.mcap"
    written(path, STATES)
    return path


def test_csv_has_every_field_with_all_its_digits(path, tmp_path):
    export(Recording(path), tmp_path, [schema.STATE])
    with (tmp_path / "hand-state.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == STATES
    expected = flat(sample(schema.STATE))
    assert list(rows[0]) == [*expected, "t"]
    for name, value in expected.items():
        if name not in ("seq", "timestamp"):
            told = rows[-1][name]
            assert told == str(value) if isinstance(value, str) else float(told) == value, name
    assert [int(row["seq"]) for row in rows] == list(range(STATES))


def test_frames_are_arrays(path, tmp_path):
    files = export(Recording(path), tmp_path, [schema.TACTILE])
    assert {file.name for file in files} == {
        "hand-tactile.csv",
        "tactile-left.npz",
        "tactile-right.npz",
    }
    raw = np.load(tmp_path / "tactile-left.npz")
    assert raw["frames"].shape == (103, 44, 44)
    assert raw["t"][0] == 0.0
    recorded = [m for _, m in Recording(path).messages([schema.TACTILE]) if m["finger"] == "left"]
    assert recorded[5]["data"] == raw["frames"][5].tobytes()
    with (tmp_path / "hand-tactile.csv").open(newline="", encoding="utf-8") as file:
        [row, *_] = csv.DictReader(file)
    assert "data" not in row
    assert row["rows"] == "44"


def test_numbers_that_are_none_are_empty_cells(tmp_path):
    writer = RecordingWriter(tmp_path / "a.mcap")
    message = sample(schema.STATE)
    message["left"]["force"] = math.nan
    message["news"] = 3.5  # of a newer daemon
    writer.add(schema.STATE, message)
    writer.close()
    export(Recording(tmp_path / "a.mcap"), tmp_path, [schema.STATE])
    with (tmp_path / "hand-state.csv").open(newline="", encoding="utf-8") as file:
        [row] = csv.DictReader(file)
    assert (row["left.force"], row["news"]) == ("", "3.5")


def test_files_have_plain_names_whatever_the_topics_are_called(tmp_path):
    writer = RecordingWriter(tmp_path / "a.mcap")
    for topic in (b".hidden", b"\x1b[2Jhand/../../x", b"nul\0", b"/"):
        writer.add(topic, {"timestamp": 1e9, "a": 1})
    writer.close()
    recording = Recording(tmp_path / "a.mcap")
    files = export(recording, tmp_path, recording.topics)
    names = {file.name for file in files}
    assert names == {"hidden.csv", "-[2Jhand-..-..-x.csv".replace("[", "-"), "nul-.csv", "-.csv"}
    assert {file.name for file in tmp_path.iterdir()} == names | {"a.mcap"}


def test_from_the_command_line(path, tmp_path, inline):
    out = tmp_path / "out"
    words = ("--out", str(out), "--topics", "state", "--from", "100", "--to", "200")
    done = inline("export", path, *words)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == str(out / "hand-state.csv")
    with (out / "hand-state.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert 100 <= len(rows) <= 101
    assert float(rows[0]["t"]) == pytest.approx(100.0, abs=1.01)
    done = inline("export", path, "--topics", "dreams")
    assert done.returncode == 1
    assert "found topic 'dreams', the recording has hand/state, hand/tactile" in done.stderr


def test_what_can_not_be_exported(tmp_path, inline):
    empty = tmp_path / "empty.mcap"
    RecordingWriter(empty).close()
    done = inline("export", empty)
    assert done.returncode == 1
    assert "no messages in it" in done.stderr
