"""Test that frame files of test benches are read correctly or rejected with a clear reason."""

import itertools
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softfinger import Fingertip, Material, SensorGrid
from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.errors import RecordingError, TactileError
from softfinger.daemon.perception.finger_model import make_models
from softfinger.daemon.profile.settings import Settings, TactileSettings
from softfinger.daemon.profile.validation import plausibility_warnings
from softfinger.daemon.tactile.replay import ReplayTactile
from softfinger.tools.recordings.analyse import analyse, open_source
from softfinger.tools.recordings.record import RecordingWriter
from tests.harness.tactile import read_frames

PITCH, SCALE, NOISE = 0.058 / 44, 4.0, 300.0
TIP, MATERIAL = Fingertip(0.020), Material.table_i()
DEPTHS = (0.0, 0.0, 0.001, 0.002, 0.003, 0.004, 0.004, 0.004)
SETTINGS = Settings.model_validate(
    {"tactile": {"pascal_per_count": SCALE, "pitch": PITCH, "noise": NOISE, "smooth_error": 0.0}}
)


@pytest.fixture(scope="module")
def tared() -> np.ndarray:
    """Return contact pressures [Pa] with zero-mean sensor noise."""
    grid = SensorGrid(44, 44, PITCH)
    clean = np.stack([grid.pressure(TIP, MATERIAL, d, 0.1 if d else 0.0, 0.0) for d in DEPTHS])
    return clean + np.random.default_rng(3).normal(0.0, NOISE, clean.shape)


@pytest.fixture(scope="module")
def press(tared) -> np.ndarray:
    return np.maximum(tared, 0.0)


def export(frames: np.ndarray, unit: str = "kPa", scale: float = 1e-3, **form: Any) -> bytes:
    """Return an export; ``form`` sets header lines, separator, decimal sign, encoding, etc."""
    point, digits = form.get("point", "."), form.get("digits", 3)
    header = [
        *("DATA_TYPE MOVIE", "SENSOR_TYPE 5051", "ROWS 44", "COLS 44", "NOISE_THRESHOLD 3"),
        *(f"{name}_SPACING {PITCH * 1e3:.6f} mm" for name in ("ROW", "COL")),
        *(f"SENSEL_AREA {PITCH**2 * 1e6:.6f} mm2", "SECONDS_PER_FRAME 0.01", f"UNITS {unit}"),
        *form.get("header", ()),
        "ASCII_DATA @@",
    ]
    lines = [line.replace(".", point).replace(" ", form.get("gap", " "), 1) for line in header]
    for k, frame in enumerate(frames):
        lines.append(f"{form.get('word', 'Frame')} {k + 1}")
        for row in frame:
            cells = (f"{value * scale:.{digits}f}".replace(".", point) for value in row)
            quote = form.get("quote", "")
            lines.append(form.get("separator", ",").join(f"{quote}{each}{quote}" for each in cells))
        lines.append("")
    return form.get("end", "\r\n").join([*lines, "@@"]).encode(form.get("encoding", "latin-1"))


def depths(path: Path, settings: Settings = SETTINGS) -> np.ndarray:
    (contacts,) = analyse(open_source(path, settings, own=False), lambda _: None)
    assert contacts.valid.all()
    return contacts.values["d"]


def check(path: Path, settings: Settings = SETTINGS, within: float = 3e-5) -> None:
    assert depths(path, settings) == pytest.approx(DEPTHS, abs=within)


# Saturated cells


def clipped(frames: np.ndarray) -> tuple[np.ndarray, float]:
    full = 0.75 * frames.max()
    return np.minimum(frames, full), full


