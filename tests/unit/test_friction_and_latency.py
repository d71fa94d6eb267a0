"""Test `calibrate friction` and `calibrate latency` on hands for which the profile is wrong."""

import argparse
import math
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest

from softfinger import Hand
from softfinger.daemon.client.command_client import NoAnswer
from softfinger.daemon.errors import Refused
from softfinger.daemon.profile.load import load
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.latency_fit import fit_latency
from softfinger.kinematics.calibration.servo_fit import fit_friction
from softfinger.tools.calibration import motion
from softfinger.tools.calibration.motion import _way
from softfinger.tools.cli import main
from tests.harness.recorded_hand import record_hand

Due = dict[int, dict[str, Any]]

EMPTY = "simulation.object_position=[0.0,0.3]"  # The object is out of reach.
CONFIG = Path(__file__).parents[2] / "config"
SMALL, VELOSTAT = CONFIG / "small.toml", str(CONFIG / "velostat.toml")
COUNT = 1.78 * 2.69e-3  # torque per current count of an XM430 [N·m]
TICK = 2e-3  # s


def sweeps(*strokes: tuple[float, float]) -> tuple[Due, float]:
    """Return the commands for strokes (angle [rad], velocity [rad/s]), and the end time [s]."""
    due: Due = {100: {"command": "arm"}}
    tick = 150
    for wide, speed in strokes:
        for first, last in ((0.0, wide), (wide, 0.0)):
            steps = round(abs(wide) / speed / (10 * TICK))
            for k in range(1, steps + 1):
                angle = first + (last - first) * k / steps
                due[tick + 10 * k] = {"command": "move", "left": angle, "right": angle}
            tick += 10 * steps + 200
    return due, (tick + 100) * TICK


def calibrate(step: str, folder: Any, *words: str) -> int:
    profile = folder / "my.toml"
    if not profile.exists():
        profile.write_text("", encoding="utf-8")
    recording = str(folder / "run.mcap")
    return main(["calibrate", step, str(profile), "--recording", recording, *words])


@pytest.mark.parametrize(
    ("friction", "more", "expected", "at_rest"),
    [(0.02, 0.0, 0.02, None), (0.2, 0.0, 0.2, None), (0.05, 0.15, 0.06, 0.2)],
)
def test_friction_is_measured_by_a_sweep(tmp_path, capsys, friction, more, expected, at_rest):
    due, end = sweeps((-0.05, 0.05), (-0.05, 0.05), (-0.4, 0.3), (-0.4, 0.6))
    hand = (f"simulation.joint_friction={friction}", f"simulation.joint_stribeck={more}")
    record_hand(tmp_path / "run.mcap", due, end, (EMPTY,), hand=hand)
    assert calibrate("friction", tmp_path) == 0
    told = capsys.readouterr().out
    found = load(tmp_path / "my.toml").control.joint_friction
    # The additional static friction decreases by a factor of e per 0.12 rad/s. At the test's
    # velocities, a tenth of the additional friction remains.
    assert found == pytest.approx(expected, abs=2 * COUNT)
    assert f"control.joint_friction = {found:g}" in told
    assert ("at break-away" in told) == (at_rest is not None)
    if at_rest is not None:
        shown = float(told.split("at break-away ")[1].split(" ")[0])
        assert shown == pytest.approx(at_rest, abs=3 * COUNT)


def test_friction_of_a_small_servo(tmp_path):
    due, end = sweeps((-0.4, 0.3), (-0.4, 0.6))
    (tmp_path / "my.toml").write_text(SMALL.read_text(encoding="utf-8"), encoding="utf-8")
    hand = ("simulation.joint_friction=0.006",)
    record_hand(tmp_path / "run.mcap", due, end, (EMPTY,), profile=str(SMALL), hand=hand)
    assert calibrate("friction", tmp_path) == 0
    found = load(tmp_path / "my.toml").control.joint_friction
    # The gear friction is a quarter of the gear torque.
    assert found == pytest.approx(0.006 / (1.0 - 0.25), abs=1e-3)


