"""The command line, as real processes: run, send, signals, a second daemon, bad settings."""

from __future__ import annotations

import json
import re
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from tests.conftest import until
from tests.harness.daemon_process import SOFTFINGER, Running, softfinger

Profile = Callable[[str], Path]
README = Path(__file__).parents[2] / "README.md"


def test_arm_grasp_and_stop_from_the_command_line(
    start: Callable[..., Running], profile: Profile, addresses: tuple[str, str]
) -> None:
    running = start("--config", str(profile("")))

    def send(*words: str) -> tuple[int, dict[str, Any]]:
        done = softfinger("send", *words, "--address", addresses[1])
        return done.returncode, json.loads(done.stdout)

    assert send("grasp", "force=5") == (
        1,
        {"ok": False, "error": "grasp: not while disarmed; arm first"},
    )
    assert send("arm") == (0, {"ok": True, "mode": "armed"})
    assert send("grasp", "force=5") == (0, {"ok": True, "mode": "grasping"})
    until(lambda: send("status")[1]["mode"] == "holding")
    assert send("rotate", "angle=5deg")[1]["mode"] == "rotating"
    assert send("stop") == (0, {"ok": True, "mode": "disarmed"})
    status, reply = send("status")
    assert (status, reply["torque"], reply["fault"]) == (0, False, "")
    assert running.end() == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_daemon_with_torque_off(
    start: Callable[..., Running], profile: Profile, addresses: tuple[str, str], number: int
) -> None:
    running = start("--config", str(profile("")))
    assert softfinger("send", "arm", "--address", addresses[1]).returncode == 0
    assert running.end(number) == 0
    assert any("ended, torque off" in line for line in running.lines)


def test_sigusr1_stops(
    start: Callable[..., Running], profile: Profile, addresses: tuple[str, str]
) -> None:
    running = start("--config", str(profile("")))
    assert softfinger("send", "arm", "--address", addresses[1]).returncode == 0
    running.process.send_signal(signal.SIGUSR1)
    status = softfinger("send", "status", "--address", addresses[1])
    assert json.loads(status.stdout)["mode"] == "disarmed"
    assert running.end() == 0


def test_duration_ends_by_itself(profile: Profile) -> None:
    done = softfinger("run", "--config", str(profile("")), "--duration", "0.3")
    assert done.returncode == 0, done.stderr
    assert "ended, torque off" in done.stderr


def test_settings_from_the_command_line(profile: Profile) -> None:
    path = str(profile(""))
    done = softfinger("run", "--config", path, "--set", "loop.rate=quick", "--set", "tip.radius=9")
    assert done.returncode == 2
    assert done.stderr.startswith('--set: loop.rate: found "quick", expected a number')
    done = softfinger("run", "--config", path, "--set", "loop.rate=100", "--duration", "0.1")
    assert done.returncode == 0


def test_a_second_daemon_says_so_and_ends(
    start: Callable[..., Running], profile: Profile, addresses: tuple[str, str]
) -> None:
    path = str(profile(""))
    running = start("--config", path)
    second = softfinger("run", "--config", path)
    assert second.returncode == 1
    assert f"stream.address: {addresses[0]} is in use; is another softfinger" in second.stderr
    assert running.end() == 0


def test_bad_settings_end_it_with_the_whole_report(profile: Profile) -> None:
    path = profile("[lop]\nrate = 3\n[tip]\nradius = 'big'\n")
    done = softfinger("run", "--config", str(path))
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        f'{path}: tip.radius: found "big", expected a number',
        f"{path}: lop: found an unknown key, expected a known one; nearest: loop",
    ]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (
            '[servos]\nbackend = "dynamixel"\nport = "/dev/absent"\n[tactile]\nbackend = "none"\n',
            "/dev/absent",
        ),
        (
            '[servos]\nbackend = "none"\n[tactile]\nbackend = "flexitac"\nport = ["/dev/no", "x"]',
            "/dev/no",
        ),
    ],
)
def test_a_missing_port_is_named(profile: Profile, text: str, error: str) -> None:
    done = softfinger("run", "--config", str(profile(text)))
    assert done.returncode == 1
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("softfinger: ")][-1:]
    assert error in line
    assert "Traceback" not in done.stderr


def test_send_without_a_daemon_or_with_nonsense(addresses: tuple[str, str]) -> None:
    done = softfinger("send", "arm", "--address", addresses[1], "--timeout", "0.1")
    assert done.returncode == 2
    assert f"send: no answer to arm from {addresses[1]} within 0.1 s" in done.stderr
    assert "is softfinger running, or still starting?" in done.stderr
    done = softfinger("send", "arm", "--address", addresses[1], "--timeout", "1.1")
    assert f"no answer to arm from {addresses[1]} yet, waiting up to 1.1 s" in done.stderr
    done = softfinger("send", "grasp", "force:5", "--address", addresses[1])
    assert done.returncode == 2
    assert "found 'force:5', expected key=number" in done.stderr


def test_garbage_on_the_command_socket_changes_nothing(
    start: Callable[..., Running],
    profile: Profile,
    addresses: tuple[str, str],
    context: zmq.Context[Any],
) -> None:
    running = start("--config", str(profile("")))
    socket = context.socket(zmq.DEALER)
    socket.connect(addresses[1])
    for payload in (b"\xc1" * 10, b"x" * 10_000, b"", msgpack.packb({"command": 3})):
        socket.send_multipart([b"", payload])
        assert socket.poll(5000)
        assert msgpack.unpackb(socket.recv_multipart()[-1])["ok"] is False
    assert softfinger("send", "arm", "--address", addresses[1]).returncode == 0
    assert running.end() == 0


