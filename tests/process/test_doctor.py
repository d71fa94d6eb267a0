"""Test `softfinger doctor`, its checks, and `softfinger scan` on emulated hands."""

import contextlib
import os
import resource
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from softfinger.daemon.diagnosis import devices, machine, ports
from softfinger.daemon.diagnosis.register_file import restore_registers
from softfinger.daemon.errors import ServoError
from softfinger.daemon.loop import warm_up
from softfinger.daemon.perception.calibration_file import (
    Calibration,
    save_calibration,
    sensor_of,
)
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import checks
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Finding
from softfinger.kinematics.compiled.kernel_folder import find_kernel_folder
from softfinger.tools.cli import main
from softfinger.tools.setup import doctor
from tests.conftest import Addresses
from tests.harness.descendants import ending
from tests.harness.emulated import HIL, emulated
from tests.harness.gateway import Served


class Hand:
    """Emulated hand for the doctor to examine, which runs in a thread."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.folder = folder
        self.settings = load(HIL, folder)
        self._stack = contextlib.ExitStack()
        running = emulated(folder, settings=self.settings, **options)
        self.emulator = self._stack.enter_context(running)

    def registers(self) -> list[bytes]:
        """Return the registers of both servos, except the registers that change by themselves."""
        live = slice(reg.REALTIME_TICK, reg.PRESENT_TEMPERATURE + 1)
        bus = self.emulator._servos.bus
        memories = [bytes(servo.table.memory) for servo in bus.servos]
        return [memory[: live.start] + memory[live.stop :] for memory in memories]

    def doctor(self, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, list[str]]:
        """Run the doctor with settings that tolerate late replies; return its status and output."""
        late = ("servos.reply_timeout=1", "servos.open_timeout=0.1", "loop.rate=20")
        words += ("--set", "servos.watchdog=0.5", "--set", "servos.fault_after=0.5")
        words += tuple(word for each in late for word in ("--set", each))
        status = main(["doctor", "--config", str(HIL), "--dir", str(self.folder), *words])
        return status, capsys.readouterr().out.splitlines()

    def close(self) -> None:
        self._stack.close()


@pytest.fixture
def hands(tmp_path: Path) -> Iterator[Callable[..., Hand]]:
    with contextlib.ExitStack() as stack:
        made = partial(Hand, tmp_path)
        yield lambda **options: stack.enter_context(contextlib.closing(made(**options)))


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the doctor's address check, and shorten the doctor's wake-up measurement."""
    monkeypatch.setattr(doctor, "check_addresses", lambda _: [])
    monkeypatch.setattr(machine, "_WAKE_UP_COUNT", 5)


def scanned(capsys: pytest.CaptureFixture[str], folder: Path, *words: str) -> list[str]:
    """Return the servos that `scan` reports."""
    main(["scan", str(folder / "servos"), "--baud", "2000000", "--baud", "1000000", *words])
    lines = capsys.readouterr().out.splitlines()
    return [line.removeprefix(f"{folder}/servos: ") for line in lines]


def with_status(lines: list[str], status: str) -> list[str]:
    return [line[7:] for line in lines if line.startswith(status)]


def test_servos_with_factory_settings_fail_and_are_only_repaired_on_request(hands, capsys):
    hand = hands(factory=True)
    before = hand.registers()
    status, lines = hand.doctor(capsys)
    assert status == 1
    assert hand.registers() == before
    failed = with_status(lines, "FAIL")
    assert len(failed) == 4
    assert "servo 2 (right): return delay is 500 µs, expected at most 50 µs" in failed
    assert lines.count("       → softfinger doctor --fix") == 4
    status, lines = hand.doctor(capsys, "--fix")
    assert status == 0, lines
    assert "servo 1 (left): operating mode 3 → 5" in with_status(lines, "fixed")
    assert sum("current-based position mode" in line for line in with_status(lines, "pass")) == 2
    assert not any(memory[reg.TORQUE_ENABLE] for memory in hand.registers())
    before = hand.registers()
    status, lines = hand.doctor(capsys, "--fix")
    assert status == 0
    assert with_status(lines, "fixed") == []
    assert hand.registers() == before


