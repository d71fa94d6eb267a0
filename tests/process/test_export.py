"""Test that ``softfinger export`` writes a recording's values to CSV and Parquet."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from softfinger import read_recording
from softfinger.daemon.errors import RecordingError
from softfinger.daemon.wire import schema
from softfinger.tools.recordings.export import CsvTable, ParquetTable, export
from softfinger.tools.recordings.reader import Recording
from tests.harness.fake_daemon import frame
from tests.harness.golden_wire import flat, sample
from tests.harness.recorded_hand import write_recording
from tests.process.test_record import written

STATES = 2050


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "a.mcap"
    written(path, STATES)
    return path


def test_csv_has_every_field_in_full_precision(path, tmp_path):
    export(Recording(path), tmp_path, CsvTable, [schema.STATE])
    rows = rows_of(tmp_path / "hand-state.csv")
    assert len(rows) == STATES
    expected = flat(sample(schema.STATE))
    assert list(rows[0]) == ["t", *expected]
    assert [float(row["t"]) for row in rows] == pytest.approx(range(STATES))
    for name, value in expected.items():
        if name not in ("seq", "timestamp", "mono_ns"):
            told = rows[-1][name]
            assert told == str(value) if isinstance(value, str) else float(told) == value, name
    assert [int(row["seq"]) for row in rows] == list(range(STATES))


def test_parquet_keeps_types_and_frames(path, tmp_path):
    import pyarrow.parquet

    topics = [schema.STATE, schema.TACTILE]
    files = export(Recording(path), tmp_path, ParquetTable, topics)
    assert {file.name for file in files} == {
        "hand-state.parquet",
        "hand-tactile.parquet",
        "tactile-left.npz",
        "tactile-right.npz",
    }
    table = pyarrow.parquet.read_table(tmp_path / "hand-state.parquet")
    assert table.num_rows == STATES
    kinds = {"seq": "int64", "left.force": "double", "torque": "bool", "mode": "string"}
    assert {name: str(table.schema.field(name).type) for name in kinds} == kinds
    assert table["left.force"][0].as_py() == sample(schema.STATE)["left"]["force"]
    frames = pyarrow.parquet.read_table(tmp_path / "hand-tactile.parquet")
    raw = np.load(tmp_path / "tactile-left.npz")
    assert raw["frames"].shape == (103, 44, 44)
    assert raw.files == ["t", "frames"]
    told = frames["t"].to_pylist(), frames["finger"].to_pylist()
    assert raw["t"].tolist() == [t for t, finger in zip(*told, strict=True) if finger == "left"]
    left = [k for k, name in enumerate(frames["finger"].to_pylist()) if name == "left"]
    assert frames["data"][left[5]].as_py() == raw["frames"][5].tobytes()


@pytest.mark.parametrize("first", [schema.STATE, schema.TACTILE])
def test_times_of_all_files_count_from_one_zero(tmp_path, first):
    before = {"mono_ns": 6_000_000_000, "timestamp": 1e9 + 6.0, "again": True}
    scan = {"mono_ns": 7_000_000_000, "timestamp": 1e9 + 7.02, "delay_s": 0.02}
    tick = {"mono_ns": 7_020_000_000, "timestamp": 1e9 + 7.02}
    messages = [(schema.STATE, sample(schema.STATE) | tick)]
    messages.insert(first != schema.TACTILE, (schema.TACTILE, frame(0.0, 1) | scan))
    messages.insert(0, (schema.EVENT, sample(schema.EVENT) | before))
    # The system's Unix time was changed between the two messages.
    late = {"mono_ns": 9_020_000_000, "timestamp": 1e9 + 9.52}
    messages.append((schema.STATE, sample(schema.STATE) | late))
    recording = write_recording(tmp_path / "a.mcap", messages)
    export(recording, tmp_path, CsvTable, recording.topics)
    times = {
        topic: [float(row["t"]) for row in rows_of(tmp_path / f"hand-{topic}.csv")]
        for topic in ("state", "tactile", "event")
    }
    assert times["state"] == pytest.approx([0.0, 2.0], abs=1e-6)
    assert times["tactile"] == pytest.approx([-0.02], abs=1e-6)
    assert times["event"] == pytest.approx([-1.02], abs=1e-6)
    assert np.load(tmp_path / "tactile-right.npz")["t"].tolist() == times["tactile"]
    assert read_recording(tmp_path / "a.mcap")["t"].tolist() == times["state"]
    assert next(iter(read_recording(tmp_path / "a.mcap"))) == "t"


def test_nan_values_are_empty_cells(tmp_path):
    message = sample(schema.STATE)
    message["left"]["force"] = math.nan
    message["news"] = 3.5  # Only newer daemons send the field.
    recording = write_recording(tmp_path / "a.mcap", [(schema.STATE, message)])
    export(recording, tmp_path, CsvTable, [schema.STATE])
    [row] = rows_of(tmp_path / "hand-state.csv")
    assert (row["left.force"], row["news"]) == ("", "3.5")
    assert next(iter(row)) == "t"


def test_files_have_plain_names_for_any_topic_prefix(tmp_path):
    topics = (b".hidden", b"\x1b[2Jhand/../../x", b"nul\0", b"/")
    messages = [(topic, {"timestamp": 1e9, "a": 1}) for topic in topics]
    recording = write_recording(tmp_path / "a.mcap", messages)
    files = export(recording, tmp_path, CsvTable, recording.topics)
    names = {file.name for file in files}
    assert names == {"hidden.csv", "-[2Jhand-..-..-x.csv".replace("[", "-"), "nul-.csv", "-.csv"}
    assert {file.name for file in tmp_path.iterdir()} == names | {"a.mcap"}


@pytest.mark.parametrize("name", ["tick_s", "seq"])
def test_a_value_of_another_type_is_written_to_csv_only(tmp_path, name):
    messages = [(schema.STATE, sample(schema.STATE) | {name: value}) for value in (1, "abc")]
    recording = write_recording(tmp_path / "a.mcap", messages)
    with pytest.raises(RecordingError, match=r"hand-state\.parquet: .*abc.*; use --format csv"):
        export(recording, tmp_path, ParquetTable, [schema.STATE])
    export(recording, tmp_path, CsvTable, [schema.STATE])
    assert [row[name] for row in rows_of(tmp_path / "hand-state.csv")] == ["1", "abc"]


def test_frames_of_different_sizes_are_rejected(tmp_path):
    frames = [(schema.TACTILE, frame(0.1 * k, 0, 44 - 12 * k)) for k in range(2)]
    recording = write_recording(tmp_path / "a.mcap", frames)
    with pytest.raises(RecordingError, match="32 × 32 cells after frames of 44 × 44 cells, expect"):
        export(recording, tmp_path, CsvTable, [schema.TACTILE])


def test_command_line_output(path, tmp_path, inline):
    out = tmp_path / "out"
    words = ("--out", str(out), "--topics", "state", "--from", "100", "--to", "200")
    done = inline("export", path, *words)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == str(out / "hand-state.csv")
    rows = rows_of(out / "hand-state.csv")
    assert 100 <= len(rows) <= 101
    assert float(rows[0]["t"]) == pytest.approx(100.0, abs=1.01)
    done = inline("export", path, "--topics", "dreams")
    assert done.returncode == 1
    assert (
        "found topic 'dreams', expected one of the recorded topics: hand/state, hand/tactile"
        in done.stderr
    )


def test_invalid_exports_are_refused(tmp_path, inline):
    empty = tmp_path / "empty.mcap"
    write_recording(empty)
    for words, where in ((), ""), (("--from", "1000"), " between --from and --to"):
        done = inline("export", empty, *words)
        assert done.returncode == 1
        assert f"{empty}: the recording does not contain messages{where}\n" in done.stderr
