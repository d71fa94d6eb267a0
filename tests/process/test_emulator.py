"""Test the process, ports, boards, scenes and faults of `softfinger emulate`."""

import errno
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from softfinger.daemon.clock import Deadline, HandClock, RealClock
from softfinger.daemon.errors import Refused
from softfinger.daemon.perception.finger_model import make_estimator
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.emulator import emulator as module
from softfinger.daemon.simulation.emulator.emulator import (
    DEFAULT_BOARD,
    Emulator,
    EmulatorClock,
    with_board,
)
from softfinger.daemon.simulation.emulator.folder import LINKS, FolderError, LinkFolder, carry_out
from softfinger.daemon.tactile.base import make_sensor
from tests.conftest import until
from tests.harness.emulated import HIL, EmulatorProcess, SdkServos, board, emulated, send
from tests.harness.loop import LateMachine

RETURN_DELAY, OPERATING_MODE, TORQUE_ENABLE, PRESENT_POSITION = 9, 11, 64, 132


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield the folder of a running emulated hand with default settings."""
    folder = tmp_path_factory.mktemp("hand")
    with EmulatorProcess("--dir", folder) as process:
        process.ready()
        yield folder
        assert process.end() == (0, "", "")


@pytest.fixture
def servos(hand: Path) -> Iterator[SdkServos]:
    made = SdkServos(hand)
    yield made
    made.close()


def test_default_servos_reply_with_torque_off_in_current_based_position_mode(servos):
    for servo in (1, 2):
        assert servos.ping(servo) == 1020
        assert servos.read(servo, OPERATING_MODE, 1) == 5
        assert servos.read(servo, TORQUE_ENABLE, 1) == 0
        assert servos.read(servo, PRESENT_POSITION, 4) == 2048
    assert servos.silent(3)


@pytest.mark.parametrize("finger", [0, 1])
def test_boards_send_the_default_grid(hand, finger):
    sensor = board(hand, finger)
    sensor.open()
    first = sensor.latest()
    until(lambda: sensor.latest().seq >= first.seq + 20)
    last = sensor.latest()
    sensor.close()
    assert last.data.shape == (32, 32)
    # Without contact, only a noise of about 3 counts remains, clipped at 0.
    assert 0 < last.data.mean() < 3
    counters = sensor.counters()
    assert counters["resyncs"] == counters["skipped_bytes"] == 0


def test_a_folder_in_use_is_refused_and_the_first_emulator_continues(hand, servos, inline):
    status, out, err = inline("emulate", "--dir", hand)
    assert (status, out) == (1, "")
    assert "in use by another emulator (process " in err
    assert len(err.splitlines()) == 1
    assert servos.ping(1) == 1020


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, marks=pytest.mark.extended), signal.SIGTERM]
)
def test_a_signal_during_start_up_ends_the_emulator_cleanly(tmp_path, number):
    with EmulatorProcess("--dir", tmp_path / "new", "--config", HIL) as process:
        # The emulator locks the folder long before its servos respond.
        until((tmp_path / "new" / ".emulator.lock").exists)
        assert process.end(number) == (0, "", "")
    assert list((tmp_path / "new").iterdir()) == []


def test_links_of_a_killed_emulator_are_replaced_and_a_paused_emulator_continues(tmp_path):
    with EmulatorProcess("--dir", tmp_path, "--model", "XL330-M288", "--factory") as process:
        process.ready()
        told = [process.popen.stdout.readline() for _ in LINKS]
        assert told == [f"{name}: {tmp_path / name}\n" for name in LINKS]
        servos = SdkServos(tmp_path)
        assert servos.read(1, OPERATING_MODE, 1) == 3
        assert servos.read(2, RETURN_DELAY, 1) == 250
        servos.close()
        process.popen.kill()
        process.popen.wait()
    assert all((tmp_path / name).is_symlink() for name in LINKS)
    with EmulatorProcess("--dir", tmp_path, "--model", "XL330-M288", "--ids", "7,3") as process:
        process.ready()
        servos = SdkServos(tmp_path)
        assert (servos.ping(7), servos.ping(3)) == (1200, 1200)
        assert servos.silent(1)
        process.popen.send_signal(signal.SIGSTOP)
        assert servos.silent(7)
        process.popen.send_signal(signal.SIGCONT)
        assert servos.ping(7) == 1200  # The emulator has answered an earlier ping.
        servos.close()
        assert process.end(signal.SIGHUP) == (0, "", "")
    assert not any(path.is_symlink() for path in tmp_path.iterdir())


@pytest.mark.parametrize("name", ["servos", "control"])
def test_other_files_in_place_of_links_or_the_control_socket_are_not_replaced(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(FolderError, match=f"{name}: .*exists"):
        Emulator(Settings(), tmp_path)
    assert (tmp_path / name).read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_folder_that_cannot_be_created_is_reported(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FolderError, match="can't be used as --dir"):
        LinkFolder(tmp_path / "file" / "hand")


def test_links_that_were_redirected_are_not_removed(tmp_path):
    folder = LinkFolder(tmp_path)
    folder.link("servos", "/dev/ours")
    folder.link("tactile-left", "/dev/ours-too")
    (tmp_path / "servos").unlink()
    (tmp_path / "servos").symlink_to("/dev/theirs")
    folder.close()
    assert [path.name for path in tmp_path.iterdir()] == ["servos"]
    assert str((tmp_path / "servos").readlink()) == "/dev/theirs"


@pytest.mark.parametrize(
    ("options", "status", "told"),
    [
        (["--fault", "melted"], 1, "wrong-size"),
        (["--fault", "silent=9"], 1, "no servo has this ID"),
        (["--fault", "lose=2"], 1, "found 2, expected 0 to 1 (probability)"),
        (["--fault", "delay=2"], 1, "found 2, expected 0 to 1 (seconds)"),
        (["--model", "AX-12"], 2, "XM430-W350"),
        (["--baud", "1234"], 2, "baud"),
        (["--ids", "1"], 2, "expected two IDs between 0 and 252"),
        (["--ids", "1,253"], 2, "expected two IDs between 0 and 252"),
        (["--ids", "1,x"], 2, "expected two IDs between 0 and 252"),
    ],
)
def test_an_invalid_hand_is_reported_in_one_line(tmp_path, inline, options, status, told):
    done = inline("emulate", "--dir", tmp_path, *options)
    assert (done.returncode, done.stdout) == (status, "")
    assert told in done.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


def test_the_default_board_is_that_of_the_hil_profile(tmp_path):
    hil = load(HIL, tmp_path)
    assert with_board(hil) is hil
    default = with_board(Settings()).tactile
    for key in ("rows", "cols", "pitch", "pascal_per_count", "rate", "baud", "backend"):
        assert getattr(default, key) == getattr(hil.tactile, key), key
        if key in DEFAULT_BOARD:
            assert DEFAULT_BOARD[key] == getattr(default, key)
    assert hil.simulation == Settings().simulation


def test_emulated_time_excludes_interruptions(monkeypatch, tmp_path):
    now = 100.0
    monkeypatch.setattr(module.time, "monotonic", lambda: now)
    clock = EmulatorClock(Deadline(tmp_path / Deadline.NAME, os.O_CREAT))
    assert clock.now() == 0.0
    now += 0.01
    assert clock.now() == pytest.approx(0.01)
    now += 60.0
    assert clock.now() == pytest.approx(0.06)
    now += 0.01
    assert clock.now() == pytest.approx(0.07)


def test_a_full_disk_is_an_error_of_the_deadline_instead_of_a_crash(monkeypatch, tmp_path):
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    # A write to a mapped hole would end the process with SIGBUS, so the space is reserved.
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left"):
        Deadline(tmp_path / Deadline.NAME, os.O_CREAT)
    assert Deadline.of(str(tmp_path / "servos")) is None


@pytest.mark.parametrize("restarts", [False, True])
@pytest.mark.parametrize("late", [0.0005, 0.004, 0.03, 5.0])
def test_emulated_time_is_synchronised_with_a_late_daemon(monkeypatch, tmp_path, late, restarts):
    machine = LateMachine(100.0)
    monkeypatch.setattr(module.time, "monotonic", machine.now)
    clock = EmulatorClock(Deadline(tmp_path / Deadline.NAME, os.O_CREAT))
    servos = Mock(driven=lambda: driven, answering_until=0.0)
    clock.servos, driven = servos, True
    daemon = HandClock(machine, Deadline.of(str(tmp_path / "servos")))
    if restarts:  # An emulator that exits removes the file, and its successor creates a new file.
        (tmp_path / Deadline.NAME).unlink()
        daemon.sleep_until(100.0)
        clock = EmulatorClock(Deadline(tmp_path / Deadline.NAME, os.O_CREAT))
        clock.servos = servos
    apart = []
    for k in range(200):
        daemon.sleep_until(100.0 + 0.002 * k)
        for _ in range(10):  # Let the emulator read its clock while the daemon is late.
            machine.work(0.1 * late * (k % 3))
            apart.append(clock.now() - daemon.now())
    assert max(apart[20:]) - min(apart[20:]) <= 0.0045
    assert daemon.behind > 100 * late or late < 0.002
    # The hand's clock still advances while a reply is being sent, and after the daemon exits.
    machine.work(0.01)
    stands = clock.now()
    machine.work(0.01)
    assert clock.now() == stands
    assert clock.held
    servos.answering_until = clock.now() + 0.016
    machine.work(0.03)
    assert clock.now() == servos.answering_until
    driven = False
    machine.work(0.02)
    assert clock.now() == pytest.approx(servos.answering_until + 0.02)
    assert not clock.held


# --- faults ---------------------------------------------------------------------------------------


def test_a_scene_creates_only_the_ports_it_needs(tmp_path):
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
def test_each_serial_framing_is_supported(tmp_path, backend, full):
    # Without servos, the emulator periodically presses the object against the tips.
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
        assert sensor.counters()["resyncs"] <= 1  # The first packet may be incomplete.
        sensor.close()


def test_faults_are_injected_at_run_time(tmp_path, capsys):
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
        assert log[-1] == "all faults have ended"
        assert servos.ping(1) == servos.ping(2) == 1020
        for ended in ("plug left:plug@0.05", "well@0.05"):
            assert send(tmp_path, "unplug left:unplug") == 0
            servos.close()
            assert [name for name in LINKS if (tmp_path / name).exists()] == ["tactile-right"]
            assert send(tmp_path, ended) == 0
            until(lambda: all((tmp_path / name).exists() for name in LINKS))
            servos = SdkServos(tmp_path)
            assert servos.ping(1) == 1020
        servos.close()
        assert capsys.readouterr().err == ""
        # If one fault name is invalid, the emulator ignores the whole message.
        assert send(tmp_path, "silent=2 sillent=2") == 1
        assert "'sillent=2'" in capsys.readouterr().err
        assert send(tmp_path, "\udcff") == 1  # bytes that are not UTF-8
        assert "fault '?'" in capsys.readouterr().err
        assert SdkServos(tmp_path).ping(2) == 1020


def test_sending_without_an_emulator_fails(tmp_path, capsys):
    assert send(tmp_path, "unplug") == 1
    assert "no emulator is running here" in capsys.readouterr().err
    assert send(tmp_path / "nowhere", "unplug") == 1


def test_the_control_socket_survives_misbehaving_clients_and_is_removed_at_the_end(
    tmp_path, monkeypatch
):
    folder = tmp_path / ("long" * 30)  # The path is longer than the limit for a socket path.
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


def test_injected_faults_change_measurements_but_not_the_hand(tmp_path):
    log: list[str] = []
    faults = "right:drift=0.2@0.5..1", "left:current=3@0.5"
    with emulated(tmp_path, *faults, tell=log.append) as made:
        until(lambda: board_mean(tmp_path, 1) > 48)  # The full count is 255.
        assert board_mean(tmp_path, 0) < 10
        left, right = made.hand.measurement_faults
        assert (left("current", 9.0), right("current", 9.0)) == (3.0, 1.0)
        assert send(tmp_path, "right:well left:gain=0@0.1..0.2") == 0
        until(lambda: board_mean(tmp_path, 1) < 10)
        until(
            lambda: log[-2:] == ["right: all faults have ended", "fault: left: gain=0 within 0.1 s"]
        )
        until(lambda: left("gain", made.clock.now()) == 0.0)
        assert left("current", 9.0) == 3.0
        assert send(tmp_path, "well") == 0
        assert (left("gain", 9.0), left("current", 9.0)) == (1.0, 1.0)


def board_mean(folder: Path, finger: int) -> float:
    """Return the mean count over all cells of a board's newest frame."""
    sensor = board(folder, finger)
    sensor.open()
    frame = sensor.latest()
    sensor.close()
    return float(frame.data.mean())


def test_an_object_is_put_back_and_moved_by_a_load(tmp_path):
    with emulated(tmp_path) as made:
        made.hand.object_pose[:] = 0.07, 0.02, 1.2  # Place the object outside the grip.
        assert made.request("place report").startswith("{")
        until(lambda: np.allclose(made.hand.object_pose, (0.0, 0.08, 0.0), atol=1e-3))
        made.request("push=5")
        # The object has moved along its faces, away from the palm.
        until(lambda: made.hand.object_pose[1] > 0.082)
        assert made.report(made.clock.now())["force"] == [0.0, 0.0]
        made.request("place twist=0.02")
        until(lambda: made.hand.object_pose[2] > 0.05)


def test_a_message_that_the_emulator_would_cut_off_is_refused(tmp_path):
    presses = "press " + ",".join(300 * ["depth=1mm tip=left"])
    with pytest.raises(Refused, match="found 5705 bytes, expected at most 4096"):
        carry_out(tmp_path, presses)