def test_registers_are_stored_before_a_change_and_restored(hands, capsys, tmp_path):
    hand, path = hands(factory=True), tmp_path / "before.json"
    before = [memory[: reg.RAM] for memory in hand.registers()]
    status, lines = hand.doctor(capsys, "--save", str(path), "--fix")
    assert status == 0, lines
    assert f"note   servo 1 (left): 29 registers saved to {path}" in lines
    assert [memory[: reg.RAM] for memory in hand.registers()] != before
    saved = path.read_text()
    status, lines = hand.doctor(capsys, "--save", str(path), "--fix")
    assert status == 1
    assert f"servos: {path}: already exists; " in "".join(with_status(lines, "FAIL"))
    assert path.read_text() == saved
    for servo in hand.emulator._servos.bus.servos:
        servo.table.set(reg.GOAL_PWM, 500)
        servo.table.set(reg.BUS_WATCHDOG, 255)  # The watchdog has stopped the servo.
    status, lines = hand.doctor(capsys, "--restore", str(path))
    assert "servo 1 (left): goal PWM 500 → 885" in with_status(lines, "fixed")
    assert "servo 1 (left): operating mode 5 → 3" in with_status(lines, "fixed")
    assert [memory[: reg.RAM] for memory in hand.registers()] == before
    status, lines = hand.doctor(capsys, "--restore", str(tmp_path / "none.json"))
    assert f"{tmp_path}/none.json: No such file or directory" in lines[-1] + "".join(lines)


def test_servos_are_not_repaired_if_their_registers_cannot_be_saved(hands, capsys, tmp_path):
    hand = hands(factory=True)
    before = hand.registers()
    status, lines = hand.doctor(capsys, "--save", str(tmp_path / "none" / "x.json"), "--fix")
    assert status == 1
    assert hand.registers() == before
    assert with_status(lines, "fixed") == []
    assert "servos: not repaired, because their registers were not saved" in with_status(
        lines, "warn"
    )


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("{", "contents: Invalid JSON: "),
        ('{"servos": [{"id": 1}]}', "servos.0.model: Field required"),
    ],
)
def test_invalid_register_files_are_reported_with_the_position(tmp_path, content, told):
    path = tmp_path / "servos.json"
    path.write_text(content)
    with pytest.raises(ServoError, match=f"{path}: {told}"):
        restore_registers(Settings(), path)


@pytest.mark.parametrize("option", ["save", "restore"])
def test_register_files_without_a_servo_port_fail(tmp_path, option):
    path = tmp_path / "servos.json"
    checks = doctor.results(Settings(), False, **{option: path})
    found = next(each for each in checks if each.status == "FAIL")
    assert found.subject == str(path)
    assert f"no registers were {option}d, because there is no servo port to use" in found.text


@pytest.mark.extended
def test_boards_are_checked(hands, capsys):
    hand = hands()
    status, lines = hand.doctor(capsys)
    assert status == 0, lines
    for side in ("left", "right"):
        # On a busy machine, the boards may be reported as slow, which is not a failure.
        assert [line for line in lines if f" tactile {side}: 32 × 32 cells, " in line]
    hand.emulator.request("left:drift=0.1")
    status, lines = hand.doctor(capsys)
    assert status == 0
    untared = next(line for line in lines if line.startswith("warn   tactile left"))
    assert "without load (expected 0 kPa)" in untared
    hand.emulator.request("left:wrong-size")
    status, lines = hand.doctor(capsys)
    assert status == 1
    assert "256 cells" in next(line for line in lines if line.startswith("FAIL   tactile left"))
    assert any(line.endswith(": set tactile.rows and tactile.cols") for line in lines)
    assert scanned(capsys, hand.folder, "--wait", "1") == [  # The servos reply at any baud rate.
        f"ID {servo} at 2000000, 1000000 baud: XM430-W350, firmware 48" for servo in (1, 2)
    ]
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "note   servos: simulated: there is no servo to check" in lines
    assert lines[-1].endswith(" 0 failed")


