"""Test `emulate --send press` and `calibrate` with an emulated hand that has rubber tips."""

import math
import re
import sys

import pytest

from softfinger.daemon.perception.calibration_file import load_calibration
from softfinger.daemon.profile.load import load
from softfinger.daemon.simulation.emulator.folder import carry_out
from softfinger.tools.cli import main
from tests.harness.emulated import HIL, emulated

LINEAR = ["--set", "material.law=constant", "--set", "material.modulus=0.3e6"]
RUBBER = ["tip.physics=solid", "tip.poisson=0.48", "safety.d_max=0.008", *LINEAR[1::2]]


class Stage:
    """Simulated user of the test stand, who applies each load and then presses Enter."""

    def __init__(self, folder, presses):
        self._folder, self._presses = folder, list(presses)

    def readline(self):
        carry_out(self._folder, f"press {self._presses.pop(0)} speed=100mm/s")
        return "\n"


@pytest.fixture(scope="module")
def rubber(tmp_path_factory):
    """Yield the folder and the log of an emulated hand with solid rubber tips."""
    folder = tmp_path_factory.mktemp("hand")
    log = []
    with emulated(folder, settings=load(HIL, folder, RUBBER), tell=log.append):
        yield folder, log


def calibrate(folder, step, *words):
    arguments = ["calibrate", step, str(folder / "left.json"), "--config", "hil", *LINEAR]
    return main([*arguments, "--dir", str(folder), "--no-plot", "--frames", "40", *words])


@pytest.mark.extended
def test_a_rubber_tip_is_distinguished_from_springs(rubber, monkeypatch, capsys):
    folder, log = rubber
    assert calibrate(folder, "tare") == 0
    presses = [(1, 0), (2, 0), (3, -10), (4, 20), (4, 0), (3, 10)]
    stage = Stage(folder, [f"tip=left depth={d}mm tilt={theta}deg" for d, theta in presses])
    monkeypatch.setattr(sys, "stdin", stage)
    d, theta = ([str(each[k]) for each in presses] for k in (0, 1))
    assert calibrate(folder, "law", "--d", *d, "--theta", *theta) == 0
    told = capsys.readouterr().out
    assert 'for the profile: tip.physics = "solid", tip.base = "bonded"' in told
    assert "measured: curves from 6 presses up to 4 mm and 20°" in told
    found = load_calibration(folder / "left.json")
    assert found.modulus.modulus == pytest.approx(0.3e6, rel=0.1)
    assert found.modulus.offset == pytest.approx(0.0, abs=1e-4)
    pressed = re.fullmatch(r"plate: left 3.000 mm at 10.00°, ([0-9.]+) N", log[-1])
    force = found.law.at(found.law.push, 3e-3, math.radians(10.0)) * math.cos(math.radians(10.0))
    assert force == pytest.approx(float(pressed[1]), rel=0.03)


def test_a_stage_is_moved_by_a_program(rubber, capsys):
    folder, _ = rubber
    stage = f"{sys.executable} -m softfinger emulate --dir {folder} --send"
    move = ["--move", f"{stage} 'press force={{force}}N speed=100mm/s'"]
    assert calibrate(folder, "curve", "--force", "5", "15", *move) == 0
    assert "loads, force error" in capsys.readouterr().out
    assert calibrate(folder, "curve", "--force", "1e4", *move) == 1
    assert "exited with status 1" in capsys.readouterr().err
    for words in ("press depth=3", "press tip=left", "press depth=9mm"):
        assert main(["emulate", "--dir", str(folder), "--send", words]) == 1
    told = capsys.readouterr().err
    assert "depth=3: expected a number in mm or m" in told
    assert "expected at most 7.99 mm" in told
