"""`softfinger calibrate` live: a board on a pty pressed load by load, a press at known speed, and
what the daemon makes of the file."""

from __future__ import annotations

import math
import re
import select
import sys
import threading

import numpy as np
import pytest

from softfinger.daemon.clock import RealClock, VirtualClock
from softfinger.daemon.perception.calibration_file import load_calibration
from softfinger.daemon.simulation.emulator.tactile_board import ENCODERS, TactileBoard
from softfinger.daemon.types import Frame
from softfinger.kinematics.contact.material import Material
from softfinger.tools.calibration import calibration_frames
from softfinger.tools.cli import main
from tests.unit.test_calibrate import CENTRE, EXPONENT, NOISE, PROFILE, ROTATION, TIP, E, MadeUp, N

MATERIAL = Material.constant(E)
RATE = 400.0  # Hz
FRAMES = 12


class Bench:
    """A board on a pty over the made-up sensor; each Enter puts the next load on."""

    def __init__(self) -> None:
        self.sensor = MadeUp()
        self.loads: list[np.ndarray] = []
        self._clock = RealClock()
        self._images = [self.sensor.counts(np.zeros((N, N)), 64)]
        self._number = 0
        self.board = TactileBoard(self, ENCODERS["cobs"], RATE, 0.0)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def latest(self) -> Frame:
        self._number += 1
        images = self._images[0]
        t = self._clock.now()
        return Frame(self._number, t, t, True, images[self._number % len(images)])

    def readline(self) -> str:
        """As the standard input of the tool."""
        if not self.loads:
            return ""
        self._images[0] = self.sensor.counts(self.loads.pop(0), 64)
        return "\n"

    def _serve(self) -> None:
        t = 0.0
        while not self._over.is_set():
            select.select([], [], [], 1.0 / RATE)
            t += 1.0 / RATE
            self.board.service(t)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self.board.close()


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """All steps that are done load by load, live; the folder, the sensor, and all that was said."""
    folder = tmp_path_factory.mktemp("live")
    bench = Bench()
    port = PROFILE.replace('"simulated"', f'"cobs"\nport = ["{bench.board.path}", "none"]')
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
    step("modulus", [pressed(d) for d in depths], "--no-plot", "--d", "2", "3", "4")
    patch.undo()
    bench.close()
    return folder


def test_load_by_load_from_a_board(live):
    found = load_calibration(live / "sensor.json")
    sensor = MadeUp()
    assert (found.sensor.label, found.sensor.finger, found.tare.frames) == ("A17", "left", FRAMES)
    assert np.abs(np.array(found.tare.zero) - sensor.zero).max() < 2.0
    assert found.tare.noise == pytest.approx(math.hypot(NOISE, math.sqrt(1 / 12)), rel=0.1)
    assert found.equilibrate.dead == 1
    assert found.curve.coefficients[0] == pytest.approx(EXPONENT, abs=0.03)
    assert found.centre.centre == pytest.approx(CENTRE, abs=1e-4)
    assert found.centre.rotation == pytest.approx(ROTATION, abs=0.02)
    assert found.modulus.modulus == pytest.approx(E, rel=0.05)
    steps = (found.tare, found.equilibrate, found.curve, found.centre, found.modulus)
    assert all(found.date >= step.date > "2020" for step in steps)
    assert max(step.residual for step in steps[1:]) < 0.02
    assert sorted(each.name for each in live.iterdir()) == [
        "profile.toml", "sensor.json", "sensor.tare.png"
    ]  # fmt: skip
    assert (live / "sensor.tare.png").stat().st_size > 5000


@pytest.fixture
def virtual(monkeypatch):
    """No machine is too busy for a press of the simulated sensor."""
    monkeypatch.setattr(calibration_frames, "RealClock", VirtualClock)


