"""`softfinger emulate`: its process, its ports, and what it refuses."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest

from softfinger.daemon.clock import Deadline, HandClock
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.emulator import emulator as module
from softfinger.daemon.simulation.emulator.emulator import (
    DEFAULT_BOARD,
    EmulatedServos,
    Emulator,
    EmulatorClock,
    EmulatorError,
    with_board,
)
from softfinger.daemon.simulation.emulator.folder import LINKS, FolderError, LinkFolder
from softfinger.tools.cli import main
from tests.conftest import until
from tests.harness.emulated import HIL, READY_WITHIN, SdkServos, board, emulated
from tests.harness.late_machine import LateMachine

RETURN_DELAY, OPERATING_MODE, TORQUE_ENABLE = 9, 11, 64
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
        out, err = self.popen.communicate(timeout=300)
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


@pytest.fixture
def servos(hand: Path) -> Iterator[SdkServos]:
    made = SdkServos(hand)
    yield made
    made.close()


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


@pytest.fixture
def boards(hand):
    """Both tips' boards, which are closed with the test."""
    sensors = [board(hand, finger) for finger in (0, 1)]
    try:
        for sensor in sensors:
            sensor.open()
        yield sensors
    finally:
        for sensor in sensors:
            sensor.close()


def test_the_physics_stands_behind_servos_and_boards(servos, boards):
    closed = {1: 2048 + 400, 2: 2048 - 400}
    limp = [int(sensor.latest().data.sum()) for sensor in boards]
    for servo, goal in closed.items():
        servos.write(servo, TORQUE_ENABLE, 1, 1)
        servos.write(servo, GOAL_CURRENT, 2, 150)  # 0.4 A
        servos.write(servo, GOAL_POSITION, 4, goal)
    until(lambda: all(sensor.latest().data.max() > 40 for sensor in boards))
    pressed = [int(sensor.latest().data.sum()) for sensor in boards]
    assert all(after > before + 500 for before, after in zip(limp, pressed, strict=True))
    # They are as strong as each other: where one lets go, the other takes the object along.
    for other, moved in (
        (2, lambda: servos.read(1, PRESENT_POSITION, 4) > 2060),
        (1, lambda: servos.read(2, PRESENT_POSITION, 4) < 2036),
    ):
        servos.write(other, GOAL_POSITION, 4, 2048)
        until(moved)
        servos.write(other, GOAL_POSITION, 4, closed[other])
    for servo in (1, 2):
        servos.write(servo, GOAL_POSITION, 4, 2048)
    until(lambda: all(sensor.latest().data.max() < 30 for sensor in boards))
    until(lambda: all(abs(servos.read(servo, PRESENT_POSITION, 4) - 2048) < 8 for servo in (1, 2)))
    for servo in (1, 2):
        servos.write(servo, TORQUE_ENABLE, 1, 0)


def test_clients_may_come_and_go(hand):
    for _ in range(3):
        servos = SdkServos(hand)
        assert servos.ping(2) == 1020
        servos.close()
        sensor = board(hand, 0)
        sensor.open()
        sensor.close()


def test_a_folder_in_use_is_refused_and_the_first_lives_on(hand, servos, inline):
    status, out, err = inline("emulate", "--dir", hand)
    assert (status, out) == (1, "")
    assert "in use by another emulator (process " in err
    assert len(err.splitlines()) == 1
    assert servos.ping(1) == 1020


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly_while_it_starts(tmp_path, number):
    with Process("--dir", tmp_path / "new", "--config", HIL) as process:
        # The folder is taken as the first thing, long before anything answers.
        until((tmp_path / "new" / ".emulator.lock").exists)
        assert process.end(number) == (0, "", "")
    assert list((tmp_path / "new").iterdir()) == []


