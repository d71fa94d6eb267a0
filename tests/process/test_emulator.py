"""The stand-in hand: the real process behind its command line, and its parts one by one."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, PacketHandler, PortHandler

from softfinger.daemon.backends import make_sensor
from softfinger.daemon.clock import RealClock
from softfinger.daemon.errors import TactileError
from softfinger.daemon.perception.finger_model import make_estimator
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.emulator import emulator as module
from softfinger.daemon.simulation.emulator.emulator import (
    DEFAULT_BOARD,
    Emulator,
    EmulatorClock,
    EmulatorError,
    with_board,
)
from softfinger.daemon.simulation.emulator.link_folder import LINKS, FolderError, LinkFolder
from softfinger.daemon.tactile.flexitac import FlexiTac
from softfinger.tools.cli import main
from tests.conftest import until

HIL = Path(__file__).parents[2] / "config" / "hil.toml"
READY_WITHIN = 200.0  # s; kernels may have to be compiled

OPERATING_MODE, TORQUE_ENABLE = 11, 64
GOAL_CURRENT, GOAL_POSITION, PRESENT_POSITION = 102, 116, 132


class Process:
    """``softfinger emulate`` with these arguments."""

    def __init__(self, *arguments: str | Path) -> None:
        self.popen = subprocess.Popen(
            [sys.executable, "-m", "softfinger", "emulate", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def ready(self) -> Process:
        """Wait for the first line, which must be ``ready``."""
        assert self.popen.stdout is not None
        found = select.select([self.popen.stdout], [], [], READY_WITHIN)[0]
        line = self.popen.stdout.readline() if found else "nothing"
        if line != "ready\n":
            self.popen.kill()
            raise AssertionError(f"{line!r} instead of ready: {self.popen.communicate()[1]}")
        return self

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str, str]:
        """Send a signal; exit status and what else was printed."""
        self.popen.send_signal(number)
        out, err = self.popen.communicate(timeout=60)
        return self.popen.returncode, out, err

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self.popen.poll() is None:
            self.popen.kill()
        self.popen.communicate()


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a running stand-in hand as it is by default."""
    folder = tmp_path_factory.mktemp("hand")
    with Process("--dir", folder) as process:
        process.ready()
        yield folder
        assert process.end()[:2] == (0, "")  # kernels that were compiled are told beside it


@contextlib.contextmanager
def thread(folder: Path, *faults: str, settings: Settings | None = None) -> Iterator[Emulator]:
    """An emulator in a thread of this process, where a test wants several."""
    made = Emulator(settings or Settings(), folder, faults=faults)
    ready = threading.Event()
    runner = threading.Thread(target=made.run, args=(ready.set,), daemon=True)
    runner.start()
    try:
        assert ready.wait(READY_WITHIN)
        yield made
    finally:
        made.stop()
        runner.join()
        made.close()


class PatientPort(PortHandler):
    """Waits for a reply longer than the SDK's 34 ms, which a busy machine may exceed."""

    patience = 60_000.0  # ms

    def setPacketTimeout(self, _: int) -> None:
        self.setPacketTimeoutMillis(self.patience)


class Servos:
    """The maker's own SDK on the servos' port."""

    def __init__(self, folder: Path, baud: int = 2_000_000) -> None:
        self.port = PatientPort(str(folder / "servos"))
        assert self.port.openPort()
        assert self.port.setBaudRate(baud)
        self.packets = PacketHandler(2.0)

    def ping(self, servo: int) -> int:
        """The model."""
        model, result, _ = self.packets.ping(self.port, servo)
        assert result == COMM_SUCCESS
        return int(model)

    def silent(self, servo: int) -> bool:
        """No reply comes soon."""
        self.port.patience = 100.0
        _, result, _ = self.packets.ping(self.port, servo)
        self.port.patience = PatientPort.patience
        return bool(result == COMM_RX_TIMEOUT)

    def read(self, servo: int, address: int, size: int) -> int:
        read = {
            1: self.packets.read1ByteTxRx,
            2: self.packets.read2ByteTxRx,
            4: self.packets.read4ByteTxRx,
        }[size]
        value, result, error = read(self.port, servo, address)
        assert (result, error) == (COMM_SUCCESS, 0)
        return int(value)

    def write(self, servo: int, address: int, size: int, value: int) -> None:
        write = {
            1: self.packets.write1ByteTxRx,
            2: self.packets.write2ByteTxRx,
            4: self.packets.write4ByteTxRx,
        }[size]
        assert write(self.port, servo, address, value) == (COMM_SUCCESS, 0)

    def close(self) -> None:
        self.port.closePort()