@pytest.mark.parametrize(
    ("unit", "pascal", "digits"),
    [("kPa", 1e3, 3), ("kPa", 1e3, 0), ("psi", 6894.757293168, 4), ("MPa", 1e6, 5)],
)
@pytest.mark.parametrize("told", [True, False])
def test_cells_above_the_saturation_pressure_of_the_header_are_excluded(
    press, tmp_path, unit, pascal, digits, told
):
    frames, full = clipped(press)
    name = f" {unit}" if told else ""  # A value without a unit has the unit of the readings.
    line = f"SATURATION_PRESSURE {full / pascal:.6f}{name}"
    path = tmp_path / "a.asf"
    path.write_bytes(export(frames, unit, 1.0 / pascal, digits=digits, header=[line]))
    settings, within = SETTINGS, 3e-5
    if digits == 0:  # Rounding to whole kPa adds noise of 0.3 kPa.
        settings, within = SETTINGS.changed(tactile={"noise": 600.0}), 6e-5
    check(path, settings, within)
    assert not read_frames(path, SCALE, 100.0).notes


def test_a_replayed_export_uses_its_own_saturation(press, tmp_path):
    frames, full = clipped(press)
    path = tmp_path / "a.asf"
    path.write_bytes(export(frames, header=[f"SATURATION_PRESSURE {full * 1e-3:.3f} kPa"]))
    tactile = SETTINGS.tactile.model_copy(update={"recording": (str(path), "")})
    sensor = ReplayTactile(tactile, VirtualClock(), 0)
    assert sensor.full_count == pytest.approx(full / SCALE, rel=0.006)
    assert sensor.notes == ()


def test_cells_at_the_maximum_reading_are_reported_if_the_header_has_no_saturation(
    press, tmp_path, inline
):
    frames, full = clipped(press)
    path = tmp_path / "a.asf"
    path.write_bytes(export(frames))
    done = inline("analyse", path, "--config", "paper")
    assert "cells have the same maximum reading" in done.stderr
    assert f"set tactile.full_count = {round(full / SCALE)}" in done.stderr
    np.save(tmp_path / "b.npy", np.round(frames / 400.0).astype(np.uint8))
    full_count = round(full / 400.0)
    assert "have the same maximum reading" in read_frames(tmp_path / "b.npy", 400.0, 100.0).notes[0]
    assert not read_frames(tmp_path / "b.npy", 400.0, 100.0, full_count=full_count).notes


@pytest.mark.parametrize("step", [4.0, 300.0, 3000.0])
def test_round_readings_do_not_count_as_saturated(press, tmp_path, step):
    np.save(tmp_path / "a.npy", np.round(press / step).astype(np.uint16))
    assert not read_frames(tmp_path / "a.npy", step, 100.0).notes
    upright = SensorGrid(44, 44, PITCH).pressure(TIP, MATERIAL, 0.004)
    np.save(tmp_path / "b.npy", upright)  # The four middle cells have the same reading.
    assert not read_frames(tmp_path / "b.npy", SCALE, 100.0).notes


def test_raw_readings_saturate_at_255(press, tmp_path):
    path = tmp_path / "a.asf"
    counts = np.minimum(np.round(press / 60.0), 255)
    assert np.count_nonzero(counts == 255) > 20
    path.write_bytes(export(counts, "RAW", 1.0, digits=0))
    assert read_frames(path, 60.0, 100.0).full_count == 255
    check(path, SETTINGS.changed(tactile={"pascal_per_count": 60.0}))


# Zero offsets and dead cells.


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int16, np.int32])
def test_negative_noise_of_a_tared_sensor_is_clipped_and_reported(tared, tmp_path, kind):
    frames = tared if np.dtype(kind).kind == "f" else np.round(tared / SCALE)
    np.savez(tmp_path / "a.npz", frames=frames.astype(kind))
    (note,) = read_frames(tmp_path / "a.npz", SCALE, 100.0).notes
    assert "of the readings are below 0, down to -" in note
    check(tmp_path / "a.npz")


def test_a_tared_export_gives_equally_accurate_contacts(tared, tmp_path):
    (tmp_path / "a.asf").write_bytes(export(tared))
    assert "below 0" in read_frames(tmp_path / "a.asf", SCALE, 100.0).notes[0]
    check(tmp_path / "a.asf")


