"""Test `softfinger calibrate joints` on an emulated hand whose joints are moved manually."""

import shlex
import sys

import pytest

from softfinger.daemon.profile.load import load
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.simulation.emulator.folder import carry_out
from softfinger.tools.calibration import joints
from softfinger.tools.calibration.joints import put
from softfinger.tools.cli import main
from tests.harness.emulated import HIL, SdkServos, emulated

# Actual settings of the emulated hand, which differ from the profile. The object is out of reach.
TRUTH = [
    "servos.ids=[2,1]",
    "servos.direction=[-1,1]",
    "servos.zero=[1500,2300]",
    "hand.q_min=[-0.4,-0.3]",
    "hand.q_max=[0.9,0.8]",
    "simulation.object_position=[0.0,0.3]",
]


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hand")
    with emulated(folder, settings=load(HIL, folder, TRUTH)) as emulator:
        yield folder, emulator


def calibrate(folder, file, *words):
    return main(["calibrate", "joints", str(file), "--dir", str(folder), *words])


def by_hand(folder, turn="{finger}={pose}"):
    program = f"{shlex.quote(sys.executable)} -m softfinger emulate --dir {folder}"
    return ["--move", f"{program} --send 'turn {turn}'"]


def test_a_wrong_profile_is_corrected(hand, tmp_path, capsys):
    folder, _ = hand
    file = tmp_path / "my.toml"
    servos = SdkServos(folder)
    servos.write(1, reg.HOMING_OFFSET, 4, 3000)
    servos.close()
    assert calibrate(folder, file, "--config", "hil", *by_hand(folder)) == 0
    told = capsys.readouterr()
    assert "left finger: close the finger fully\n" in told.err
    assert "left: servo 2 (servos.ids has 1: the IDs are swapped), direction -1, zero 1" in told.out
    assert "servos.direction = [-1, 1]" in told.out
    found = load(file, folder)
    assert (found.servos.ids, found.servos.direction) == ((2, 1), (-1, 1))
    assert found.servos.zero == pytest.approx((1500, 5300), abs=5)
    # The joints stop 0.05 rad outside the limits. The calibration sets each limit 0.03 rad inside a
    # stop, so the limits move outwards by 0.02 rad.
    assert found.hand.q_min == pytest.approx((-0.42, -0.32), abs=0.01)
    assert found.hand.q_max == pytest.approx((0.92, 0.82), abs=0.01)
    assert "ids = [2, 1] # left, right" in file.read_text()
    assert found.tactile == load(HIL, folder).tactile


@pytest.mark.parametrize(
    ("turn", "told"),
    [
        ("left={pose} right={pose}", "servos 2 and 1 rotated, expected one servo: move only one"),
        ("left={pose}", "servo 2 rotated when either finger was moved"),
        ("left=ajar", "exited with status 1"),
    ],
)
def test_moving_the_wrong_finger_is_refused(hand, tmp_path, capsys, turn, told):
    folder, _ = hand
    assert calibrate(folder, tmp_path / "a.toml", "--config", "hil", *by_hand(folder, turn)) == 1
    assert told in capsys.readouterr().err
    assert not (tmp_path / "a.toml").exists()


def test_moving_the_other_finger_in_the_last_pose_is_refused(hand, tmp_path, capsys, monkeypatch):
    folder, _ = hand

    def bring(_arguments, _told, finger, pose):
        carry_out(folder, f"turn {finger}={pose}" + " right=open" * (pose == "zero"))

    carry_out(folder, "turn right=closed")
    monkeypatch.setattr(joints, "bring", bring)
    assert calibrate(folder, tmp_path / "a.toml", "--config", "hil") == 1
    assert "left finger: servos 2 and 1 rotated" in capsys.readouterr().err
    assert not (tmp_path / "a.toml").exists()


def test_enabled_torque_a_stationary_finger_and_encoder_wrap_are_refused(
    hand, tmp_path, capsys, monkeypatch
):
    folder, emulator = hand
    words = [tmp_path / "my.toml", "--config", "hil", "--move", "true"]
    servos = SdkServos(folder)
    servos.write(2, reg.TORQUE_ENABLE, 1, 1)
    try:
        assert calibrate(folder, *words) == 1
        assert "servo 2: torque is on" in capsys.readouterr().err
        assert "torque of the left servo is on" in emulator.request("turn left=open")
    finally:
        servos.write(2, reg.TORQUE_ENABLE, 1, 0)
        servos.close()
    assert calibrate(folder, *words) == 1
    assert "left finger: found a range of 0.0° between closed and open" in capsys.readouterr().err
    monkeypatch.setattr(emulator._servos.bus.servos[0]._joint, "shift", 4000)
    assert calibrate(folder, *words) == 1
    assert "(one turn): switch the supply off and on again" in capsys.readouterr().err


def test_only_calibrated_values_change_in_a_profile():
    text = '# mine\n[hand]\nq_min = [0, 0] # stop\n[servos] # a\nport = "x"\n[tactile]\nrows = 8\n'
    text = put(put(text, "hand", {"q_min": [-0.5, 0.1]}), "servos", {"zero": [1, 2]})
    assert text == (
        '# mine\n[hand]\nq_min = [-0.5, 0.1] # stop\n[servos] # a\nzero = [1, 2]\nport = "x"\n'
        "[tactile]\nrows = 8\n"
    )
    assert put("servos.ids = [1, 2] # a\n[hand]\n", "servos", {"zero": [1], "ids": [2, 1]}) == (
        "servos.zero = [1]\nservos.ids = [2, 1] # a\n[hand]\n"
    )
    assert put("", "servos", {"zero": [1, 2]}).strip() == "[servos]\nzero = [1, 2]"