@pytest.fixture
def servos(hand: Path) -> Iterator[Servos]:
    made = Servos(hand)
    yield made
    made.close()


def board(folder: Path, finger: int, timeout: float = 2.0, **changes: object) -> FlexiTac:
    """The daemon's own backend on one of the stand-in hand's boards."""
    tactile = load(HIL, folder).tactile
    tactile = tactile.model_copy(update={"open_timeout": timeout, **changes})
    return FlexiTac(tactile, RealClock(), finger)


def test_default_servos_answer_and_are_limp_in_current_based_position_mode(servos):
    for servo in (1, 2):
        assert servos.ping(servo) == 1020
        assert servos.read(servo, OPERATING_MODE, 1) == 5
        assert servos.read(servo, TORQUE_ENABLE, 1) == 0
        assert servos.read(servo, PRESENT_POSITION, 4) == 2048
    assert servos.silent(3)


def test_links_lead_to_terminals(hand):
    for name in LINKS:
        assert (hand / name).is_symlink()
        assert (hand / name).is_char_device()


@pytest.mark.parametrize("finger", [0, 1])
def test_boards_send_the_default_grid(hand, finger):
    sensor = board(hand, finger)
    sensor.open()
    first = sensor.latest()
    assert first is not None
    until(lambda: sensor.latest().seq >= first.seq + 20)
    last = sensor.latest()
    sensor.close()
    assert last.data.shape == (32, 32)
    # Nothing touches the tips: noise of about 3 counts, cut off below 0.
    assert 0 < last.data.mean() < 3
    counters = sensor.counters()
    assert counters["resyncs"] == counters["skipped_bytes"] == 0


def test_the_physics_stands_behind_servos_and_boards(hand, servos):
    sensors = [board(hand, finger) for finger in (0, 1)]
    for sensor in sensors:
        sensor.open()
    limp = [int(sensor.latest().data.sum()) for sensor in sensors]
    for servo, goal in ((1, 2048 + 400), (2, 2048 - 400)):
        servos.write(servo, TORQUE_ENABLE, 1, 1)
        servos.write(servo, GOAL_CURRENT, 2, 150)  # 0.4 A
        servos.write(servo, GOAL_POSITION, 4, goal)
    until(lambda: all(sensor.latest().data.max() > 40 for sensor in sensors))
    pressed = [int(sensor.latest().data.sum()) for sensor in sensors]
    assert all(after > before + 500 for before, after in zip(limp, pressed, strict=True))
    assert servos.read(1, PRESENT_POSITION, 4) > 2060
    assert servos.read(2, PRESENT_POSITION, 4) < 2036
    for servo in (1, 2):
        servos.write(servo, GOAL_POSITION, 4, 2048)
    until(lambda: all(sensor.latest().data.max() < 30 for sensor in sensors))
    until(lambda: all(abs(servos.read(servo, PRESENT_POSITION, 4) - 2048) < 8 for servo in (1, 2)))
    for servo in (1, 2):
        servos.write(servo, TORQUE_ENABLE, 1, 0)
    for sensor in sensors:
        sensor.close()


def test_clients_may_come_and_go(hand):
    for _ in range(3):
        servos = Servos(hand)
        assert servos.ping(2) == 1020
        servos.close()
        sensor = board(hand, 0)
        sensor.open()
        sensor.close()