def test_the_readme_subscriber_prints_what_the_daemon_publishes(
    start: Callable[..., Running], profile: Profile, addresses: tuple[str, str]
) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    (subscriber,) = [block for block in blocks if "zmq.SUB" in block]
    assert len(subscriber.strip().splitlines()) == 6
    running = start("--config", str(profile("")))
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", subscriber.replace("tcp://127.0.0.1:9872", addresses[0])],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    with process:
        lines = [process.stdout.readline() for _ in range(3)]
        process.kill()
    assert all(re.fullmatch(r"disarmed: 0\.00 N at 0\.00 mm\n", line) for line in lines)
    assert running.end() == 0


def test_the_readme_mathematics_runs() -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    (mathematics,) = [block for block in blocks if "ContactTable" in block]
    names: dict[str, Any] = {}
    exec(mathematics, names)
    assert names["estimate"].d == pytest.approx(0.004, rel=1e-3)
    assert names["contact"].force > 0.0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_during_start_up_ends_it_without_a_trace(profile: Profile, number: int) -> None:
    process = subprocess.Popen(
        [*SOFTFINGER, "run", "--config", str(profile(""))], stderr=subprocess.PIPE, text=True
    )
    with process:
        assert process.stderr is not None
        first = process.stderr.readline()  # said once the handlers are there, before the kernels
        process.send_signal(number)
        said = first + process.stderr.read()
    assert process.returncode == 0
    assert "Traceback" not in said
    assert "ended" in said.splitlines()[-1]


def test_a_lost_terminal_ends_the_daemon_with_torque_off(
    start: Callable[..., Running], profile: Profile, addresses: tuple[str, str]
) -> None:
    running = start("--config", str(profile("")))
    assert softfinger("send", "arm", "--address", addresses[1]).returncode == 0
    assert running.end(signal.SIGHUP) == 0
    assert any("ended, torque off" in line for line in running.lines)


def test_a_reader_of_the_log_that_stops_reading_stops_nothing(
    profile: Profile, addresses: tuple[str, str]
) -> None:
    process = subprocess.Popen(
        [*SOFTFINGER, "run", "--config", str(profile(""))], stderr=subprocess.PIPE
    )
    with process:
        assert process.stderr is not None
        process.stderr.close()  # from now on each line written to it fails
        until(lambda: softfinger("send", "arm", "--address", addresses[1]).returncode == 0, 60.0)
        status = softfinger("send", "status", "--address", addresses[1])
        assert json.loads(status.stdout)["mode"] == "armed"
        process.terminate()
    assert process.returncode == 0


def test_commands_that_waited_through_a_stall_are_refused_but_stop_stops(
    start: Callable[..., Running],
    profile: Profile,
    addresses: tuple[str, str],
    context: zmq.Context[Any],
) -> None:
    running = start("--config", str(profile("")))
    assert softfinger("send", "arm", "--address", addresses[1]).returncode == 0
    running.process.send_signal(signal.SIGSTOP)
    socket = context.socket(zmq.DEALER)
    socket.connect(addresses[1])
    for request in ({"command": "move", "left": 0.1}, {"command": "stop"}):
        socket.send_multipart([b"", msgpack.packb(request)])
    select.select([], [], [], 0.5)  # the stall itself
    running.process.send_signal(signal.SIGCONT)
    replies = []
    for _ in range(2):
        assert socket.poll(5000)
        replies.append(msgpack.unpackb(socket.recv_multipart()[-1]))
    stop, move = replies  # a stop goes first
    assert not move["ok"]
    assert "send it again" in move["error"]
    assert stop["ok"]
    assert running.end() in (0, 1)


def test_subscribers_that_come_late_stop_reading_or_die_change_nothing(
    start: Callable[..., Running],
    profile: Profile,
    addresses: tuple[str, str],
    context: zmq.Context[Any],
) -> None:
    running = start("--config", str(profile("stream.state_rate = 500.0\n")))
    stuck = context.socket(zmq.SUB)
    stuck.setsockopt(zmq.RCVHWM, 1)
    stuck.setsockopt(zmq.RCVBUF, 4096)
    stuck.subscribe("hand")
    stuck.connect(addresses[0])
    dying = subprocess.Popen(
        [sys.executable, "-c", SUBSCRIBER.format(address=addresses[0])],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert dying.stdout is not None
    assert dying.stdout.readline() == "first\n"
    late = context.socket(zmq.SUB)
    late.subscribe("hand/state")
    late.connect(addresses[0])
    seen = []
    for count in range(1500):
        if count == 500:
            dying.kill()
        assert late.poll(5000)
        seen.append(msgpack.unpackb(late.recv_multipart()[1])["seq"])
    assert seen == list(range(seen[0], seen[0] + len(seen))), "a state was lost or held up"
    dying.wait()
    dying.stdout.close()
    assert softfinger("send", "arm", "--address", addresses[1]).returncode == 0
    assert running.end() == 0


SUBSCRIBER = """
import zmq
socket = zmq.Context.instance().socket(zmq.SUB)
socket.connect("{address}")
socket.subscribe("hand/state")
socket.recv_multipart()
print("first", flush=True)
while True:
    socket.recv_multipart()
"""


def test_an_ipc_address_never_replaces_a_file(tmp_path: Path) -> None:
    file = tmp_path / "precious"
    file.write_text("kept", encoding="utf-8")
    config = tmp_path / "profile.toml"
    config.write_text(f'stream.address = "ipc://{file}"\n', encoding="utf-8")
    done = softfinger("run", "--config", str(config), "--duration", "0.2")
    assert done.returncode == 1
    assert "is there already and is no socket" in done.stderr
    assert file.read_text(encoding="utf-8") == "kept"