def test_a_tip_model_other_than_the_calibrated_one_is_reported(tmp_path, monkeypatch):
    def tips(**tip: Any) -> Settings:
        tactile = {"calibration": (str(tmp_path / "left.json"), "")}
        return Settings.model_validate({"tip": tip, "tactile": tactile})

    made = Calibration(sensor=sensor_of(Settings(), 0), date="2026-01-01")
    save_calibration(tmp_path / "left.json", made)
    untried = devices.check_law(tips(), 0)
    assert (untried.status, untried.fix) == ("note", "`softfinger calibrate law`")
    assert "'springs', which has not been verified" in untried.text
    wants = {"physics": "solid", "base": "bonded", "face": "frictionless", "poisson": 0.48}
    save_calibration(tmp_path / "left.json", made.model_copy(update={"wants": wants}))
    told = devices.check_law(tips(), 0)
    assert told.status == "warn"
    assert "tip.physics is 'springs', but `calibrate law` found 'solid'" in told.text
    assert devices.check_law(tips(physics="solid", poisson=0.47), 0).status == "pass"
    assert devices.check_law(tips(physics="solid", poisson=0.45), 0).fix == "set tip.poisson"
    (tmp_path / "left.json").write_text("{}")
    assert devices.check_law(tips(), 0).status == "FAIL"
    monkeypatch.setattr(devices, "make_sensor", Mock())
    assert "left.json: " in devices.check_board(tips(), 0).text


def test_a_missing_port_and_a_missing_servo_fail(hands, capsys):
    hand = hands()
    hand.emulator.request("silent=2 right:unplug")
    status, lines = hand.doctor(capsys)
    assert status == 1
    failed = with_status(lines, "FAIL")
    assert [line for line in failed if "tactile-right: no such file" in line]
    silent = "servo 2 (right): no reply at 2000000 baud within servos.open_timeout = 0.1 s"
    assert silent in failed
    (at,) = [
        k for k, line in enumerate(lines) if "no other servo replies at any baud rate; " in line
    ]
    assert lines[at].endswith(" V")
    assert "replace the cable between the servos" in lines[at + 1]


@pytest.mark.waits
@pytest.mark.extended
def test_servos_at_another_rate_are_found(hands, capsys):
    hand = hands(baud=1_000_000)
    found = "note   found: ID 1 at 1000000 baud: XM430-W350, firmware 48"
    status, lines = hand.doctor(capsys)
    assert status == 1
    assert found in lines
    assert (
        "       → run softfinger doctor --fix to use it as servo 1 (left): 1000000 → 2000000 baud; "
        "or set servos.baud = 1000000"
    ) in lines
    assert scanned(capsys, hand.folder, "--wait", "2") == [
        f"ID {servo} at 1000000 baud: XM430-W350, firmware 48" for servo in (1, 2)
    ]
    path = str(hand.folder / "servos")
    assert main(["scan", path, "--baud", "57600", "--wait", "0.5"]) == 1
    assert "no servo replied at any of these baud rates" in capsys.readouterr().out
    assert main(["scan", "/dev/does-not-exist"]) == 1
    assert "port not found" in capsys.readouterr().err


@pytest.mark.waits
@pytest.mark.extended
def test_a_servo_id_is_only_changed_on_request(hands, capsys):
    hand = hands(ids=(1, 7), baud=2_000_000)
    servo = hand.emulator._servos.bus.servos[1]
    found = "note   found: ID 7 at 2000000 baud: XM430-W350, firmware 48"
    status, lines = hand.doctor(capsys)
    assert (status, servo.id) == (1, 7)
    assert found in lines
    fix = "run softfinger doctor --fix to use it as servo 2 (right): ID 7 → 2; or set servos.ids"
    assert f"       → {fix}" in lines
    status, lines = hand.doctor(capsys, "--fix")
    assert (status, servo.id) == (0, 2)
    assert "fixed  servo 2 (right): ID 7 → 2" in lines
    servo.table.set(reg.ID, 1)
    status, lines = hand.doctor(capsys)
    assert status == 1
    (garbled,) = [line for line in with_status(lines, "FAIL") if "are corrupted" in line]
    assert garbled.startswith("servos: replies from ID 1 at 2000000 baud are corrupted: several")
    assert [line for line in lines if line.startswith("       → connect only one servo and")]


