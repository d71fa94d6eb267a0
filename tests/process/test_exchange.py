"""Test the doctor's bus timing, and the servo checks during connection and while disarmed."""

import contextlib
import grp
import re
from typing import Any

import pytest

from softfinger.daemon import port_access
from softfinger.daemon.clock import RealClock
from softfinger.daemon.diagnosis import devices
from softfinger.daemon.errors import ServoError, ServosSilent
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.profile.validation import problems
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.servos.exchange import ExchangeTimes, judge_exchanges
from softfinger.daemon.servos.protocol import FastGroupRead, SerialPort
from softfinger.daemon.simulation.emulator.folder import send_words
from softfinger.daemon.types import Reading
from tests.conftest import until
from tests.harness.daemon_process import started
from tests.harness.descendants import ending
from tests.harness.emulated import HIL, EmulatorProcess
from tests.harness.servos import RunningBus, backend_settings, connected


def exchange(bus: RunningBus, rate: float = 500.0, **servos: Any) -> Finding:
    """Return the doctor's finding about the duration of a tick's bus exchange."""
    settings = backend_settings(bus.port, **servos)
    settings = settings.changed(loop={"rate": rate})
    (found,) = [each for each in devices.check_servos(settings) if each.subject == "exchange"]
    return found


# Timing measured by the doctor


def test_doctor_times_the_exchange_of_a_tick_without_changing_registers(running):
    bus = running(servos={"mode": "current-based position"})
    before = [bus.memory(i)[: reg.REALTIME_TICK] for i in (0, 1)]
    heard = bytearray()
    exchanged = bus.bus.exchange
    bus.bus.exchange = lambda data, *rest: heard.extend(data) or exchanged(data, *rest)
    found = exchange(bus, 5.0)
    assert found.status == "pass", found
    assert found.text.startswith("50 read and write cycles: p50 ")
    until(lambda: len(re.findall(rb"\xff\xff\xfd\x00\xfe..\x83", heard, re.DOTALL)) == 50)
    reads = re.findall(rb"\xff\xff\xfd\x00\xfe..\x8a", heard, re.DOTALL)
    assert len(reads) == 54  # The doctor also reads four register spans.
    assert [bus.memory(i)[: reg.REALTIME_TICK] for i in (0, 1)] == before


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({reg.TORQUE_ENABLE: 1}, "torque is on"),
        ({reg.FIRMWARE_VERSION: 46}, "the firmware versions differ"),
        (
            {reg.TORQUE_ENABLE: 1, reg.FIRMWARE_VERSION: 46},
            "torque is on and the firmware versions differ",
        ),
    ],
)
def test_doctor_states_why_it_writes_nothing(running, changed, reason):
    bus = running(servos={"mode": "current-based position"})
    for address, value in changed.items():
        bus.servo(1).table.set(address, value)
    assert f"read cycles (no writes, because {reason}): " in exchange(bus, 5.0).text


def test_late_replies_fail_with_timings_and_suggested_settings(bus):
    bus.fault("delay=0.02")
    found = exchange(bus, 100.0, reply_timeout=1.0)
    assert found.status == "FAIL"
    assert (
        "expected at most 10 ms, the period of a tick (loop.rate = 100), and at most 1000 ms"
        in found.text
    )
    assert found.fix.startswith("set loop.rate = ")
    assert float(found.fix.split()[3].rstrip(";,")) < 50.0
    found = exchange(bus, 5.0, reply_timeout=0.005)
    assert found.status == "FAIL"
    suggested = re.match(r"set servos\.reply_timeout = ([\d.]+\d)", found.fix)
    assert suggested, found.fix
    assert float(suggested[1]) > 0.02


