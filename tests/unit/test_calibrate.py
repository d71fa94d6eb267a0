"""Test `softfinger calibrate` on a simulated sensor, and the daemon's use of the file."""

import json
import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.perception.calibration_file import (
    Calibration,
    CalibrationFileError,
    Converter,
    Sensor,
    TareStep,
    load_calibration,
)
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire.schema import TACTILE
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.calibration import calibrate, calibration_frames
from softfinger.tools.cli import main
from tests.harness.golden_wire import message_maker

tactile_message = message_maker(TACTILE)

TIP = Fingertip(0.020)
E = 0.25e6
N = 32
PITCH = 0.058 / N
CENTRE = (0.9e-3, -0.6e-3)
ROTATION = 0.35
EXPONENT, FACTOR = 1.25, 6.0  # p = FACTOR · x^EXPONENT [Pa]
NOISE = 1.0  # counts
SATURATED = np.full((2, N, N), 4000, np.uint16)
SATURATED[1, 4, 5] = 4095
PROFILE = f"""
servos.backend = "none"
scene.fingers = ["left"]
loop.clock = "virtual"
[material]
law = "constant"
modulus = {E}
[tactile]
backend = "simulated"
rows = {N}
cols = {N}
pitch = {PITCH!r}
pascal_per_count = 20.0
full_count = 4095
noise = 300.0
sensor = ["A17", "A18"]
"""


class MadeUp:
    """Sensor with known properties."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(5)
        self.zero = self.rng.uniform(10, 40, (N, N))
        self.gain = np.clip(1 + 0.1 * self.rng.standard_normal((N, N)), 0.6, 1.4)
        self.gain[5, 6] = 0.0
        self.grid = SensorGrid(N, N, PITCH, CENTRE, ROTATION)

    def counts(self, pressure, frames=1):
        x = (np.maximum(pressure, 0.0) / FACTOR) ** (1 / EXPONENT)
        noise = NOISE * self.rng.standard_normal((frames, N, N))
        reading = self.zero + self.gain * x + noise
        return np.clip(np.round(reading), 0, 4095).astype(np.uint16)

    def press(self, d, theta=0.0, frames=1):
        return self.counts(self.grid.pressure(TIP, Material.constant(E), d, theta), frames)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Run all calibration steps with recordings; return the folder of the files, and the sensor."""
    folder = tmp_path_factory.mktemp("calibration")
    (folder / "profile.toml").write_text(PROFILE)
    sensor = MadeUp()

    def keep(name, frames, **truths):
        np.savez(folder / name, frames=frames, **truths)
        return str(folder / name)

    def step(name, *words):
        arguments = ["calibrate", name, str(folder / "sensor.json")]
        arguments += ["--config", str(folder / "profile.toml"), *words]
        assert main(arguments) == 0

    rest = keep("rest.npz", sensor.counts(np.zeros((N, N)), 200))
    step("tare", "--recording", rest)
    loads = [
        keep(f"air{k}.npz", sensor.counts(np.full((N, N), p), 60))
        for k, p in enumerate((2e3, 8e3, 15e3))
    ]
    step("equilibrate", "--recording", *loads)
    depths = (0.0015, 0.002, 0.003, 0.004)
    weights = [keep(f"weight{d}.npz", sensor.press(d, frames=60)) for d in depths]
    forces = [f"{math.pi * E * d * d:.6f}" for d in depths]
    step("curve", "--recording", *weights, "--force", *forces)
    tilts = (-15.0, -5.0, 5.0, 15.0)
    presses = [keep(f"tilt{t}.npz", sensor.press(0.003, math.radians(t), 20)) for t in tilts]
    step("centre", "--recording", *presses, "--theta", *map(str, tilts))
    d = np.linspace(-0.001, 0.006, 57)
    frames = np.concatenate([sensor.press(max(x, 0.0)) for x in d])
    run = keep("run.npz", frames, d=d + 1e-4)  # The recorded d has a zero offset of 0.1 mm.
    step("modulus", "--recording", run)
    return folder, sensor