@pytest.fixture
def pressed(tmp_path, virtual):
    """The words for a press at known speed after its tare, of a simulated sensor."""
    profile = tmp_path / "press.toml"
    text = PROFILE.replace('clock = "virtual"', 'clock = "real"') + "rate = 200.0\n"
    profile.write_text(text + "[simulation]\ncompression_speed = 0.05\ntactile_noise = 300.0\n")
    words = [str(tmp_path / "a.json"), "--config", str(profile), "--no-plot", "--frames", "40"]
    assert main(["calibrate", "tare", *words, "--set", "simulation.compression_speed=0"]) == 0
    return ["calibrate", "modulus", *words, "--speed", "50", "--law"]


@pytest.mark.parametrize("dropped", [0.0, 0.2])
def test_a_press_at_known_speed_gives_the_modulus(tmp_path, capsys, pressed, dropped):
    assert main([*pressed, "--set", f"simulation.tactile_dropped={dropped}"]) == 0
    found = load_calibration(tmp_path / "a.json").modulus
    assert found.modulus == pytest.approx(E, rel=0.03)
    assert found.material().stress(0.2) == pytest.approx(0.2 * E, rel=0.05)
    assert "press at 50 mm/s" in capsys.readouterr().err


@pytest.mark.parametrize(("seen", "unseen"), [(7, 45), (1, 20)])
def test_a_press_of_which_the_most_was_not_seen_is_wanted_again(
    capsys, monkeypatch, pressed, seen, unseen
):
    fresh = calibration_frames._fresh

    def some(*where):
        touched = 0
        for frame in fresh(*where):
            touched += touched > 0 or np.count_nonzero(frame.data > 60) > 5
            if not seen < touched <= unseen:
                yield frame

    monkeypatch.setattr(calibration_frames, "_fresh", some)
    assert main(pressed) == 1
    assert re.search("press again|press slower", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["curve", "--speed", "4"], "only modulus takes it"),
        (["modulus", "--speed", "4", "--d", "3"], "only modulus takes it, instead of --d"),
        (["modulus", "--speed", "400"], "press slower|press again"),  # by how many frames came
        (["modulus", "--speed", "4"], "tare first"),
        (["centre", "--theta", "0", "5"], "ended before all loads were on"),
    ],
)
def test_what_cannot_be_done_live(tmp_path, capsys, monkeypatch, virtual, words, told):
    profile = tmp_path / "press.toml"
    text = PROFILE.replace('clock = "virtual"', 'clock = "real"')
    profile.write_text(text + "[simulation]\ncompression_speed = 0.4\ntactile_noise = 300.0\n")
    monkeypatch.setattr(sys, "stdin", type("Ended", (), {"readline": lambda _: ""})())
    file, options = tmp_path / "a.json", ["--config", str(profile), "--no-plot", "--frames", "8"]
    if "400" in words:
        still = ["--set", "simulation.compression_speed=0"]
        assert main(["calibrate", "tare", str(file), *options, *still]) == 0
    before = file.read_bytes() if file.exists() else b""
    assert main(["calibrate", words[0], str(file), *words[1:], *options]) == 1
    assert re.search(told, capsys.readouterr().err)
    assert (file.read_bytes() if file.exists() else b"") == before


def test_without_matplotlib_the_step_is_done_and_the_missing_picture_told(
    live, tmp_path, capsys, monkeypatch
):
    for name in [each for each in sys.modules if each.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    frames = tmp_path / "rest.npz"
    np.savez(frames, frames=MadeUp().counts(np.zeros((N, N)), 10))
    words = ["--config", str(live / "profile.toml"), "--recording", str(frames)]
    assert main(["calibrate", "tare", str(tmp_path / "a.json"), *words]) == 0
    assert "no picture is drawn: pictures need matplotlib" in capsys.readouterr().err
    assert load_calibration(tmp_path / "a.json").tare.frames == 10
    picture = ["--plot", str(tmp_path / "a.png")]
    assert main(["calibrate", "tare", str(tmp_path / "b.json"), *words, *picture]) == 1
    assert "pip install 'softfinger[plot]'" in capsys.readouterr().err
    assert not (tmp_path / "b.json").exists()