def test_assessment_of_exchange_times():
    def judged(p50: float, p99: float, failed: float = 0.0, **how: bool) -> Finding:
        return judge_exchanges(ExchangeTimes(p50, p50, p99, failed), Settings(), "50", **how)

    assert judged(0.0004, 0.0009).status == "pass"
    assert judged(0.0004, 0.0009).text == "50: p50 0.4 ms, p99 0.9 ms, 0% failed"
    near = judged(0.0017, 0.0018)  # `run` issues the same warning.
    assert (near.status, near.fix.split(",")[0]) == ("warn", "set loop.rate = 440")
    assert near.text.endswith(
        "a cycle takes up most of a tick of 2 ms (loop.rate = 500), so ticks will be late"
    )
    # Both percentiles of the exchange time are between a tick and reply_timeout.
    both = judged(0.0028, 0.003)
    assert (both.status, both.fix.split(",")[0]) == ("FAIL", "set loop.rate = 260")
    assert (
        "expected at most 2 ms, the period of a tick (loop.rate = 500), and at most 4 ms"
        in both.text
    )
    slow = judged(0.016, 0.016)
    assert slow.fix.startswith("set servos.reply_timeout = 0.024 and loop.rate = 50, or")
    assert judged(0.0004, 0.01).status == "FAIL"
    assert judged(0.0004, 0.01, emulated=True).status == "pass"
    assert [judged(0.0004, 0.0009, share).status for share in (0.02, 0.1, 0.3)] == [
        "pass",
        "warn",
        "FAIL",
    ]
    assert judge_exchanges(ExchangeTimes(1.0, 1.0, 1.0, 1.0), Settings(), "50").status == "FAIL"


# Checks during connection


def test_sync_reads_replace_fast_reads_that_a_firmware_only_claims_to_support(bus):
    for i in (0, 1):
        bus.servo(i).fast_reads = False  # The reported firmware supports fast reads.
    backend = connected(bus)
    (notice,) = [each for each in backend.notices if "fast sync read" in each.text]
    assert notice.fix == "the daemon uses slower normal sync reads"
    assert not isinstance(backend._reads.errors, FastGroupRead)
    reading = Reading()
    backend.read(reading)
    assert reading.valid
    backend.close()


def test_servos_without_group_reads_are_refused(bus):
    for i in (0, 1):
        bus.servo(i).fast_reads = False
    answers = bus.servo(1).answers_reads
    bus.servo(1).answers_reads = lambda servo_id, fast: False
    with pytest.raises(ServoError, match="reply to single reads, but not to a sync read of all"):
        connected(bus, reply_timeout=0.3)
    bus.servo(1).answers_reads = answers
    connected(bus).close()


def test_slow_replies_are_reported_at_start_up(bus):
    bus.fault("delay=0.01")
    backend = connected(bus)
    (notice,) = [each for each in backend.notices if "ticks will be late" in each.text]
    assert "of a tick of 2 ms (loop.rate = 500)" in notice.text
    assert "`softfinger doctor` to measure the reply times of 50 exchanges" in notice.fix
    backend.close()


# Slow start-up of boards.


def test_the_port_stays_open_while_a_board_boots(running, monkeypatch):
    """Opening the port may restart the board, so the backend must open the port only once."""
    bus, opened = running(), []
    for i in (0, 1):
        bus.servo(i).silent = True
    open_port = SerialPort.openPort
    monkeypatch.setattr(SerialPort, "openPort", lambda self: opened.append(1) or open_port(self))
    backend = DynamixelServos(backend_settings(bus.port, reply_timeout=0.2), RealClock())

    def connects() -> bool:
        with contextlib.suppress(ServosSilent):
            backend.connect()
            return True
        return False

    assert not connects()
    for i in (0, 1):
        bus.servo(i).silent = False
    until(connects)
    assert len(opened) == 1
    backend.close()
    connected(bus).close()  # The doctor has released the port.


def test_doctor_waits_as_long_as_run(running):
    bus = running()
    bus.servo(1).silent = True
    settings = backend_settings(bus.port, open_timeout=60.0)
    pinged: list[int] = []

    def answer_the_third(data: bytes, *rest: Any) -> Any:
        if data[4:5] + data[7:8] == b"\x02\x01":
            pinged.append(2)
            bus.servo(1).silent = len(pinged) < 3
        return exchanged(data, *rest)

    exchanged, bus.bus.exchange = bus.bus.exchange, answer_the_third
    found = [each for each in devices.check_servos(settings) if each.subject == "servo 2 (right)"]
    assert [each.status for each in found] == ["pass"]
    assert Settings().tactile.open_timeout == Settings().servos.open_timeout == 5.0