# Ports.


@pytest.fixture
def terminal() -> Iterator[str]:
    """Return the path of a pseudo-terminal."""
    master, slave = os.openpty()
    yield os.ttyname(slave)
    os.close(slave)
    os.close(master)


def test_unusable_ports_fail(tmp_path, terminal, monkeypatch):
    missing = ports.check_port(str(tmp_path / "none"), "servos.port")
    assert (missing.status, missing.text) == ("FAIL", "no such file or directory")
    assert "servos.port" in missing.fix
    dangling = tmp_path / "dangling"
    dangling.symlink_to(tmp_path / "gone")
    assert ports.check_port(str(dangling), "servos.port").text == "the link's target does not exist"
    plain = tmp_path / "plain"
    plain.touch()
    assert ports.check_port(str(plain), "servos.port").text == "is not a serial port"
    assert ports.check_port("/dev/null", "servos.port").text == "is not a serial port"
    monkeypatch.setattr(os, "access", lambda *_: False)
    found = ports.check_port(terminal, "servos.port")
    assert found.text == "no permission to open the port"
    assert found.fix.startswith("sudo ")


@pytest.mark.parametrize("locked", [True, False])
def test_the_process_using_a_port_is_named(terminal, locked):
    path = terminal
    # The test process owns the pty's master, so it does not count as a user of the port.
    script = (
        "import fcntl, os, sys; d = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)\n"
        f"if {locked}: fcntl.flock(d, fcntl.LOCK_EX)\n"
        "print('open', flush=True); sys.stdin.read()"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    # Start a process whose command line resembles the daemon's command line.
    words = [sys.executable, "-c", script, path, "softfinger", "run"]
    with ending(subprocess.Popen(words, **pipes)) as other:
        assert other.stdout.readline() == "open\n"
        found = ports.check_port(path, "servos.port")
        well = ports.check_port(path, "servos.port", "holding")
        other.stdin.close()
        other.wait(300.0)
    assert found.status == "FAIL"
    assert f"in use by process {other.pid} (python" in found.text
    assert found.fix == f"kill {other.pid}"
    assert well.status == "warn", "a responding daemon must not be killed"
    assert (
        f"in use by the softfinger daemon running on this machine (holding, process {other.pid})"
        in well.text
    )
    assert "kill" not in well.fix
    assert ports.check_port(path, "servos.port").status == "pass"


def test_latency_timer_is_checked_and_repaired(tmp_path, monkeypatch):
    path, sysfs = "/dev/ttyUSB7", tmp_path / "sys"  # fake adapter
    timer = sysfs / "ttyUSB7" / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    slow = checks.check_latency_timer(path, 0.004, sysfs)
    assert slow.status == "FAIL"
    assert "softfinger doctor --fix" in slow.fix
    assert checks.check_latency_timer(path, 0.05, sysfs).status == "warn"
    with monkeypatch.context() as refused:
        refused.setattr(Path, "write_text", Mock(side_effect=PermissionError(13, "denied")))
        found = devices.repair_latency_timer(path, sysfs)
    assert (found.status, found.fix) == ("warn", f"echo 1 | sudo tee {timer}")
    assert devices.repair_latency_timer(path, sysfs).status == "fixed"
    assert timer.read_text() == "1"
    assert checks.check_latency_timer(path, 0.004, sysfs).status == "pass"
    assert devices.repair_latency_timer(path, sysfs) is None
    assert checks.check_latency_timer("/dev/pts/0", 0.004, sysfs) is None


def test_a_board_at_the_unused_servo_port_is_not_checked_as_a_servo(tmp_path, monkeypatch):
    board = ['tactile.backend="flexitac"', 'tactile.port=["/dev/ttyUSB0", ""]']
    changes = ['servos.backend="none"', 'scene.fingers=["left"]', *board]
    settings = load(changes=changes)
    assert settings.servos.port == settings.tactile.port[0]
    latency = Mock(return_value=None)
    monkeypatch.setattr(doctor, "check_latency_timer", latency)
    monkeypatch.setattr(doctor, "check_port", lambda path, *_: Finding("pass", path, "free"))
    found = list(doctor.results(settings, False, save=tmp_path / "servos.json"))
    latency.assert_called_once_with("/dev/ttyUSB0", 1.0)
    assert [each.status for each in found if each.subject == "servos"] == ["note"]


# Checks of the machine.


def test_scheduling_check_restores_the_scheduler(monkeypatch):
    before = os.sched_getscheduler(0)
    assert machine.check_scheduling().status in ("pass", "warn")
    assert os.sched_getscheduler(0) == before

    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    found = machine.check_scheduling()
    assert found.status == "warn"
    assert "rtprio" in found.fix


def test_memory_idle_state_and_clock_checks(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert machine.check_memory_lock(resource.RLIM_INFINITY).status == "pass"
    assert machine.check_memory_lock(1 << 30).status == "pass"
    assert "memlock" in machine.check_memory_lock(8 << 20).fix
    place = tmp_path / "cpu_dma_latency"
    assert machine.check_idle_states(place).status == "warn"
    place.touch()
    assert machine.check_idle_states(place).status == "pass"
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "udevadm" in machine.check_idle_states(place).fix
    assert machine.check_wall_clock(0.0).status == "warn"
    assert machine.check_wall_clock(2e9).status == "pass"
    assert machine.check_wake_ups([1e-4] * 9 + [0.1]).status == "pass"
    assert machine.check_wake_ups([2e-3] * 9).status == "warn"
    assert len(machine.wake_ups()) == 5


def test_missing_damaged_and_writable_kernel_files_cause_warnings(tmp_path, monkeypatch):
    scene = Settings.model_validate({"servos": {"backend": "none"}, "tactile": {"backend": "none"}})
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(warm_up, "kernel_folder", find_kernel_folder)
    (found,) = machine.check_kernels(scene)
    assert found.status == "warn"
    assert "not compiled yet: contact table, joints and timing;" in found.text
    for part in warm_up.parts(scene):
        warm_up.mark_built(part, scene)
    (found,) = machine.check_kernels(scene)
    assert found.status == "pass"
    (folder,) = tmp_path.glob("kernels-*")
    (folder / "grip.kernel").write_bytes(b"torn")
    (found,) = machine.check_kernels(scene)
    assert (found.status, found.text[:17]) == ("warn", "found 1 corrupted")
    folder.chmod(0o777)
    (found,) = machine.check_kernels(scene)
    assert found.status == "warn"
    assert "other users can write to it" in found.text
    assert "NUMBA_CACHE_DIR" in found.fix


# Sockets.


def profile(addresses: Addresses) -> Settings:
    stream, commands = addresses
    return Settings.model_validate(
        {"stream": {"address": stream}, "commands": {"address": commands}}
    )


def test_unused_and_used_sockets(addresses, monkeypatch):
    settings = profile(addresses)
    assert [each.status for each in ports.check_addresses(settings)] == ["pass", "pass"]
    monkeypatch.setattr("softfinger.daemon.diagnosis.ports._TIMEOUT", 0.05)
    host, port = addresses[0].removeprefix("tcp://").split(":")
    with socket.create_server((host, int(port))):
        taken, free = ports.check_addresses(settings)
    assert taken.status == "FAIL"
    assert "another program, which is not a softfinger daemon" in taken.text
    assert "stream.address" in taken.fix
    assert free.status == "pass"


def test_a_running_daemon_is_detected(addresses):
    with Served(commands=addresses[1]) as served, served.serving(lambda *_: {"mode": "holding"}):
        _, found = ports.check_addresses(profile(addresses))
    assert found.status == "warn"
    assert "already running on this machine (holding)" in found.text


def test_ipc_addresses(tmp_path):
    place = f"ipc://{tmp_path / 'commands'}"
    assert ports.why_not_free(place) == ""
    with Served(commands=place):
        assert "is in use" in ports.why_not_free(place)
    assert ports.why_not_free(place) == ""
    assert list(tmp_path.iterdir()) == []
    assert "No such file" in ports.why_not_free("ipc:///nowhere/at/all")
