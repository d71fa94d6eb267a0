"""Test the daemon as a systemd service, with watchdog messages, unit, udev rules and logs."""

import configparser
import grp
import json
import math
import os
import re
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import pytest

from softfinger.daemon.loop.realtime import Service
from softfinger.tools.processes.event_log import EventLog
from tests.harness.daemon_process import SOFTFINGER, ask
from tests.harness.descendants import ending


class Manager:
    """Socket that replaces the notification socket of the service manager."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "notify"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))
        self._socket.settimeout(200.0)

    def next(self) -> bytes:
        return self._socket.recv(4096)

    def quiet_for(self, seconds: float) -> bool:
        return not select.select([self._socket], [], [], seconds)[0]

    def drain(self) -> None:
        while not self.quiet_for(0.0):
            self.next()

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    manager = Manager(tmp_path)
    yield manager
    manager.close()


def test_ready_is_sent_first_and_then_four_watchdog_messages_per_interval(manager):
    service = Service(str(manager.path), watchdog=2.0)
    for tick in range(1000):  # 2 s
        service.alive(tick * 0.002)
    service.close()
    told = [manager.next() for _ in range(5)]
    assert told == [b"READY=1\nWATCHDOG=1", *[b"WATCHDOG=1"] * 3, b"STOPPING=1"]
    assert manager.quiet_for(0.0)


def test_a_missing_or_slow_manager_does_not_block_the_daemon(manager):
    service = Service(str(manager.path), watchdog=0.004)
    for tick in range(5000):  # far more messages than the socket can buffer
        service.alive(tick * 0.002)
    manager.close()
    service.alive(1e6)
    service.close()


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, False),
        ({"NOTIFY_SOCKET": ""}, False),
        ({"NOTIFY_SOCKET": "relative"}, False),
        ({"NOTIFY_SOCKET": "/run/x", "WATCHDOG_USEC": "junk"}, True),
    ],
)
def test_the_environment_determines_whether_it_is_a_service(environment, expected):
    service = Service.of_environment(environment)
    assert (service is not None) is expected
    if service is not None:
        service.alive(0.0)
        service.close()


def test_the_daemon_reports_ready_alive_and_stopping_but_not_while_suspended(
    manager, profile, addresses, tmp_path
):
    log = tmp_path / "log"
    process = subprocess.Popen(
        [
            *(*SOFTFINGER, "run", "--config", str(profile('task.name = "demo"\n')), "--no-task"),
            *("--log", "json", "--log-file", str(log)),
        ],
        env=os.environ | {"NOTIFY_SOCKET": str(manager.path), "WATCHDOG_USEC": "400000"},
        stderr=subprocess.PIPE,
        text=True,
    )
    with ending(process):
        assert manager.next() == b"READY=1\nWATCHDOG=1"
        status = ask(addresses[1], "status")
        assert (status["mode"], status["torque"]) == ("disarmed", False), (
            "the daemon must start without a task"
        )
        for _ in range(5):
            assert manager.next() == b"WATCHDOG=1"
        process.send_signal(signal.SIGSTOP)
        manager.drain()
        assert manager.quiet_for(0.5), "a stalled loop must not notify the watchdog"
        process.send_signal(signal.SIGCONT)
        assert manager.next() == b"WATCHDOG=1"
        process.terminate()
        told = b""
        while told != b"STOPPING=1":
            told = manager.next()
        assert process.wait(timeout=300) == 0
        assert process.stderr.read() == "", "all output must be in the log file"
    records = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    assert all({"timestamp", "level", "kind", "text"} <= set(record) for record in records)
    texts = [record["text"] for record in records]
    assert "running, disarmed" in texts
    assert "exited; torque is off" in texts
    times = [record["timestamp"] for record in records]
    assert times == sorted(times)
    running = next(record for record in records if record["text"] == "running, disarmed")
    assert (running["mode"], running["force"]) == ("disarmed", [0.0, 0.0])
    assert records[-1]["ticks"] > 0
    assert set(records[-1]["wake_s"]) == {"p50", "p99", "p999", "max"}


def test_an_abstract_socket_and_a_watchdog_of_another_process():
    name = f"softfinger-test-{os.getpid()}"
    watched = {"NOTIFY_SOCKET": f"@{name}", "WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name)
        service = Service.of_environment(watched)
        for t in range(10):
            service.alive(float(t))
        assert manager.recv(100) == b"READY=1\nWATCHDOG=1"
        assert not select.select([manager], [], [], 0.0)[0], "systemd watches another process"
        service.close()


def test_the_unit_has_the_settings_of_a_control_daemon(tmp_path, inline):
    config = tmp_path / "my hand 100%.toml"
    config.write_text("", encoding="utf-8")
    done = inline("install-service", "--config", config, "--user", "root")
    assert done.returncode == 0, done.stderr
    unit = configparser.RawConfigParser(strict=False, delimiters="=", comment_prefixes="#")
    unit.read_string(done.stdout)
    service = unit["Service"]
    assert (service["Type"], service["User"]) == ("notify", "root")
    assert int(service["LimitRTPRIO"]) >= 80
    assert service["LimitMEMLOCK"] == "infinity"
    assert int(service["WatchdogSec"]) > 0
    assert (service["Restart"], service["RestartPreventExitStatus"]) == ("on-failure", "2")
    assert service["DeviceAllow"] == "/dev/cpu_dma_latency rw"
    words = shlex.split(service["ExecStart"].replace("%%", "%"))
    assert words[0] == sys.executable
    assert words[4:6] == ["run", "--no-task"], "the service must restart disarmed"
    assert words[6:] == ["--log", "json", "--config", str(config)]
    # The program of the unit exists and prints its help.
    shown = subprocess.run([*words[:-2], "--help"], capture_output=True, timeout=300, check=False)
    assert shown.returncode == 0
    analyze = shutil.which("systemd-analyze")
    if analyze is not None:
        file = tmp_path / "softfinger.service"
        file.write_text(done.stdout, encoding="utf-8")
        call = [analyze, "verify", str(file)]
        verified = subprocess.run(call, capture_output=True, text=True, check=False)
        assert (verified.returncode, verified.stderr) == (0, "")


def test_rules_contain_only_keys_operators_and_quoted_values(inline):
    done = inline("install-service", "--udev")
    assert done.returncode == 0
    rules = [line for line in done.stdout.splitlines() if line and not line.startswith("#")]
    assert len(rules) == 3
    part = re.compile(r'[A-Z]+(\{\w+\})?(==|!=|=|\+=|:=)"[^"\n]+"')
    for rule in rules:
        assert all(part.fullmatch(each) for each in rule.split(", ")), rule
    assert any('ATTR{latency_timer}="1"' in rule for rule in rules)


@pytest.mark.parametrize(
    ("groups", "expected"),
    [(("dialout", "uucp"), "dialout"), (("uucp",), "uucp"), ((), "dialout")],
)
def test_unit_and_rules_name_the_group_of_this_system(inline, monkeypatch, groups, expected):
    every = [grp.struct_group((name, "x", 1, [])) for name in ("root", *groups)]
    monkeypatch.setattr(grp, "getgrall", lambda: every)
    assert f"\nSupplementaryGroups={expected}\n" in inline("install-service").stdout
    rules = inline("install-service", "--udev").stdout
    assert set(re.findall('GROUP="(.*?)"', rules)) == {expected}


@pytest.mark.parametrize(
    "words",
    [
        ("--user", "nobody-of-that-name"),
        ("--config", "/absent.toml"),
    ],
)
def test_failed_installations_are_reported(inline, words):
    done = inline("install-service", *words)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("install-service: ")


def test_plain_and_json_log_lines_have_the_same_content(tmp_path):
    import logging

    for form in ("plain", "json"):
        log = EventLog(form, tmp_path / form)
        log.take_over_logging()
        handler = logging.getLogger().handlers[-1]
        log.line("warning", "servos.temperature", 'left "servo"\nat 61 °C')
        log.line("error", "", "softfinger: ended")
        logging.getLogger("softfinger.daemon.servos.dynamixel").error("port %s is gone", "x")
        log.close()
        logging.getLogger().removeHandler(handler)
    plain = (tmp_path / "plain").read_text(encoding="utf-8").splitlines()
    day, clock, said = plain[0].split(" ", 2)
    assert abs((datetime.now() - datetime.fromisoformat(f"{day} {clock}")).days) <= 1
    assert said == 'warning servos.temperature left "servo"'
    assert plain[2] == "softfinger: ended"
    assert plain[3].endswith("error   dynamixel port x is gone")
    lines = (tmp_path / "json").read_text(encoding="utf-8").splitlines()
    told = [json.loads(line) for line in lines]
    assert [(each["level"], each["kind"], each["text"]) for each in told] == [
        ("warning", "servos.temperature", 'left "servo"\nat 61 °C'),
        ("error", "", "softfinger: ended"),
        ("error", "dynamixel", "port x is gone"),
    ]


def test_journal_lines_have_priorities(capfd, monkeypatch):
    status = os.fstat(sys.stderr.fileno())
    monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
    for form in ("plain", "json"):
        log = EventLog(form)
        log.line("warning", "bus", "slow\nand late", late_s=0.25)
        log.line("error", "", "softfinger: exited with a fault")
        log.close()
    *plain, line, last = capfd.readouterr().err.splitlines()
    ended = "<3>softfinger: exited with a fault"
    assert plain == ["<4>warning bus      slow", "<4>and late", ended]
    assert (json.loads(line.removeprefix("<4>"))["late_s"], last[:3]) == (0.25, "<3>")


def test_a_log_file_that_cannot_be_opened_is_reported(profile, inline):
    done = inline("run", "--config", profile(), "--log-file", "/absent/log")
    assert done.returncode == 2
    assert "--log-file /absent/log: No such file or directory" in done.stderr


@pytest.mark.extended
def test_the_daemon_runs_with_all_standard_streams_closed(profile):
    command = shlex.join(
        [*SOFTFINGER, "run", "--monitor", "--duration", "0.5", "--config", str(profile())]
    )
    done = subprocess.run(["sh", "-c", f"exec {command} <&- >&- 2>&-"], timeout=200, check=False)
    assert done.returncode == 0


@pytest.mark.parametrize("clock", [1e30, -1e30, math.inf, math.nan])
def test_logging_continues_when_the_system_date_is_invalid(tmp_path, monkeypatch, clock):
    log = EventLog("plain", tmp_path / "log")
    with monkeypatch.context() as patched:
        patched.setattr("softfinger.tools.processes.event_log.time.time", lambda: clock)
        log.line("info", "tick", "on no day")
    log.line("info", "tick", "on this one")
    log.close(60.0)
    first, second = (tmp_path / "log").read_text().splitlines()
    assert first.endswith("tick     on no day")
    assert second.endswith("tick     on this one")
