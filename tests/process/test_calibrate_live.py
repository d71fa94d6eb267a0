"""Test `softfinger calibrate` with a live board on a pty, one load at a time."""

import contextlib
import io
import math
import signal
import sys

import numpy as np
import pytest

from softfinger.daemon.clock import RealClock, VirtualClock
from softfinger.daemon.perception.calibration_file import load_calibration
from softfinger.daemon.types import Frame
from softfinger.kinematics.contact.material import Material
from softfinger.tools.calibration import calibration_frames
from softfinger.tools.cli import main
from tests.harness.tactile import Rig
from tests.unit.test_calibrate import CENTRE, EXPONENT, NOISE, PROFILE, ROTATION, TIP, E, MadeUp, N

MATERIAL = Material.constant(E)
FRAMES = 12


class Bench:
    """Frame source for a live board; each press of Enter applies the next load."""

    def __init__(self) -> None:
        self.sensor = MadeUp()
        self.loads: list[np.ndarray] = []
        self._clock = RealClock()
        self._images = [self.sensor.counts(np.zeros((N, N)), 64)]
        self._number = 0

    def latest(self) -> Frame:
        self._number += 1
        images = self._images[0]
        t = self._clock.now()
        return Frame(self._number, t, t, True, images[self._number % len(images)])

    def readline(self) -> str:
        """Replace the tool's standard input."""
        if not self.loads:
            return ""
        self._images[0] = self.sensor.counts(self.loads.pop(0), 64)
        return "\n"


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """Run all steps that need loads; return the folder, the sensor and all messages."""
    folder = tmp_path_factory.mktemp("live")
    bench = Bench()
    rig = Rig("cobs", folder, source=bench)
    # The board sends 320 frames in less than 2.8 s, which the default time constants require.
    profile = f"tip.relaxation_times = [0.004, 0.03, 0.3]\n{PROFILE}"
    port = profile.replace('"simulated"', f'"cobs"\nport = ["{rig.board.path}", "none"]')
    (folder / "profile.toml").write_text(port.replace('clock = "virtual"', 'clock = "real"'))
    patch = pytest.MonkeyPatch()
    patch.setattr(sys, "stdin", bench)

    def step(name, loads, *words):
        bench.loads = loads
        arguments = ["calibrate", name, str(folder / "sensor.json"), "--frames", str(FRAMES)]
        arguments += ["--config", str(folder / "profile.toml"), *words]
        assert main(arguments) == 0
        assert not bench.loads

    def pressed(d, theta=0.0):
        return bench.sensor.grid.pressure(TIP, MATERIAL, d, math.radians(theta))

    step("tare", [])
    step("equilibrate", [np.full((N, N), p) for p in (3e3, 15e3)], "--loads", "2", "--no-plot")
    depths = (0.002, 0.003, 0.004)
    forces = [f"{math.pi * E * d * d:.6f}" for d in depths]
    step("curve", [pressed(d) for d in depths], "--no-plot", "--force", *forces)
    tilts = (-12.0, 0.0, 12.0)
    presses = [pressed(0.003, t) for t in tilts]
    step("centre", presses, "--no-plot", "--theta", *map(str, tilts))
    with contextlib.redirect_stdout(io.StringIO()) as said:
        step("relaxation", [pressed(0.003)], "--no-plot", "--d", "3", "--frames", "320")
    patch.undo()
    rig.__exit__()
    (folder / "relaxation").write_text(said.getvalue())
    return folder


def test_a_board_is_calibrated_load_by_load(live):
    found = load_calibration(live / "sensor.json")
    sensor = MadeUp()
    assert (found.sensor.label, found.sensor.finger, found.tare.frames) == ("A17", "left", FRAMES)
    assert np.abs(np.array(found.tare.zero) - sensor.zero).max() < 2.0
    assert found.tare.noise == pytest.approx(math.hypot(NOISE, math.sqrt(1 / 12)), rel=0.1)
    assert found.equilibrate.dead == 1
    assert found.curve.coefficients[0] == pytest.approx(EXPONENT, abs=0.03)
    assert found.centre.centre == pytest.approx(CENTRE, abs=1e-4)
    assert found.centre.rotation == pytest.approx(ROTATION, abs=0.02)
    steps = (found.tare, found.equilibrate, found.curve, found.centre)
    assert all(found.date >= step.date > "2020" for step in steps)
    assert max(step.residual for step in steps[1:]) < 0.02
    assert sorted(each.name for each in live.iterdir()) == [
        "profile.toml", "relaxation", "sensor.json", "sensor.tare.png"
    ]  # fmt: skip
    assert (live / "sensor.tare.png").stat().st_size > 5000


