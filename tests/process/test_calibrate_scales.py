"""Test that `calibrate scales` stores factors that the next daemon uses."""

from pathlib import Path
from typing import Any

import pytest

from softfinger import Hand
from softfinger.daemon.perception.calibration_file import load_calibration
from softfinger.daemon.wire.schema import STATE
from softfinger.tools.cli import main
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.simulated_daemon import SimulatedDaemon
from tests.harness.recorded_hand import record_hand
from tests.unit.test_control import grasped


@pytest.mark.extended
def test_a_daemon_starts_with_factors_from_earlier_grips(
    start, profile, addresses, tmp_path, capsys
):
    start("--config", str(profile("loop.rate = 500.0\nsimulation.tactile_gain = [0.6, 1.4]\n")))
    files = tuple(str(tmp_path / f"{name}.json") for name in ("left", "right"))

    def calibrate(finger: int) -> int:
        words = ["--finger", ("left", "right")[finger], "--address", addresses[0]]
        return main(["calibrate", "scales", files[finger], *words])

    with Hand(*addresses, timeout=60.0) as hand:
        hand.state()
        assert calibrate(0) == 1
        assert "first grasp an object firmly" in capsys.readouterr().err
        assert not Path(files[0]).exists()
        hand.arm()
        hand.grasp(force=10.0)
        hand.wait_for(lambda state: state.mode == "holding", 60.0)
        assert [calibrate(0), calibrate(1)] == [0, 0]
        found = [load_calibration(Path(file)).scales for file in files]
    for step, gain in zip(found, (0.6, 1.4), strict=True):
        assert step.gain[0] == pytest.approx(gain, rel=0.1)
        assert step.modulus[0] == pytest.approx(1.0, rel=0.1)
    assert f"gain {found[0].gain[0]:.3f} ± " in capsys.readouterr().out

    wrong = {"simulation": {"tactile_gain": (0.6, 1.4)}, "tactile": {"calibration": files}}
    with SimulatedDaemon(wrong) as after:
        first = grasped(after, 8.0).force
        assert first[-250:].mean() == pytest.approx(8.0, rel=0.05)
        assert first.max() < 1.12 * 8.0
        assert after.contacts[0].sensor_gain == pytest.approx(0.6, rel=0.1)
        assert not [event for event in after.events if event[1].startswith("consistency")]


def test_factors_can_be_taken_from_the_last_state_of_a_recording(tmp_path, capsys):
    run, file = tmp_path / "run.mcap", tmp_path / "left.json"
    due: dict[int, dict[str, Any]] = {
        100: {"command": "arm"},
        200: {"command": "grasp", "force": 9.0},
    }
    record_hand(run, due, 2.0)
    words = ["calibrate", "scales", str(file), "--recording", str(run)]
    assert main(words) == 0
    *_, (_, last) = Recording(run).messages({STATE})
    told = last["left"]
    found = load_calibration(file).scales
    mean, std = told["torque_scale"], told["torque_scale_std"]
    assert found.torque == pytest.approx((mean, std / mean))
    without = tmp_path / "without.mcap"
    record_hand(without, {}, 0.1, ("stream.state_rate=1",))
    assert main([*words, str(without)]) == 1
    assert f"{without}: the recording does not contain hand/state" in capsys.readouterr().err