@pytest.mark.parametrize("value", [-5e4, np.nan, np.inf, -np.inf])
def test_a_nan_reading_is_reported_with_its_position(press, tmp_path, value):
    frames = press.copy()
    frames[4, 10, 12] = value
    np.save(tmp_path / "a.npy", frames)
    with pytest.raises(RecordingError, match="outside") as caught:
        read_frames(tmp_path / "a.npy", SCALE, 100.0, 1520.0)
    place = "frame 5 of 8, row 11, cell 13 (frames[4, 10, 12])"
    assert f"{place} is {value:.10g}" in str(caught.value)


def test_a_negative_zero_offset_is_not_treated_as_noise(tared, tmp_path):
    np.save(tmp_path / "a.npy", tared - 4.0 * NOISE)
    with pytest.raises(
        RecordingError,
        match=r"half of the readings are -1\.\d+e\+03 or less: "
        "tare",
    ):
        read_frames(tmp_path / "a.npy", SCALE, 100.0, NOISE)


def test_pressure_beyond_the_count_range_is_reported_with_the_setting(press, tmp_path):
    np.save(tmp_path / "a.npy", press * 12.0)
    with pytest.raises(RecordingError, match=r"set tactile\.pascal_per_count to \d.* or more"):
        read_frames(tmp_path / "a.npy", SCALE, 100.0)


def test_a_cell_that_is_nan_in_all_frames_is_dead(press, tmp_path):
    frames = press.copy()
    frames[:, 20:22, 25] = np.nan
    np.save(tmp_path / "a.npy", frames)
    assert np.argwhere(~read_frames(tmp_path / "a.npy", SCALE, 100.0).live).tolist() == [
        [20, 25],
        [21, 25],
    ]
    check(tmp_path / "a.npy")
    (tmp_path / "a.asf").write_bytes(export(frames))
    check(tmp_path / "a.asf")


# Exports from other locales

LOCALES = {
    "decimal commas, semicolons": {"point": ",", "separator": ";"},
    "decimal commas, tabs": {"point": ",", "separator": "\t"},
    "decimal commas, spaces": {"point": ",", "separator": "  "},
    "decimal commas, commas": {"point": ","},
    "decimal commas, commas with spaces": {"point": ",", "separator": ", "},
    "decimal commas in quotes": {"point": ",", "quote": '"'},
    "semicolons": {"separator": ";"},
    "semicolons at the ends": {"separator": ";", "end": ";;;\r\n"},
    "tabs": {"separator": "\t"},
    "spaces": {"separator": " "},
    "commas with spaces": {"separator": ", "},
    "quotes": {"quote": '"'},
    "a header of cells": {"gap": ",", "separator": ","},
    "a header of other cells": {"gap": ";", "separator": ";", "point": ","},
    "a header with colons": {"gap": ": "},
    "UTF-16": {"encoding": "utf-16"},
    "UTF-16 without a mark": {"encoding": "utf-16-le"},
    "UTF-16, the other way round": {"encoding": "utf-16-be"},
    "UTF-8 with a mark": {"encoding": "utf-8-sig"},
    "lines that end as on a Mac": {"end": "\r"},
    "another word for a frame": {"word": "Trame"},
    "an umlaut": {"header": ["COMMENTS Prüfstand"]},
    "an umlaut in UTF-8": {"header": ["COMMENTS Prüfstand"], "encoding": "utf-8"},
}


