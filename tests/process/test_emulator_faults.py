"""An emulated hand's boards, scenes and faults, and the control socket that sets them."""

import socket
from pathlib import Path

import numpy as np
import pytest

from softfinger.daemon.clock import RealClock
from softfinger.daemon.perception.finger_model import make_estimator
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.load import load
from softfinger.daemon.simulation.emulator.folder import LINKS
from softfinger.daemon.tactile.base import make_sensor
from tests.conftest import until
from tests.harness.emulated import SdkServos, board, emulated, send


def test_a_scene_has_only_the_ports_it_needs(tmp_path):
    (tmp_path / "one.toml").write_text(
        'scene.fingers = ["right"]\nservos.backend = "none"\n[tactile]\nrows = 16\ncols = 8\n'
        'backend = "flexitac"\n'
    )
    settings = load(tmp_path / "one.toml", tmp_path)
    with emulated(tmp_path / "hand", settings=settings):
        names = {path.name for path in (tmp_path / "hand").iterdir()}
        assert names & set(LINKS) == {"tactile-right"}
        sensor = board(tmp_path / "hand", 1, rows=16, cols=8)
        sensor.open()
        sensor.close()


@pytest.mark.parametrize(("backend", "full"), [("glove", 1023), ("cobs", 65535)])
def test_each_serial_framing_is_spoken(tmp_path, backend, full):
    # Without servos the object is pressed on the tips to and fro.
    (tmp_path / "one.toml").write_text(
        f"""scene.fingers = ["left"]
servos.backend = "none"
[tactile]
backend = "{backend}"
port = ["{{dir}}/tactile-left", ""]
rows = 32
cols = 32
pitch = 0.0018125
pascal_per_count = 200.0
full_count = {full}
"""
    )
    settings = load(tmp_path / "one.toml", tmp_path / "hand")
    with emulated(tmp_path / "hand", settings=settings):
        sensor = make_sensor(settings, RealClock(), None, 0)
        sensor.open()
        frames = [sensor.latest().data]
        until(lambda: (frames.append(sensor.latest().data), frames[-1].max() > 200)[1])
        estimator = make_estimator(settings, make_material(settings.material))
        estimate = estimator.update(frames[-1], 200.0)
        assert estimate.valid
        assert estimate.contact
        assert 3e-4 < estimate.d < 8e-3
        assert abs(estimate.tilt_x) < 0.05
        assert sensor.counters()["resyncs"] <= 1  # the first packet may be half a one
        sensor.close()


def test_faults_while_it_runs(tmp_path, capsys):
    log: list[str] = []
    with emulated(tmp_path, "silent=2", tell=log.append):
        servos = SdkServos(tmp_path)
        assert servos.ping(1) == 1020
        assert servos.silent(2)
        assert send(tmp_path, "answer=2 silent=1 drop=1") == 0
        assert log[-2:] == ["fault: servos: silent=1", "fault: servos: drop=1"]
        assert servos.silent(1)
        assert servos.silent(2)
        assert send(tmp_path, "well") == 0
        assert servos.silent(1)
        assert servos.ping(2) == 1020
        assert send(tmp_path, "answer=1") == 0
        assert servos.ping(1) == 1020
        assert send(tmp_path, "unplug plug@0.05") == 0
        servos.close()
        until((tmp_path / "servos").exists)
        again = SdkServos(tmp_path)
        assert again.ping(1) == 1020
        again.close()
        assert capsys.readouterr().err == ""
        # One word that makes no sense, and none of them counts.
        assert send(tmp_path, "silent=2 sillent=2") == 1
        assert "'sillent=2'" in capsys.readouterr().err
        assert SdkServos(tmp_path).ping(2) == 1020


def test_nobody_to_tell(tmp_path, capsys):
    assert send(tmp_path, "unplug") == 1
    assert "no emulator answers here" in capsys.readouterr().err
    assert send(tmp_path / "nowhere", "unplug") == 1


def test_the_control_socket_survives_rude_clients_and_is_taken_away(tmp_path, monkeypatch):
    folder = tmp_path / ("long" * 30)  # past what a socket's own path may have
    folder.mkdir()
    with emulated(folder):
        place = folder / "control"
        assert place.is_socket()
        monkeypatch.chdir(folder)
        rude = [socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(12)]
        for each in rude:
            each.connect("control")
        rude[-1].send(b"\xff\xfe\x00")
        assert rude[-1].recv(999).startswith(b"error: ")
        assert send(folder, "drop=0") == 0
        for each in rude:
            each.close()
        assert send(folder, "x" * 4000) == 1
    assert not place.exists()


def test_measurements_are_wrong_and_the_hand_is_not(tmp_path):
    log: list[str] = []
    faults = "right:drift=0.2@0.5..1", "left:current=3@0.5"
    with emulated(tmp_path, *faults, tell=log.append) as made:
        until(lambda: board_mean(tmp_path, 1) > 48)  # of 255
        assert board_mean(tmp_path, 0) < 10
        left, right = made.hand.measurement_faults
        assert (left("current", 9.0), right("current", 9.0)) == (3.0, 1.0)
        assert send(tmp_path, "right:well left:gain=0@0.1..0.2") == 0
        until(lambda: board_mean(tmp_path, 1) < 10)
        until(lambda: log[-2:] == ["fault: right: well", "fault: left: gain=0 within 0.1 s"])
        until(lambda: left("gain", made.clock.now()) == 0.0)
        assert left("current", 9.0) == 3.0
        assert send(tmp_path, "well") == 0
        assert (left("gain", 9.0), left("current", 9.0)) == (1.0, 1.0)


def board_mean(folder: Path, finger: int) -> float:
    """Mean count of a board's newest frame."""
    sensor = board(folder, finger)
    sensor.open()
    frame = sensor.latest()
    sensor.close()
    return float(frame.data.mean())


def test_an_object_is_put_back_and_moved_by_a_load(tmp_path):
    with emulated(tmp_path) as made:
        made.hand.object_pose[:] = 0.07, 0.02, 1.2  # it slipped away
        assert made.request("place report").startswith("{")
        until(lambda: np.allclose(made.hand.object_pose, (0.0, 0.08, 0.0), atol=1e-3))
        made.request("push=5")
        until(lambda: made.hand.object_pose[1] > 0.082)  # off along its faces, away from the palm
        assert made.report(made.clock.now())["force"] == [0.0, 0.0]
        made.request("place twist=0.02")
        until(lambda: made.hand.object_pose[2] > 0.05)