def test_a_folder_in_use_is_refused_and_the_first_lives_on(hand, servos):
    with Process("--dir", hand) as second:
        out, err = second.popen.communicate(timeout=READY_WITHIN)
        assert second.popen.returncode == 1
    assert out == ""
    assert "in use by another emulator (process " in err
    assert len(err.splitlines()) == 1
    assert servos.ping(1) == 1020


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(tmp_path, number):
    with Process("--dir", tmp_path / "new", "--config", HIL) as process:
        process.ready()
        assert process.end(number) == (0, "", "")
    assert list((tmp_path / "new").iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_it_cleanly_while_it_starts(tmp_path, number):
    with Process("--dir", tmp_path / "new", "--config", HIL) as process:
        # The folder is taken as the first thing, long before anything answers.
        until((tmp_path / "new" / ".emulator.lock").exists)
        assert process.end(number) == (0, "", "")
    assert list((tmp_path / "new").iterdir()) == []


def test_links_of_a_killed_emulator_are_replaced_and_an_interruption_is_survived(tmp_path):
    options = ("--model", "XL330-M288", "--ids", "7,3")
    with Process("--dir", tmp_path, *options) as process:
        process.ready()
        process.popen.kill()
        process.popen.wait()
    assert all((tmp_path / name).is_symlink() for name in LINKS)
    with Process("--dir", tmp_path, *options) as process:
        process.ready()
        servos = Servos(tmp_path)
        assert (servos.ping(7), servos.ping(3)) == (1200, 1200)
        assert servos.silent(1)
        process.popen.send_signal(signal.SIGSTOP)
        assert servos.silent(7)
        process.popen.send_signal(signal.SIGCONT)
        assert servos.ping(7) == 1200  # the answer to the one or to the other
        servos.close()
        process.end()


def test_paced_servos_wait_for_the_latency_timer_and_are_deaf_at_another_rate(tmp_path):
    with Process("--dir", tmp_path, "--baud", "1000000", "--latency", "8") as process:
        process.ready()
        servos = Servos(tmp_path, 1_000_000)
        assert servos.ping(1) == 1020
        start = time.monotonic()
        for _ in range(5):
            assert servos.ping(1) == 1020
        # Each reply waits for the adapter's latency timer, and so for the one after it.
        assert time.monotonic() - start > 4 * 0.008
        servos.close()
        for baud in (2_000_000, 57_600):
            servos = Servos(tmp_path, baud)
            assert servos.silent(1)
            servos.close()
        process.end()


def test_something_else_in_a_links_place_is_left_alone(tmp_path):
    (tmp_path / "servos").write_text("mine")
    with pytest.raises(EmulatorError, match="servos: is in the way"):
        Emulator(Settings(), tmp_path)
    assert (tmp_path / "servos").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["servos"]


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FolderError, match="can't be used as --dir"):
        LinkFolder(tmp_path / "file" / "hand")