def test_a_servo_that_answers_after_the_wait_is_told_from_a_broken_cable(running, monkeypatch):
    bus = running()
    bus.servo(1).silent = True
    examine = devices.examine

    def examine_then_boot(*args: Any) -> Any:
        found = examine(*args)
        bus.servo(1).silent = False
        return found

    monkeypatch.setattr(devices, "examine", examine_then_boot)
    settings = backend_settings(bus.port, open_timeout=0.01)
    failed = [each for each in devices.check_servos(settings) if each.status != "pass"]
    assert [each.fix for each in failed] == [
        "set a longer servos.open_timeout, because the servo replies now"
    ]
    assert failed[0].text.endswith("within servos.open_timeout = 0.01 s")


# Ports.


def test_two_fingers_on_one_port_are_detected_by_the_real_path(tmp_path):
    (tmp_path / "left").touch()
    (tmp_path / "again").symlink_to(tmp_path / "left")
    ports = (str(tmp_path / "left"), str(tmp_path / "again"))

    def told(*fingers: str) -> list[str]:
        values = {
            "scene": {"fingers": fingers},
            "servos": {"backend": "dynamixel", "port": str(tmp_path / "servos")},
            "tactile": {"backend": "flexitac", "port": ports},
        }
        return [each for each in problems(Settings.model_validate(values)) if "port" in each]

    (problem,) = told("left", "right")
    assert problem.startswith("tactile.port (right): found ")
    assert "expected a port other than tactile.port (left)" in problem
    assert "/dev/serial/by-path" in problem
    assert told("right") == []


@pytest.mark.parametrize(
    ("group", "mode", "advice"),
    [
        ("uucp", 0o660, "sudo usermod -aG uucp $USER, then log in again"),
        (
            "root",
            0o660,
            "sudo chmod a+rw {} as a temporary fix; for a permanent fix, add a udev rule",
        ),
        (
            "uucp",
            0o600,
            "sudo chmod a+rw {} as a temporary fix; for a permanent fix, add a udev rule",
        ),
    ],
)
def test_membership_in_the_group_of_the_port_is_recommended(
    tmp_path, monkeypatch, group, mode, advice
):
    port = tmp_path / "port"
    port.touch()
    port.chmod(mode)
    Group = type("Group", (), {"gr_name": group, "gr_mem": []})
    monkeypatch.setattr(grp, "getgrgid", lambda _: Group)
    assert port_access.grant(str(port)) == advice.format(port)
    assert port_access.grant(str(tmp_path / "none")) == f"sudo chmod a+rw {tmp_path / 'none'}"


# A daemon without readings.


def test_run_reports_late_replies_at_start_up_and_while_disarmed(tmp_path, addresses):
    folder = tmp_path / "hand"
    with EmulatorProcess("--dir", folder, "--config", HIL).ready() as hand:
        assert hand.popen.poll() is None
        send_words(folder, "delay=0.05")
        words = ["run", "--config", HIL, "--dir", folder, "--set", "loop.clock=real"]
        for key, address in zip(("stream", "commands"), addresses, strict=True):
            words += ["--set", f"{key}.address={address}"]
        with ending(started(*words, stdout=None)) as daemon:
            told = []
            for line in daemon.stderr:
                told.append(line)
                if "of the readings in the last second failed" in line:
                    break
            assert any("ticks will be late: set servos.reply_timeout" in line for line in told)
            assert "within servos.reply_timeout = 4 ms; run `softfinger doctor`" in told[-1]
            assert "running, disarmed" in "".join(told)
            daemon.terminate()
            daemon.stderr.read()
            assert daemon.wait(300) == 0
        hand.end()