def test_each_step_recovers_the_sensor_properties(bench):
    folder, sensor = bench
    found = load_calibration(folder / "sensor.json")
    assert found.sensor.label == "A17"
    assert np.abs(np.array(found.tare.zero) - sensor.zero).max() < 0.5
    assert found.tare.noise == pytest.approx(math.sqrt(NOISE**2 + 1 / 12), rel=0.05)
    assert found.equilibrate.dead == 1
    assert found.equilibrate.gain[5][6] == 0.0
    assert found.equilibrate.residual < 0.01 < 0.08 < found.equilibrate.spread
    assert found.curve.coefficients[0] == pytest.approx(EXPONENT, abs=0.01)
    assert found.curve.residual < 0.005
    assert found.centre.centre == pytest.approx(CENTRE, abs=3e-5)
    assert found.centre.rotation == pytest.approx(ROTATION, abs=0.01)
    assert found.modulus.modulus == pytest.approx(E, rel=0.02)
    assert found.modulus.offset == pytest.approx(1e-4, abs=2e-5)
    assert found.modulus.material().stress(0.2) == pytest.approx(0.2 * E, rel=0.02)
    assert all(
        (folder / f"sensor.{step}.png").stat().st_size > 5000 for step in ("tare", "modulus")
    )


def test_counts_are_converted_to_the_true_pressure(bench):
    folder, sensor = bench
    converter = Converter(load_calibration(folder / "sensor.json"), 20.0)
    pressure = sensor.grid.pressure(TIP, Material.constant(E), 0.004, 0.2)
    found = converter(sensor.press(0.004, 0.2)[0]).copy()
    live = converter.live & (pressure > 5e3)
    assert np.abs(found[live] / pressure[live] - 1).max() < 0.05
    assert np.abs(found[~live & (pressure == 0)]).mean() < 50.0


@pytest.mark.parametrize("zero", [0.0, 120.0])
def test_the_size_of_a_count_does_not_depend_on_the_zero_offset(zero):
    sensor = Sensor(finger="left", label="", rows=4, cols=4, pitch=(1e-3, 1e-3), full_count=255)
    tare = TareStep(date="", zero=[[zero] * 4] * 4, noise=1.0, frames=9)
    assert Converter(Calibration(sensor=sensor, date="", tare=tare), 500.0).quantum == 500.0


def daemon_settings(folder, recording, **tactile) -> Settings:
    settings = load(folder / "profile.toml")
    tactile = {
        "backend": "replay",
        "recording": (str(recording), ""),
        "calibration": (str(folder / "sensor.json"), ""),
        **tactile,
    }
    raw = settings.model_dump()
    raw["tactile"].update(tactile)
    return Settings.model_validate(raw)


def test_a_recording_of_an_unloaded_tip_may_contain_its_true_d(tmp_path):
    (tmp_path / "profile.toml").write_text(PROFILE)
    np.savez(tmp_path / "rest.npz", frames=MadeUp().counts(np.zeros((N, N)), 9), d=np.zeros(9))
    given = ["--config", str(tmp_path / "profile.toml"), "--no-plot"]
    words = ["calibrate", "tare", str(tmp_path / "a.json"), *given]
    assert main([*words, "--recording", str(tmp_path / "rest.npz")]) == 0
    assert load_calibration(tmp_path / "a.json").tare.frames == 9


def test_a_result_is_told_if_its_plot_cannot_be_written(bench, tmp_path, capsys):
    folder, _ = bench
    (tmp_path / "a.tare.png").mkdir()
    words = ["--config", str(folder / "profile.toml"), "--recording", str(folder / "rest.npz")]
    assert main(["calibrate", "tare", str(tmp_path / "a.json"), *words]) == 0
    told = capsys.readouterr()
    assert told.out.startswith("tare: 200 frames")
    assert "the result was not plotted: [Errno 21] Is a directory: " in told.err


def test_the_daemon_applies_the_file(bench, tmp_path):
    folder, sensor = bench
    path = tmp_path / "held.npz"
    np.savez(path, frames=sensor.press(0.003, 0.15, frames=10))
    with Daemon(daemon_settings(folder, path), wire=False) as daemon:
        daemon.loop.advance(0.05)
        contact = daemon.loop.state.contacts[0]
        assert contact.valid
        assert contact.t_valid == contact.t_arrival > 0.0
        assert contact.d == pytest.approx(0.003, rel=0.02)
        assert contact.theta == pytest.approx(0.15, abs=0.01)
        assert contact.tilt_y == pytest.approx(0.0, abs=0.01)
        assert contact.force == pytest.approx(math.pi * E * 0.003**2 / math.cos(0.15), rel=0.04)
        for perception in daemon.loop.perception.fingers:
            perception.tare()  # The tare replaces the zero offset [counts].
        daemon.loop.advance(0.3)
        assert daemon.loop.state.contacts[0].d == 0.0