@pytest.mark.parametrize("form", LOCALES.values(), ids=LOCALES)
def test_all_locales_give_the_same_readings(press, tmp_path, form):
    frames = press[[1, 4, 5]]
    (tmp_path / "a.asf").write_bytes(export(frames, **form))
    (tmp_path / "b.asf").write_bytes(export(frames))
    read, plain = (read_frames(tmp_path / name, SCALE, 100.0) for name in ("a.asf", "b.asf"))
    assert np.array_equal(read.counts, plain.counts)
    assert read.t.tolist() == plain.t.tolist() == [0.0, 0.01, 0.02]
    assert read.pitch == plain.pitch == pytest.approx((PITCH, PITCH), rel=1e-5)


def test_commas_as_separator_and_decimal_sign_are_reported_if_ambiguous(tmp_path):
    text = "ROWS 1\nCOLS 3\nUNITS kPa\nASCII_DATA @@\nFrame 1\n0,0,0\nFrame 2\n0,1,25,0\n@@\n"
    (tmp_path / "a.asf").write_text(text)
    with pytest.raises(
        RecordingError, match="line 8: found 4 cells, expected 3: the comma is both the separator"
    ):
        read_frames(tmp_path / "a.asf", SCALE, 100.0)


UNITS = {
    **{"N/cm²": 1e4, "N/cm^2": 1e4, "N / sq cm": 1e4, "kg/cm²": 98066.5, "kgf/cm2": 98066.5},
    **{"g/cm2": 98.0665, "lb/in2": 6894.757, "lbf/in²": 6894.757, "PSI": 6894.757, "mbar": 100.0},
    **{"hPa": 100.0, "MPa": 1e6, "inHg": 3386.389, "cmH2O": 98.0665, "kN/m2": 1e3, "Torr": 133.322},
    **{"N": 1.0 / PITCH**2, "g": 9.80665e-3 / PITCH**2, "lbf": 4.448222 / PITCH**2},
}


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8", "cp437"])
@pytest.mark.parametrize("unit", UNITS)
def test_units_of_pressure_and_of_force_per_cell(press, tmp_path, unit, encoding):
    path = tmp_path / "a.asf"
    frames = press[:6]
    path.write_bytes(export(frames, unit, 1.0 / UNITS[unit], digits=9, encoding=encoding))
    pressures = read_frames(path, SCALE, 100.0).counts * SCALE
    assert pressures == pytest.approx(frames, rel=1e-4, abs=SCALE)


@pytest.mark.parametrize("unit", ["stone", "mm", "N/m"])
def test_an_unknown_unit_is_reported(press, tmp_path, unit):
    (tmp_path / "a.asf").write_bytes(export(press[:1], unit))
    with pytest.raises(RecordingError, match=f"UNITS: found '{unit}', expected RAW or a unit"):
        read_frames(tmp_path / "a.asf", SCALE, 100.0)


def test_other_files_are_refused_with_the_supported_types(tmp_path):
    (tmp_path / "a.csv").write_text("t,force\n0,1\n")
    with pytest.raises(
        RecordingError, match=r"expected a Tekscan-style export, or an \.npz or \.npy"
    ):
        read_frames(tmp_path / "a.csv", SCALE, 100.0)


# Times

STEPS = np.cumsum([0, 10, 10, 11, 9, 10, 10, 10])  # ms


@pytest.mark.parametrize("start", [0, 123456, 1_700_000_000_000], ids=["0", "since boot", "a date"])
@pytest.mark.parametrize("rate", [25.0, 100.0, 400.0])
@pytest.mark.parametrize(("name", "factor"), [("ms", 1), ("µs", 1000), ("ns", 1_000_000)])
@pytest.mark.parametrize("kind", [np.int64, np.float64])
def test_times_in_other_units_are_converted_and_reported_once(
    press, tmp_path, start, rate, name, factor, kind
):
    t = ((STEPS + start) * factor).astype(kind)
    np.savez(tmp_path / "a.npz", frames=press, t=t)
    read = read_frames(tmp_path / "a.npz", SCALE, rate)
    assert read.t == pytest.approx(STEPS * 1e-3, abs=1e-6)
    (note,) = read.notes
    assert note.startswith(f"t: interpreted as {name}, which gives 0.01 s between frames")