def test_torque_independent_of_direction_is_not_friction():
    t = np.arange(0.0, 16.0, 0.01)
    q = 0.2 * np.cos(2.0 * math.pi * t / 4.0)
    rate, acceleration = np.gradient(q, t), np.gradient(np.gradient(q, t), t)
    weight = 0.06 * np.sin(q) + 0.04
    torque = 0.08 * np.sign(rate) + 0.03 * rate + 0.013 * acceleration + weight
    noise = np.random.default_rng(3).normal(0.0, 0.003, t.size)
    shown = COUNT * np.round((torque + noise) / COUNT)
    found = fit_friction(t, q, q, shown, 0.010, COUNT)
    assert found.coulomb == pytest.approx(0.08, abs=2 * found.coulomb_std)
    assert found.viscous == pytest.approx(0.03, abs=2 * found.viscous_std)
    assert found.coulomb_std < COUNT
    closing = np.maximum.accumulate(q[t < 4.0])
    with pytest.raises(CalibrationError, match=r"0\.\d s of closing motion and 0\.0 s of opening"):
        fit_friction(t[t < 4.0], closing, closing, shown[t < 4.0], 0.010, COUNT)
    with pytest.raises(CalibrationError, match=r"found a state every 40 ms.*stream\.state_rate"):
        fit_friction(t[::4], q[::4], q[::4], shown[::4], 0.010, COUNT)
    with pytest.raises(CalibrationError, match=r"found 0\.0 s of closing"):
        fit_friction([], [], [], [], 0.010, COUNT)


def test_a_joint_that_settles_without_its_goal_did_not_break_away():
    # A person moves the joint and lets go: the joint creeps by 3 mrad, and the goal never moves.
    moved = 0.5 * np.abs(np.arange(0.0, 6.0, 0.01) % 2.0 - 1.0)
    q = np.concatenate([moved, np.full(100, 0.5), np.linspace(0.5, 0.503, 4), np.full(100, 0.503)])
    fit = fit_friction(0.01 * np.arange(q.size), q, np.zeros(q.size), 0.1 - 0.2 * q, 0.01, COUNT)
    assert math.isnan(fit.stiction)


def test_only_motion_without_contact_is_used(tmp_path, capsys):
    due: Due = {
        100: {"command": "arm"},
        150: {"command": "grasp", "force": 8.0},
        1000: {"command": "release"},
    }
    record_hand(tmp_path / "run.mcap", due, 3.0)
    assert calibrate("friction", tmp_path) == 1
    assert "friction: left: found 0.1 s of closing motion and " in capsys.readouterr().err
    assert load(tmp_path / "my.toml").control.joint_friction == 0.05


def test_impossible_times_are_refused():
    t, still = np.array([0.0, 1e9]), np.zeros(2)
    with pytest.raises(CalibrationError, match="found 1000000000 s of data"):
        fit_friction(t, still, still, still, 0.010, COUNT)
    frames = np.linspace(0.0, 1.0, 50)
    with pytest.raises(CalibrationError, match="found 1000000000 s of data"):
        fit_latency((frames, frames, frames), (t, still), (2e-5, 0.2), 0.02)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--set", "servos.model=XL430-W250"], "a model that measures its current"),
        (["--recording", "a.mcap", "b.mcap"], "expected at most one --recording"),
    ],
)
def test_data_without_friction_are_refused(tmp_path, capsys, words, why):
    assert calibrate("friction", tmp_path, *words) == 1
    assert why in capsys.readouterr().err


@pytest.mark.parametrize("command", ["command", "disarm"])
@pytest.mark.parametrize(
    ("error", "is_stopped"),
    [(NoAnswer("no reply"), True), (KeyboardInterrupt(), True), (Refused("in use"), False)],
    ids=["no reply", "Ctrl-C", "refused"],
)
def test_torque_is_off_after_a_command_without_a_reply(monkeypatch, command, error, is_stopped):
    client = MagicMock(spec=Hand)
    client.__enter__.return_value = client
    getattr(client, command).side_effect = error
    seen = [Mock(mode=mode, torque=mode == "armed", mono_ns=1) for mode in ("disarmed", "armed")]
    monkeypatch.setattr(motion, "Hand", lambda *_, **__: client)
    monkeypatch.setattr(motion, "subscribe", MagicMock())
    monkeypatch.setattr(motion.LiveHand, "states", lambda _: iter(seen))
    arguments = argparse.Namespace(address=("tcp://127.0.0.1:1", ""), keys=None)
    with pytest.raises(type(error)), motion.live_hand(arguments):
        pass
    # A refused `arm` has no effect, so the hand may belong to another client.
    assert client.stop.called == (is_stopped or command == "disarm")