def test_subscribers_get_counts_or_the_calibrated_pressure(bench, tmp_path):
    folder, sensor = bench
    path = tmp_path / "held.npz"
    np.savez(path, frames=sensor.press(0.003, 0.15, frames=10))
    settings = daemon_settings(folder, path)
    in_pascal = settings.changed(stream={"tactile_unit": "Pa"})
    calibration = load_calibration(folder / "sensor.json")
    for each in (settings, in_pascal):
        with Daemon(each, wire=False) as daemon:
            daemon.loop.advance(0.05)
            (perception,) = daemon.loop.perception.fingers
            frame, facts = perception.frame, perception.info
            shown = perception.published()
            message = tactile_message(frame, shown, 0, facts, 1.0)
        assert message["centre_x"] == calibration.centre.centre[0]
        assert message["rotation"] == calibration.centre.rotation
        assert message["calibration"] == f"A17 {calibration.date}"
        pressure = Converter(calibration, 20.0)(frame.data)
        if each is settings:
            assert (message["unit"], message["calibrated"]) == ("count", False)
            assert shown is frame.data
            # The scale is the mean slope of the curve up to saturation, but these readings are at
            # a fifth of this range, where the slope of x^1.25 is two thirds of the mean slope.
            strong = pressure > 2e4
            ratio = shown[strong] * message["scale"] / pressure[strong]
            assert np.median(ratio) == pytest.approx(5.0 ** (EXPONENT - 1.0), rel=0.1)
        else:
            assert (message["unit"], message["calibrated"]) == ("Pa", True)
            assert np.abs(shown * message["scale"] - pressure).max() <= 0.5 * message["scale"]
            assert message["scale"] < 20.0


@pytest.mark.parametrize(
    ("tactile", "told"),
    [
        ({"sensor": ("B2", "")}, "sensor: found A17, expected B2"),
        ({"pitch": 0.001}, "pitch: found 1.8125 × 1.8125 mm, expected 1 × 1 mm"),
        ({"full_count": 255}, "full_count: found 4095, expected 255"),
    ],
)
def test_the_calibration_of_another_sensor_is_refused(bench, tmp_path, tactile, told):
    folder, sensor = bench
    path = tmp_path / "held.npz"
    np.savez(path, frames=sensor.press(0.003))
    with pytest.raises(CalibrationFileError, match=f"another sensor: {told}"):
        Daemon(daemon_settings(folder, path, **tactile), wire=False)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["curve", "--recording", "rest.npz"], "expected --force or --d"),
        (["curve", "--recording", "rest.npz", "--force", "1", "2"], "2 values for 1 loads"),
        (["modulus", "--recording", "rest.npz"], "expected --d"),
        (["centre", "--recording", "rest.npz"], "press 1 did not produce a valid contact"),
        (["relaxation", "--recording", "rest.npz", "rest.npz"], "found 2 presses, expected one"),
        (["tare", "--recording", "none.npz"], "No such file"),
        (
            ["tare", "--recording", "rest.npz", "--finger", "right"],
            "finger: found left, expected right",
        ),
    ],
)
def test_impossible_steps_are_reported_and_change_nothing(bench, capsys, words, told):
    folder, _ = bench
    before = (folder / "sensor.json").read_bytes()
    step, *words = [str(folder / word) if word.endswith(".npz") else word for word in words]
    words += ["--config", str(folder / "profile.toml")]
    assert main(["calibrate", step, str(folder / "sensor.json"), *words]) == 1
    assert told in capsys.readouterr().err
    assert (folder / "sensor.json").read_bytes() == before


@pytest.mark.parametrize("command", ["true {d.mm}", "true {d[0]}", "true {x}", "true {d", "true '"])
def test_an_invalid_move_command_is_reported(command):
    with pytest.raises(CalibrationError, match=f"^--move: {re.escape(command)}: "):
        calibration_frames.bring(SimpleNamespace(move=command), "apply load 1", load=1)