@pytest.mark.parametrize(("name", "factor"), [("µs", 1000), ("ns", 1_000_000)])
def test_times_since_a_boot_half_an_hour_ago_are_not_dates(press, tmp_path, name, factor):
    np.savez(tmp_path / "a.npz", frames=press, t=(STEPS + 2_000_000) * factor)
    read = read_frames(tmp_path / "a.npz", SCALE, 100.0)
    assert read.t == pytest.approx(STEPS * 1e-3)
    assert read.notes[0].startswith(f"t: interpreted as {name}, ")


@pytest.mark.parametrize("key", ["t", "time", "timestamps"])
@pytest.mark.parametrize("start", [0.0, 3600.0, 1.7e9])
def test_times_in_seconds_are_not_changed(press, tmp_path, start, key):
    np.savez(tmp_path / "a.npz", frames=press, **{key: STEPS * 1e-3 + start})
    read = read_frames(tmp_path / "a.npz", SCALE, 25.0)
    assert read.t == pytest.approx(STEPS * 1e-3, abs=1e-6)
    assert not read.notes


def test_numpy_times_keep_their_unit(press, tmp_path):
    for k, unit in enumerate(("ms", "us", "ns")):
        t = np.datetime64("2024-05-01") + STEPS.astype("m8[ms]").astype(f"m8[{unit}]")
        np.savez(tmp_path / f"{k}.npz", frames=press, t=t)
        assert read_frames(tmp_path / f"{k}.npz", SCALE, 25.0).t == pytest.approx(STEPS * 1e-3)


@pytest.mark.parametrize(("start", "step"), [(0.0, 0.5), (1_700_000_000, 60)])
def test_a_slow_recording_is_read_unchanged_and_reported(press, tmp_path, start, step):
    np.savez(tmp_path / "a.npz", frames=press, t=start + np.arange(8) * step)
    read = read_frames(tmp_path / "a.npz", SCALE, 100.0)
    assert read.t.tolist() == (np.arange(8) * step).tolist()
    assert read.notes == (
        f"t: interpreted as seconds, which gives {step} s between frames, but tactile.rate "
        "corresponds to 0.01 s",
    )


@pytest.mark.parametrize("t", [np.arange(8), np.arange(1.0, 9.0)])
def test_frame_numbers_are_not_used_as_times(press, tmp_path, t):
    np.savez(tmp_path / "a.npz", frames=press, t=t)
    with pytest.raises(
        RecordingError, match="t: found frame numbers that increase by 1, expected times"
    ):
        read_frames(tmp_path / "a.npz", SCALE, 100.0)
    assert read_frames(tmp_path / "a.npz", SCALE, 1.0).t.tolist() == list(range(8))


def test_times_as_texts_are_reported(press, tmp_path):
    np.savez(tmp_path / "a.npz", frames=press, t=(STEPS * 1e-3).astype(str))
    with pytest.raises(RecordingError, match=r"t: found <U\d+ of shape \(8,\), expected 8 numbers"):
        read_frames(tmp_path / "a.npz", SCALE, 25.0)


@pytest.mark.parametrize(
    ("t", "told"),
    [
        (np.array([0, 1, 2, 3, 3, 4, 5, 6]) * 0.01, r"t\[3\] = 0\.03, t\[4\] = 0\.03"),
        (np.array([90, 10, 20, 30, 40, 50, 60, 70], np.uint32), r"t\[0\] = 90, t\[1\] = 10"),
    ],
)
def test_times_that_do_not_increase_are_reported_with_their_position(press, tmp_path, t, told):
    np.savez(tmp_path / "a.npz", frames=press, t=t)
    with pytest.raises(RecordingError, match=told):
        read_frames(tmp_path / "a.npz", SCALE, 100.0)


# Readings with another scale