def test_a_sweep_avoids_contact():
    assert _way(load(None), "left") == (0.0, -0.4)
    inward = load(None, changes=["hand.open_angle=[-0.4,-0.4]"])
    assert _way(inward, "right") == (-0.4, 0.4)
    narrow = load(None, changes=["hand.q_min=[-0.1,-0.1]", "hand.q_max=[0.15,0.15]"])
    with pytest.raises(CalibrationError, match=r"found 6° between hand\.open_angle"):
        _way(narrow, "left")


ARM: Due = {100: {"command": "arm"}}
GRASP: Due = {**ARM, 150: {"command": "grasp", "force": 8.0}}
FORCES: Due = {
    **GRASP,
    1100: {"command": "grasp", "force": 4.0},
    1700: {"command": "grasp", "force": 10.0},
}


@pytest.mark.parametrize(
    ("profile", "latency", "hand"),
    [
        (None, 0.0, ()),
        (None, 0.06, ("simulation.joint_friction=0.2",)),
        (None, 0.03, ("simulation.modulus_scale=0.7", "simulation.tactile_gain=[0.7,1.4]")),
        pytest.param("velostat", 0.03, (), marks=pytest.mark.extended),
        pytest.param("capacitive", 0.06, (), marks=pytest.mark.extended),
        pytest.param("solid", 0.045, (), marks=pytest.mark.extended),
    ],
)
def test_latency_is_measured_by_a_grip(tmp_path, capsys, profile, latency, hand):
    path = None if profile is None else str(CONFIG / f"{profile}.toml")
    plant = (f"simulation.tactile_delay={latency}", *hand)
    record_hand(tmp_path / "run.mcap", FORCES, 4.4, profile=path, hand=plant)
    assert calibrate("latency", tmp_path) == 0
    told = capsys.readouterr().out
    # Cells with a response time of 60 ms hide part of the latency. For faster cells, the error of
    # the latency is a few ms.
    tolerance = 6e-3 if profile == "velostat" else 3e-3
    assert load(tmp_path / "my.toml").tactile.latency == pytest.approx(latency, abs=tolerance)
    assert float(told.split(" ± ")[1].split(" ms")[0]) < 1e3 * tolerance
    assert "(the daemon used 20 ms)" in told


@pytest.mark.parametrize(
    ("profile", "due", "hand", "why"),
    [
        (None, ARM, (), "d (computed from the joints) changed by 0.0 mm"),
        (None, FORCES, ("simulation.object_angle=0.3",), "neither slides nor tilts"),
        (VELOSTAT, GRASP, (), "found a latency uncertainty of"),
    ],
)
def test_a_grip_that_does_not_show_the_latency_is_refused(
    tmp_path, capsys, profile, due, hand, why
):
    end = 4.4 if due is FORCES else 1.8
    record_hand(tmp_path / "run.mcap", due, end, profile=profile, hand=hand)
    assert calibrate("latency", tmp_path) == 1
    assert why in capsys.readouterr().err
    assert load(tmp_path / "my.toml").tactile.latency == 0.02


@pytest.mark.parametrize("delay", [-0.015, 0.037, 0.25])
def test_a_delay_is_recovered_from_synthetic_data(delay):
    chance = np.random.default_rng(7)
    read = np.arange(0.0, 2.0, 0.01)
    t = np.arange(0.2, 1.9, 0.01) + 0.003

    def closing(at):
        return 2e-3 * (np.tanh((at - 0.5) / 0.04) - 0.7 * np.tanh((at - 1.2) / 0.04))

    d = 1.1 * closing(t - delay) + 5e-3 + chance.normal(0.0, 3e-5, t.size)
    std = np.full(t.size, 3e-5)
    measured = (t, d, std), (read, closing(read) + 0.08), (2e-5, 0.2), 0.02
    if delay > 0.2:
        with pytest.raises(CalibrationError, match="at least 200 ms"):
            fit_latency(*measured)
        return
    found = fit_latency(*measured)
    assert found.delay == pytest.approx(delay, abs=2 * found.std)
    assert found.std < 1.5e-3
    assert found.ramps == 2
    assert found.scale == pytest.approx(1.1, abs=0.02)
    still = np.zeros_like(read)
    with pytest.raises(CalibrationError, match=r"at least 0\.8 mm"):
        fit_latency((t, d, std), (read, still), (2e-5, 0.2), 0.02)