def test_relaxation_is_zero_for_a_tip_without_relaxation(live):
    said = (live / "relaxation").read_text()
    found = [float(each) for each in said.partition("[")[2].partition("]")[0].split(", ")]
    assert found == pytest.approx([0.0, 0.0, 0.0], abs=0.02)
    assert "written to" not in said


@pytest.mark.parametrize("step", ["centre --theta 0 5", "centre", "equilibrate", "relaxation"])
def test_missing_loads_change_nothing(step, tmp_path, capsys, monkeypatch):
    profile = tmp_path / "press.toml"
    profile.write_text(PROFILE.replace('clock = "virtual"', 'clock = "real"'))
    monkeypatch.setattr(sys, "stdin", type("Ended", (), {"readline": lambda _: ""})())
    monkeypatch.setattr(calibration_frames, "RealClock", VirtualClock)
    file = tmp_path / "a.json"
    name, *words = step.split()
    words = ["calibrate", name, str(file), *words, "--config", str(profile)]
    assert main([*words, "--no-plot", "--frames", "8"]) == 1
    assert "ended before all loads were applied" in capsys.readouterr().err
    assert not file.exists()


def test_a_missing_folder_is_reported_before_the_first_load(tmp_path, capsys):
    (tmp_path / "press.toml").write_text(PROFILE)
    words = ["calibrate", "centre", str(tmp_path / "no" / "a.json"), "--move", "true"]
    assert main([*words, "--config", str(tmp_path / "press.toml")]) == 1
    assert capsys.readouterr().err == f"calibrate: {tmp_path / 'no'}: No such file or directory\n"


@pytest.mark.parametrize("step", ["centre", "relaxation"])
def test_ctrl_c_ends_the_wait_for_a_load(step, tmp_path, monkeypatch):
    is_waiting = []

    class Terminal:
        def readline(self) -> str:
            signal.raise_signal(signal.SIGINT)
            is_waiting.append(True)
            return ""

    profile = tmp_path / "press.toml"
    profile.write_text(PROFILE.replace('clock = "virtual"', 'clock = "real"'))
    monkeypatch.setattr(sys, "stdin", Terminal())
    monkeypatch.setattr(calibration_frames, "RealClock", VirtualClock)
    words = ["calibrate", step, str(tmp_path / "a.json"), "--config", str(profile)]
    assert main(words) == 130
    assert not is_waiting


def test_the_end_of_a_replay_is_reported(tmp_path, capsys, monkeypatch):
    np.savez(tmp_path / "rest.npz", frames=MadeUp().counts(np.zeros((N, N)), 3))
    monkeypatch.setattr(calibration_frames, "RealClock", VirtualClock)
    profile = tmp_path / "replay.toml"
    replay = f'"replay"\nreplay_again = false\nrecording = ["{tmp_path / "rest.npz"}", ""]'
    profile.write_text(PROFILE.replace('"simulated"', replay))
    assert main(["calibrate", "tare", str(tmp_path / "a.json"), "--config", str(profile)]) == 1
    assert "the sensor stopped sending: the recording has ended" in capsys.readouterr().err


def test_without_matplotlib_the_step_succeeds_and_reports_the_missing_plot(
    live, tmp_path, capsys, monkeypatch
):
    for name in [each for each in sys.modules if each.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    frames = tmp_path / "rest.npz"
    np.savez(frames, frames=MadeUp().counts(np.zeros((N, N)), 10))
    words = ["--config", str(live / "profile.toml"), "--recording", str(frames)]
    assert main(["calibrate", "tare", str(tmp_path / "a.json"), *words]) == 0
    assert "the result was not plotted: plots require matplotlib" in capsys.readouterr().err
    assert load_calibration(tmp_path / "a.json").tare.frames == 10