@pytest.mark.parametrize(
    ("scale", "kind", "cause"),
    [
        (1.0 / 4e4, np.float32, "floats between 0 and 1 are probably fractions"),
        (1e-3, np.float64, "convert kPa"),
        (1.0 / 200.0, np.uint8, "the counts have 8 bits"),
        (1.0 / 200.0, np.uint16, "the counts have 8 bits"),
        (1.0 / 40.0, np.uint16, "tactile.pascal_per_count is wrong for this sensor"),
        (0.0, np.uint16, "sensor's cable"),
    ],
)
def test_frames_without_contact_are_reported_with_the_maximum_reading(
    press, tmp_path, inline, scale, kind, cause
):
    path = tmp_path / "a.npz"
    np.savez(path, frames=(press * scale).astype(kind))
    done = inline("analyse", path, "--config", "paper")
    (line,) = [each for each in done.stdout.splitlines() if "no contact in any frame" in each]
    assert cause in line
    assert "threshold is 4560 Pa (3 times tactile.noise)" in line
    with np.load(path) as held:
        assert f"largest reading is {held['frames'].max():.4g} " in line


@pytest.mark.parametrize("kind", [np.float64, np.uint16])
def test_noise_above_its_setting_is_reported_with_both(tmp_path, inline, kind):
    noise = np.random.default_rng(2).normal(0.0, 4000.0, (8, 44, 44))
    scale = 1.0 if kind is np.float64 else 4.0
    np.savez(tmp_path / "a.npz", frames=np.maximum(noise / scale, 0.0).astype(kind))
    (line,) = [
        each
        for each in inline("analyse", tmp_path / "a.npz", "--config", "paper").stdout.splitlines()
        if "no contact in any frame" in each
    ]
    found = re.search(r"threshold is 4560 Pa .*the measured cell noise is (\d+) Pa: set", line)
    assert float(found[1]) == pytest.approx(4000.0, rel=0.03)


def test_frames_with_contact_cause_no_message(press, tmp_path, inline):
    np.savez(tmp_path / "a.npz", frames=press)
    done = inline("analyse", tmp_path / "a.npz", "--config", "paper")
    assert "no contact" not in done.stdout
    assert done.stderr == ""


# Archives


@pytest.mark.parametrize("name", ["arr_0", "pressure", "left/frames"])
def test_the_only_stack_of_an_archive_is_used_and_reported(press, tmp_path, name):
    held = {name: press, "time": STEPS * 1e-3, "serial": np.array("A1"), "zero": press[0]}
    np.savez(tmp_path / "a.npz", **held)
    read = read_frames(tmp_path / "a.npz", SCALE, 100.0)
    assert read.t == pytest.approx(STEPS * 1e-3)
    assert read.notes == (
        f"the file does not contain an array 'frames'; using {name!r}, the only three-dimensional "
        "array",
    )
    check(tmp_path / "a.npz")


def test_the_contents_of_an_archive_without_frames_are_listed(press, tmp_path):
    np.savez(tmp_path / "a.npz", left=press, right=press, note=np.array("x"))
    with pytest.raises(
        RecordingError, match=r"found left \(8, 44, 44\), right .*, note \(\), expected"
    ):
        read_frames(tmp_path / "a.npz", SCALE, 100.0)
    many = {f"a{k}": np.zeros(k + 1) for k in range(30)}
    np.savez(tmp_path / "b.npz", **many)
    with pytest.raises(RecordingError, match=r"a7 \(8,\), …, expected an array 'frames'"):
        read_frames(tmp_path / "b.npz", SCALE, 100.0)


# Cells with another pitch