def test_links_of_a_killed_emulator_are_replaced_and_an_interruption_is_survived(tmp_path):
    with Process("--dir", tmp_path, "--model", "XL330-M288", "--factory") as process:
        process.ready()
        servos = SdkServos(tmp_path)
        assert servos.read(1, OPERATING_MODE, 1) == 3
        assert servos.read(2, RETURN_DELAY, 1) == 250
        servos.close()
        process.popen.kill()
        process.popen.wait()
    assert all((tmp_path / name).is_symlink() for name in LINKS)
    with Process("--dir", tmp_path, "--model", "XL330-M288", "--ids", "7,3") as process:
        process.ready()
        servos = SdkServos(tmp_path)
        assert (servos.ping(7), servos.ping(3)) == (1200, 1200)
        assert servos.silent(1)
        process.popen.send_signal(signal.SIGSTOP)
        assert servos.silent(7)
        process.popen.send_signal(signal.SIGCONT)
        assert servos.ping(7) == 1200  # the answer to the one or to the other
        servos.close()
        assert process.end(signal.SIGHUP) == (0, "", "")
    assert not any(path.is_symlink() for path in tmp_path.iterdir())


def test_paced_servos_wait_for_the_latency_timer_and_are_deaf_at_another_rate(tmp_path):
    with emulated(tmp_path, servos=EmulatedServos(1_000_000, 0.008)):
        servos = SdkServos(tmp_path, 1_000_000)
        assert servos.ping(1) == 1020
        start = time.monotonic()
        for _ in range(5):
            assert servos.ping(1) == 1020
        # Each reply waits for the adapter's latency timer, and so for the one after it.
        assert time.monotonic() - start > 4 * 0.008
        servos.close()
        for baud in (2_000_000, 57_600):
            servos = SdkServos(tmp_path, baud)
            assert servos.silent(1)
            servos.close()


@pytest.mark.parametrize("name", ["servos", "control"])
def test_something_else_in_a_links_or_the_control_sockets_place_is_left_alone(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(EmulatorError, match=f"{name}: .*in the way"):
        Emulator(Settings(), tmp_path)
    assert (tmp_path / name).read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == [name]


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


def test_the_default_board_is_the_one_of_the_hil_profile(tmp_path):
    hil = load(HIL, tmp_path)
    assert with_board(hil) is hil
    default = with_board(Settings()).tactile
    for key in ("rows", "cols", "pitch", "pascal_per_count", "rate", "baud", "backend"):
        assert getattr(default, key) == getattr(hil.tactile, key), key
        if key in DEFAULT_BOARD:
            assert DEFAULT_BOARD[key] == getattr(default, key)
    assert hil.simulation == Settings().simulation


def test_time_leaves_interruptions_out(monkeypatch, tmp_path):
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


@pytest.mark.parametrize("late", [0.0005, 0.004, 0.03, 5.0])
def test_time_keeps_step_with_a_daemon_on_a_late_machine(monkeypatch, tmp_path, late):
    machine = LateMachine(100.0)
    monkeypatch.setattr(module.time, "monotonic", machine.now)
    clock = EmulatorClock(Deadline(tmp_path / Deadline.NAME, os.O_CREAT))
    servos = Mock(driven=lambda: driven, answering_until=0.0)
    clock.servos, driven = servos, True
    daemon = HandClock(machine, Deadline.of(str(tmp_path / "servos")))
    apart = []
    for k in range(200):
        daemon.sleep_until(100.0 + 0.002 * k)
        for _ in range(10):  # the emulator looks at its clock while the daemon is not on time
            machine.work(0.1 * late * (k % 3))
            apart.append(clock.now() - daemon.now())
    assert max(apart[20:]) - min(apart[20:]) <= 0.0045
    assert daemon.behind > 100 * late or late < 0.002
    # A reply on the wire arrives meanwhile; a daemon that is gone is waited for no longer.
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


def test_an_adapters_latency_timer_has_its_range(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["emulate", "--dir", str(tmp_path), "--latency", "-1"])
    assert "expected 0 to 255 ms" in capsys.readouterr().err