def test_a_gain_that_no_grip_has_measured_is_refused(tmp_path, capsys, monkeypatch):
    contact = SimpleNamespace(sensor_gain=0.5, sensor_gain_std=0.15)
    monkeypatch.setattr(calibrate, "_last_state", lambda _: SimpleNamespace(left=contact))
    assert main(["calibrate", "scales", str(tmp_path / "left.json")]) == 1
    assert (
        "found a gain of 0.50 ± 0.15, expected a standard deviation of less than 20% of the gain"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: c.update(format=2), "format"),
        (lambda c: c.update(colour="red"), "colour"),
        (lambda c: c["tare"].update(zero=[[1.0]]), "expected 32 rows"),
        (lambda c: c["tare"]["zero"][3].__setitem__(4, -1.0), "expected numbers ≥ 0"),
        (lambda c: c["tare"]["zero"][3].__setitem__(4, float("nan")), "tare"),
        (
            lambda c: c["tare"].update(zero=[[4095.0] * N] * N),
            "tare.zero: most cells are saturated",
        ),
        (
            lambda c: c["curve"].update(coefficients=[1.0, 5.0, -1.0, 0.0]),
            "must increase",
        ),
        (
            lambda c: c["curve"].update(coefficients=[1.2, -5.0, 0.0, 0.0]),
            "must increase",
        ),
        (
            lambda c: c["curve"].update(coefficients=[100.0, 2.0, 0.0, 0.0]),
            r"x\^100 does not give a "
            "finite",
        ),
        (lambda c: c["modulus"].update(strain=[0.1, 0.2], stress=[1.0]), "modulus"),
        (lambda c: c["sensor"].pop("rows"), "sensor.rows"),
    ],
)
def test_an_invalid_calibration_file_is_refused_with_the_reason(bench, tmp_path, change, told):
    content = json.loads((bench[0] / "sensor.json").read_text())
    change(content)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(content))
    with pytest.raises(CalibrationFileError, match=told):
        Converter(load_calibration(path), 4.0)


@pytest.mark.parametrize(
    ("step", "known", "told"),
    [
        ("curve", {"d": [0.002, 0.03]}, "d: found 30 mm, expected at most 20 mm, the tip's radius"),
        (
            "modulus",
            {"d": [0.002, 0.03]},
            "d: found 30 mm, expected at most 20 mm, the tip's radius",
        ),
        (
            "modulus",
            {"d": [0.002, 0.004], "theta": [0.0, -1.6]},
            "theta: found 91.6732°, expected less than 90°",
        ),
        ("modulus", {"d": [-0.001, 0.0]}, "the run does not contain any frames with d above 0"),
        ("centre", {"words": ["--theta", "nan"]}, "theta: found a value that is not finite"),
        ("curve", {"words": ["--d", "inf"]}, "d: found a value that is not finite"),
        (
            "modulus",
            {"d": [0.002, 0.004], "words": ["--theta", "95"]},
            "theta: found 95°, expected less than 90°",
        ),
        (
            "curve",
            {"d": [0.002, 0.004], "words": ["--force", "1", "2", "3"]},
            "--force: found 3 values for 2 loads",
        ),
        (
            "curve",
            {
                "d": [0.004, 0.009],
                "words": ["--set", "tip.physics=solid", "--set", "safety.d_max=0.008"],
            },
            "curve: d = 9 mm at θ = 0° is outside the range of the model (tip.physics = solid)",
        ),
        ("equilibrate", {"frames": SATURATED}, "equilibrate: load 1 saturates a cell"),
        (
            "curve",
            {"frames": SATURATED, "words": ["--force", "1"]},
            "curve: load 1 saturates a cell",
        ),
        (
            "tare",
            {
                "frames": np.concatenate([MadeUp().press(d, frames=5) for d in (0, 0.004)]),
                "d": np.repeat([0.0, 0.004], 5),
            },
            "tare: the readings of ",
        ),
        ("tare", {"frames": np.full((9, N, N), 4095, np.uint16)}, "tare: most cells are saturated"),
        (
            "law",
            {"frames": np.zeros((3, N, N), np.uint16), "d": [0.002, 0.004, 0.006]},
            "law: found a modulus of at most 0 for each tip model",
        ),
    ],
)
def test_impossible_contacts_are_refused_in_one_line(step, known, told, tmp_path, capsys):
    words = known.pop("words", [])
    (tmp_path / "profile.toml").write_text(PROFILE)
    path = tmp_path / "run.npz"
    np.savez(path, **{"frames": MadeUp().press(0.003, frames=2), **known})
    file = tmp_path / "sensor.json"
    given = ["--config", str(tmp_path / "profile.toml"), "--recording", str(path), *words]
    assert main(["calibrate", step, str(file), *given, "--no-plot"]) == 1
    assert told in capsys.readouterr().err
    assert not file.exists()
