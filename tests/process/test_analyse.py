"""Test that ``softfinger analyse`` computes contacts from recorded frames as the daemon does."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softfinger import Fingertip, Material, SensorGrid
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Frame, HandInfo, SensorInfo
from softfinger.daemon.wire import schema
from softfinger.tools.recordings.analyse import analyse, open_source, write_csv
from tests.harness.golden_wire import message_maker, sample
from tests.harness.recorded_hand import write_recording
from tests.process.test_export import rows_of

TIP, PITCH, SCALE = Fingertip(0.020), 0.058 / 44, 4.0
DEPTHS = np.linspace(0.0, 0.005, 26)
TILT = 0.1


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Return noise-free counts for indentations of up to 5 mm at a tilt of 0.1 rad."""
    grid = SensorGrid(rows=44, cols=44, pitch=PITCH)
    material = Material.table_i()
    frames = [grid.pressure(TIP, material, d, TILT, 0.0) for d in DEPTHS[1:]]
    return np.round(np.stack([np.zeros((44, 44)), *frames]) / SCALE).astype(np.uint16)


def check(path: Path) -> None:
    rows = rows_of(path)
    assert len(rows) == len(DEPTHS)
    assert rows[0]["contact"] == "0"
    for row, d in zip(rows[5:], DEPTHS[5:], strict=True):
        assert (row["finger"], row["valid"], row["contact"]) == ("left", "1", "1")
        assert float(row["d_m"]) == pytest.approx(d, abs=2e-5)
        assert float(row["theta_rad"]) == pytest.approx(TILT, abs=3e-3)
        assert float(row["force_N"]) > 0.0
        assert float(row["energy_J"]) > 0.0


def save_stream(
    path: Path, counts: np.ndarray, settings: Settings, *commands: dict[str, Any]
) -> None:
    facts = HandInfo("0.1.0", settings.model_dump_json(), "", "", "", "")
    messages = [(schema.SETTINGS, message_maker(schema.SETTINGS)(1, 1e9, 1.0, facts))]
    messages += [(schema.COMMAND, sample(schema.COMMAND) | each) for each in commands]
    sensor = SensorInfo(PITCH, PITCH, 0.0, 0.0, 0.0, "count", SCALE, False, "")
    for k, data in enumerate(counts):
        frame = Frame(k + 1, 0.01 * k, 0.01 * k, True, data)
        message = message_maker(schema.TACTILE)(frame, data, 0, sensor, 1e9 + 0.01 * k)
        messages.append((schema.TACTILE, message))
    write_recording(path, messages)


def test_unusable_frames_are_counted_by_reason(counts, tmp_path):
    np.save(tmp_path / "untared.npy", np.full_like(counts, 5000))
    made = Settings.model_validate({"tactile": {"pascal_per_count": SCALE, "pitch": PITCH}})
    (contacts,) = analyse(open_source(tmp_path / "untared.npy", made, False), print)
    assert contacts.reasons() == {"all cells read above zero: tare the sensor": len(counts)}
    write_csv(tmp_path / "out.csv", [contacts])
    assert (
        rows_of(tmp_path / "out.csv")[0]["invalid"] == "all cells read above zero: tare the sensor"
    )


def test_all_file_types_give_the_same_contacts(counts, tmp_path):
    np.savez(tmp_path / "press.npz", frames=counts, t=np.arange(len(counts)) / 100, d=DEPTHS)
    folder = tmp_path / "frames"
    folder.mkdir()
    for k, frame in enumerate(counts):
        np.save(folder / f"frame{k}.npy", frame)
    lines = ["ROWS 44", "COLS 44", f"ROW_SPACING {PITCH * 1e3} mm", f"COL_SPACING {PITCH * 1e3} mm"]
    lines += ["SECONDS_PER_FRAME 0.01", "UNITS RAW", "ASCII_DATA @@"]
    for k, frame in enumerate(counts):
        lines += [f"Frame {k + 1}", *(",".join(map(str, row)) for row in frame), ""]
    (tmp_path / "export.asf").write_text("\n".join(lines))
    save_stream(tmp_path / "run.mcap", counts, Settings())
    np.save(tmp_path / "press.npy", counts)
    for name in ("press.npz", "press.npy", "frames", "export.asf", "run.mcap"):
        # The export contains its own pitch, so a wrong pitch in the settings must have no effect.
        wrong = {"rows": 10, "cols": 10, "pitch": 0.002} if name == "export.asf" else {}
        settings = Settings().changed(tactile=wrong)
        source = open_source(tmp_path / name, settings, own=name == "run.mcap")
        output = tmp_path / f"{name}.csv"
        write_csv(output, analyse(source, lambda done: None))
        check(output)
    assert float(rows_of(tmp_path / "press.npz.csv")[10]["d_true_m"]) == DEPTHS[10]


def test_a_recording_supplies_the_settings_of_its_material(counts, tmp_path):
    settings = Settings().changed(material={"law": "constant", "modulus": 1e6})
    save_stream(tmp_path / "a.mcap", counts, settings)
    own = analyse(open_source(tmp_path / "a.mcap", Settings(), own=True), lambda n: None)
    mine = analyse(open_source(tmp_path / "a.mcap", Settings(), own=False), lambda n: None)
    assert own[0].values["gain"][20] < 0.5 * mine[0].values["gain"][20]


def test_a_recorded_tare_sets_the_zero_offset(counts, tmp_path):
    unloaded = np.zeros((16, 44, 44), np.uint16)
    frames = np.concatenate((unloaded, counts)) + np.uint16(1500)
    refused, done = (
        {"command": "tare", "ok": ok, "timestamp": 1e9, "mono_ns": 0} for ok in (False, True)
    )
    save_stream(tmp_path / "tared.mcap", frames, Settings(), done)
    (tared,) = analyse(open_source(tmp_path / "tared.mcap", Settings(), own=True), print)
    assert tared.valid[16:].all()
    assert tared.values["d"][21:] == pytest.approx(DEPTHS[5:], abs=2e-5)
    save_stream(tmp_path / "refused.mcap", frames, Settings(), refused)
    (untared,) = analyse(open_source(tmp_path / "refused.mcap", Settings(), own=True), print)
    assert not untared.valid[16:30].any()


def test_a_recording_without_frames_is_an_error(inline, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")
    done = inline("analyse", path)
    assert (done.returncode, "cut short" in done.stderr) == (1, True)
    assert (
        done.stderr.splitlines()[-1]
        == f"analyse: {path}: the file does not contain any tactile frames"
    )


def test_frames_without_settings_need_matching_settings(inline, counts, tmp_path):
    path = tmp_path / "small.npy"
    np.save(path, counts[:3, :5, :5])
    done = inline("analyse", path)
    assert (done.returncode, done.stdout) == (2, "")
    assert (
        "small.npy: the file does not contain settings: describe the tip and the sensor with"
        in done.stderr
    )
    done = inline("analyse", path, "--config", "paper")
    assert done.returncode == 2
    assert (
        "small.npy: found frames of 5 × 5 cells, expected 44 × 44: set tactile.rows" in done.stderr
    )
    assert list(tmp_path.iterdir()) == [path]
    assert inline("analyse", path, "--set", "tip.radius=0").returncode == 2


def test_command_line_output(inline, counts, tmp_path):
    path = tmp_path / "press.npz"
    np.savez(path, frames=counts)
    done = inline("analyse", path, "--set", "tactile.noise=20.0")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("26 frames in ")
    check(tmp_path / "press.npz.contacts.csv")