def test_a_pitch_that_contradicts_the_header_is_reported(press, tmp_path, inline):
    path = tmp_path / "a.asf"
    path.write_bytes(export(press))
    tactile = {"rows": 44, "cols": 44, "recording": (str(path), ""), "pitch": 0.00127}
    wanted = (
        r"cells of 1\.318 × 1\.318 mm in the header, expected 1\.27 × 1\.27 mm as in "
        r"tactile\.pitch: set tactile\.pitch"
    )
    with pytest.raises(TactileError, match=wanted):
        ReplayTactile(TactileSettings.model_validate(tactile), VirtualClock(), 0)
    done = inline("analyse", path, "--config", "paper", "--set", "tactile.pitch=0.00127")
    assert "found cells of 1.318 × 1.318 mm in the header" in done.stderr
    assert "6 with contact, 0 invalid" in done.stdout
    words = ("--recording", path, "--config", "paper", "--set", "tactile.pitch=0.00127")
    done = inline("calibrate", "tare", tmp_path / "left.json", *words, "--no-plot")
    assert (done.returncode, "found cells of" in done.stderr) == (1, True)


def test_a_calibration_reports_suspicious_recordings(tared, tmp_path, inline):
    np.save(tmp_path / "a.npy", tared[:2])
    words = ("--recording", tmp_path / "a.npy", "--config", "paper", "--no-plot")
    done = inline("calibrate", "tare", tmp_path / "left.json", *words)
    assert done.returncode == 0
    assert "they are treated as noise after a tare and set to 0" in done.stderr


def test_generators_differ():
    """Check that the files generated for any two locales differ."""
    frame = np.full((1, 44, 44), 1234.5)
    texts = [export(frame, **form) for form in LOCALES.values()]
    same = [a == b for a, b in itertools.combinations(texts, 2)]
    assert not any(same)


# Checks of files before the first grip


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({}, ""),
        ({"tip.radius": 0.010}, "sensor area of 58 × 58 mm for a tip with a diameter of 20 mm"),
        (
            {"tactile.rows": 26},
            r"but the tip's footprint at safety\.d_max = 12 mm is 36\.7 mm wide",
        ),
        (
            {"tactile.rows": 20, "control.force_default": 24.0},
            r"but the tip's footprint at control\.force_default = 24 N is 30\.9 mm wide",
        ),
        ({"tactile.centre": (0.02, 0.0)}, "but the tip's footprint"),
        ({"tactile.pitch_y": 0.0006}, "sensor area of 58 × 26.4 mm, but the tip's"),
    ],
)
def test_a_sensor_size_that_does_not_fit_the_tip_is_reported(changes, told):
    tables: dict[str, dict[str, Any]] = {}
    for key, value in changes.items():
        section, name = key.split(".")
        tables.setdefault(section, {})[name] = value
    settings = Settings.model_validate(tables)
    doubts = plausibility_warnings(settings)
    events: list[tuple[str, str, str]] = []
    make_models(settings, lambda *event: events.append(event))
    warned = [text for level, _, text in events if level == "warning"]
    assert warned == doubts
    assert len(doubts) == bool(told)
    assert re.search(told, " ".join(doubts))


def test_the_sensor_of_a_solid_tip_covers_its_base():
    solid = {"tip": {"physics": "solid"}, "material": {"law": "constant"}}
    settings = Settings.model_validate({**solid, "tactile": {"rows": 28}})
    (doubt,) = plausibility_warnings(settings)
    assert "but the tip's base is 40 mm wide" in doubt


def test_a_recording_needs_an_existing_folder(tmp_path):
    with pytest.raises(RecordingError, match="the folder does not exist; create the folder first"):
        RecordingWriter(tmp_path / "no" / "a.mcap")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("limit", [60_000, 300_000])  # kB
def test_insufficient_memory_is_reported_in_one_line(press, tmp_path, limit):
    np.save(tmp_path / "a.npy", press[:1])
    words = [sys.executable, "-m", "softfinger", "analyse", str(tmp_path / "a.npy")]
    words = ["prlimit", f"--as={limit * 1024}", *words, "--config", "paper"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert done.stderr.startswith("softfinger: not enough memory for this process")
    assert len(done.stderr.splitlines()) == 1