def test_links_that_lead_elsewhere_by_now_are_left_alone(tmp_path):
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
        (["--fault", "silent=9"], 1, "no servo has that ID"),
        (["--fault", "lose=2"], 1, "a probability lies in 0 … 1"),
        (["--model", "AX-12"], 2, "XM430-W350"),
        (["--baud", "1234"], 1, "baud"),
    ],
)
def test_what_cannot_be_emulated_is_told_in_one_line(tmp_path, capsys, options, status, told):
    assert main(["emulate", "--dir", str(tmp_path), *options]) == status
    err = capsys.readouterr().err
    assert told in err
    assert len(err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ids", ["1", "1,253", "1,x", "1,2,3"])
def test_wrong_ids_are_told(tmp_path, capsys, ids):
    with pytest.raises(SystemExit) as end:
        main(["emulate", "--dir", str(tmp_path), "--ids", ids])
    assert end.value.code == 2
    assert "expected two IDs of 0 to 252" in capsys.readouterr().err


def test_wrong_settings_are_told(tmp_path, capsys):
    (tmp_path / "wrong.toml").write_text("tactile.rows = 3")
    assert main(["emulate", "--dir", str(tmp_path), "--config", str(tmp_path / "wrong.toml")]) == 2
    assert "tactile.rows" in capsys.readouterr().err


def test_the_default_board_is_the_one_of_the_hil_profile(tmp_path):
    hil = load(HIL, tmp_path)
    assert with_board(hil) is hil
    default = with_board(Settings()).tactile
    for key in ("rows", "cols", "pitch", "pascal_per_count", "rate", "baud", "backend"):
        assert getattr(default, key) == getattr(hil.tactile, key), key
        if key in DEFAULT_BOARD:
            assert DEFAULT_BOARD[key] == getattr(default, key)
    assert hil.simulation == Settings().simulation


def test_a_scene_has_only_the_ports_it_needs(tmp_path):
    (tmp_path / "one.toml").write_text(
        'scene.fingers = ["right"]\nservos.backend = "none"\n[tactile]\nrows = 16\ncols = 8\n'
        'backend = "flexitac"\n'
    )
    settings = load(tmp_path / "one.toml", tmp_path)
    with thread(tmp_path / "hand", settings=settings):
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
    with thread(tmp_path / "hand", settings=settings):
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


def test_board_faults_reach_the_daemons_backend(tmp_path):
    with thread(tmp_path, "left:wrong-size", "right:torn=0.5"):
        with pytest.raises(TactileError, match=r"256 cells.*1024"):
            board(tmp_path, 0).open()
        sensor = board(tmp_path, 1)
        sensor.open()
        until(lambda: sensor.counters()["resyncs"] >= 3)
        assert sensor.latest().data.mean() < 10
        sensor.close()


def test_silent_frozen_and_noisy_boards(tmp_path):
    with thread(tmp_path, "left:frozen", "right:noisy=0.3"):
        left, right = board(tmp_path, 0), board(tmp_path, 1)
        right.open()
        left.open()
        kept = left.latest().data
        seq = left.latest().seq
        until(lambda: left.latest().seq > seq + 10)
        assert np.array_equal(left.latest().data, kept)
        until(lambda: right.counters()["resyncs"] > 0)
        left.close()
        right.close()
        assert tell(tmp_path, "right:silent") == 0
        # What it had sent before may still be read.
        until(lambda: "no byte came" in why_not_open(board(tmp_path, 1, timeout=0.1)))


def why_not_open(sensor: FlexiTac) -> str:
    try:
        sensor.open()
    except TactileError as error:
        return str(error)
    sensor.close()
    return ""


def test_servo_faults_reach_the_sdk(tmp_path):
    with thread(tmp_path, "silent=2"):
        servos = Servos(tmp_path)
        assert servos.ping(1) == 1020
        assert servos.silent(2)
        servos.close()
    with thread(tmp_path, "unplug"):
        until(lambda: not (tmp_path / "servos").exists())
        assert tell(tmp_path, "plug") == 0
        until((tmp_path / "servos").exists)
        servos = Servos(tmp_path)
        assert servos.ping(1) == 1020
        servos.close()


def test_time_leaves_interruptions_out(monkeypatch):
    now = 100.0
    monkeypatch.setattr(module.time, "monotonic", lambda: now)
    clock = EmulatorClock()
    assert clock.now() == 0.0
    now += 0.01
    assert clock.now() == pytest.approx(0.01)
    now += 60.0
    assert clock.now() == pytest.approx(0.06)
    now += 0.01
    assert clock.now() == pytest.approx(0.07)


def test_a_board_that_nobody_reads_disturbs_nothing(tmp_path):
    with thread(tmp_path) as made:
        boards = list(made._boards.values())
        until(lambda: all(board.dropped > 20 for board in boards))
        servos = Servos(tmp_path)
        assert servos.ping(1) == 1020
        servos.close()
        sensor = board(tmp_path, 0)
        sensor.open()
        assert sensor.counters()["skipped_bytes"] < 2 * 1026
        sensor.close()
    assert not os.path.lexists(tmp_path / "servos")


# The control socket.


def test_faults_while_it_runs(tmp_path, capsys):
    with thread(tmp_path):
        servos = Servos(tmp_path)
        assert tell(tmp_path, "silent=1 drop=1") == 0
        assert servos.silent(1)
        assert servos.silent(2)
        assert tell(tmp_path, "well") == 0
        assert servos.silent(1)
        assert servos.ping(2) == 1020
        assert tell(tmp_path, "answer=1") == 0
        assert servos.ping(1) == 1020
        assert tell(tmp_path, "unplug plug@0.05") == 0
        servos.close()
        until((tmp_path / "servos").exists)
        again = Servos(tmp_path)
        assert again.ping(1) == 1020
        again.close()
        assert capsys.readouterr().err == ""
        # One word that makes no sense, and none of them counts.
        assert tell(tmp_path, "silent=2 sillent=2") == 1
        assert "'sillent=2'" in capsys.readouterr().err
        assert Servos(tmp_path).ping(2) == 1020


def test_boards_go_and_come_back(tmp_path):
    with thread(tmp_path):
        left = board(tmp_path, 0)
        left.open()
        right = board(tmp_path, 1)
        right.open()
        assert tell(tmp_path, "left:unplug right:frozen") == 0
        until(lambda: not left.latest().valid)
        assert "gone" in left.error
        left.close()
        assert not (tmp_path / "tactile-left").exists()
        until(lambda: no_change(right))
        assert tell(tmp_path, "left:plug right:well") == 0
        until((tmp_path / "tactile-left").exists)
        left.open()
        until(lambda: not no_change(right))
        left.close()
        right.close()


def no_change(sensor: FlexiTac) -> bool:
    """Whether three frames that follow each other are the same, which noise rules out."""
    frames = [sensor.latest()]
    while len(frames) < 3:
        until(lambda: sensor.latest() is not frames[-1])
        frames.append(sensor.latest())
    return all(np.array_equal(frames[0].data, frame.data) for frame in frames)


def test_nobody_to_tell(tmp_path, capsys):
    assert tell(tmp_path, "unplug") == 1
    assert "no emulator answers here" in capsys.readouterr().err
    assert tell(tmp_path / "nowhere", "unplug") == 1


def test_the_control_socket_survives_rude_clients_and_is_taken_away(tmp_path, monkeypatch):
    folder = tmp_path / ("long" * 30)  # past what a socket's own path may have
    folder.mkdir()
    with thread(folder):
        place = folder / "control"
        assert place.is_socket()
        monkeypatch.chdir(folder)
        rude = [socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(12)]
        for each in rude:
            each.connect("control")
        rude[-1].send(b"\xff\xfe\x00")
        assert rude[-1].recv(999).startswith(b"error: ")
        assert tell(folder, "drop=0") == 0
        for each in rude:
            each.close()
        assert tell(folder, "x" * 4000) == 1
    assert not place.exists()


def test_something_else_in_the_control_sockets_place_is_left_alone(tmp_path):
    (tmp_path / "control").write_text("mine")
    with pytest.raises(EmulatorError, match="in the way"):
        Emulator(Settings(), tmp_path)
    assert (tmp_path / "control").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["control"]


def tell(folder: Path, words: str) -> int:
    return main(["emulate", "--dir", str(folder), "--send", words])


def test_factory_new_servos(tmp_path):
    with Process("--dir", tmp_path, "--factory", "--model", "XL330-M288").ready() as process:
        servos = Servos(tmp_path)
        assert servos.read(1, OPERATING_MODE, 1) == 3
        assert servos.read(2, 9, 1) == 250
        servos.close()
        assert process.end() == (0, "", "")


def test_an_adapters_latency_timer_has_its_range(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["emulate", "--dir", str(tmp_path), "--latency", "-1"])
    assert "expected 0 to 255 ms" in capsys.readouterr().err


def test_an_object_that_slipped_away_is_put_back(tmp_path: Path) -> None:
    with thread(tmp_path) as made:
        made.hand.object_pose[:] = 0.07, 0.02, 1.2
        assert made.request("place report").startswith("{")
        until(lambda: np.allclose(made.hand.object_pose, (0.0, 0.08, 0.0), atol=1e-3))
