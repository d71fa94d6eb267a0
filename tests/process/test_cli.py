"""The command line, as real processes: run, send, signals, a second daemon, bad settings."""

from __future__ import annotations

import json
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import pytest
import zmq

from tests.conftest import Inline, own_addresses, until
from tests.harness.daemon_process import SOFTFINGER, Running, ask, softfinger

Profile = Callable[[str], Path]


class Shared(NamedTuple):
    """A daemon of several tests, each of which leaves it disarmed."""

    running: Running
    profile: Path
    stream: str
    commands: str


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    stream, commands = own_addresses()
    path = tmp_path_factory.mktemp("shared") / "profile.toml"
    text = f'stream.address = "{stream}"\ncommands.address = "{commands}"\n'
    path.write_text(text + "loop.rate = 100.0\n", encoding="utf-8")
    running = Running("--config", str(path))
    yield Shared(running, path, stream, commands)
    running.kill()


@pytest.fixture
def hand(shared: Shared) -> Iterator[Shared]:
    """The shared daemon, disarmed and without a fault before a test and after it."""
    yield shared
    assert ask(shared.commands, "stop")["ok"]
    ask(shared.commands, "clear")  # refused where there is no fault
    assert ask(shared.commands, "status")["mode"] == "disarmed"


def test_arm_grasp_and_stop_from_the_command_line(hand: Shared, inline: Inline) -> None:
    def send(*words: str) -> tuple[int, dict[str, Any]]:
        while True:
            done = inline("send", *words, "--address", hand.commands, "--timeout", "60")
            if "send it again" not in done.stdout:
                return done.returncode, json.loads(done.stdout)

    refused = softfinger("send", "grasp", "force=5", "--address", hand.commands, "--timeout", "60")
    assert refused.returncode == 1
    assert json.loads(refused.stdout)["error"].startswith(("grasp: not while disarmed", "came "))
    assert send("arm") == (0, {"ok": True, "mode": "armed"})
    assert send("grasp", "force=5") == (0, {"ok": True, "mode": "grasping"})
    until(lambda: send("status")[1]["mode"] == "holding")
    assert send("rotate", "angle=5deg")[1]["mode"] == "rotating"
    assert send("stop") == (0, {"ok": True, "mode": "disarmed", "torque_off": "confirmed"})
    status, reply = send("status")
    assert (status, reply["torque"], reply["fault"]) == (0, False, "")


def test_a_lost_terminal_ends_the_daemon_with_torque_off(
    start: Callable[..., Running], profile: Profile, addresses: tuple[str, str]
) -> None:
    running = start("--config", str(profile("")))
    assert ask(addresses[1], "arm")["ok"]
    assert running.end(signal.SIGHUP) == 0
    assert any("ended, torque off" in line for line in running.lines)


def test_sigusr1_stops(hand: Shared) -> None:
    assert ask(hand.commands, "arm")["ok"]
    hand.running.process.send_signal(signal.SIGUSR1)
    until(lambda: ask(hand.commands, "status")["mode"] == "disarmed")


def test_duration_ends_by_itself_and_settings_come_from_the_command_line(
    profile: Profile, inline: Inline
) -> None:
    path = str(profile(""))
    done = inline("run", "--config", path, "--set", "loop.rate=quick", "--set", "tip.radius=9")
    assert done.returncode == 2
    assert '--set: loop.rate: found "quick", expected a valid number' in done.stderr
    done = softfinger("run", "--config", path, "--set", "loop.rate=100", "--duration", "0.3")
    assert done.returncode == 0, done.stderr
    assert "simulated, 100 Hz" in done.stderr
    assert "ended, torque off" in done.stderr


def test_a_second_daemon_says_so_and_ends(hand: Shared) -> None:
    second = softfinger("run", "--config", str(hand.profile))
    assert second.returncode == 1
    # Both are; which is found first depends on what starts beside what.
    taken = (f"stream.address: {hand.stream}", f"commands.address: {hand.commands}")
    assert any(f"{each} is in use; is another softfinger" in second.stderr for each in taken)


def test_bad_settings_end_it_with_the_whole_report(profile: Profile, inline: Inline) -> None:
    path = profile("[lop]\nrate = 3\n[tip]\nradius = 'big'\n")
    done = inline("run", "--config", path)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        f'{path}: tip.radius: found "big", expected a valid number',
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
def test_a_missing_port_is_named(profile: Profile, inline: Inline, text: str, error: str) -> None:
    done = inline("run", "--config", profile(text))
    assert done.returncode == 1
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("softfinger: ")][-1:]
    assert error in line
    assert "Traceback" not in done.stderr


def test_send_without_a_daemon_or_with_nonsense(addresses: tuple[str, str], inline: Inline) -> None:
    done = inline("send", "arm", "--address", addresses[1], "--timeout", "0.1")
    assert done.returncode == 2
    assert f"send: no answer to arm from {addresses[1]} within 0.1 s" in done.stderr
    assert "is softfinger running, or still starting?" in done.stderr
    done = softfinger("send", "arm", "--address", addresses[1], "--timeout", "3")
    assert f"no answer to arm from {addresses[1]} yet, waiting up to 3 s" in done.stderr
    done = inline("send", "grasp", "force:5", "--address", addresses[1])
    assert done.returncode == 2
    assert "found 'force:5', expected key=number" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_start_up_ends_it_without_a_trace(profile: Profile, number: int) -> None:
    process = subprocess.Popen(
        [*SOFTFINGER, "run", "--config", str(profile(""))], stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    first = process.stderr.readline()  # said once the handlers are there, before the kernels
    process.send_signal(number)
    said = first + process.communicate(timeout=300)[1]
    assert process.returncode == 0
    assert "Traceback" not in said
    assert "ended" in said.splitlines()[-1]


@pytest.mark.parametrize("number", [signal.SIGQUIT, signal.SIGUSR2, signal.SIGALRM])
def test_signals_that_would_end_a_process_at_once_turn_torque_off_first(
    profile: Profile, addresses: tuple[str, str], number: int
) -> None:
    process = subprocess.Popen(
        [*SOFTFINGER, "run", "--config", str(profile(""))], stderr=subprocess.PIPE, text=True
    )
    assert ask(addresses[1], "arm")["ok"]
    process.send_signal(number)
    said = process.communicate(timeout=300)[1]
    assert process.returncode == 0
    assert "ended, torque off" in said


def test_a_reader_of_the_log_that_stops_reading_stops_nothing(
    profile: Profile, addresses: tuple[str, str]
) -> None:
    process = subprocess.Popen(
        [*SOFTFINGER, "run", "--config", str(profile(""))], stderr=subprocess.PIPE
    )
    assert process.stderr is not None
    process.stderr.close()  # from now on each line written to it fails
    assert ask(addresses[1], "arm")["ok"]
    assert ask(addresses[1], "status")["mode"] == "armed"
    process.terminate()
    assert process.wait(300) == 0


def test_commands_that_waited_through_a_stall_are_refused_but_stop_stops(
    hand: Shared, context: zmq.Context[Any]
) -> None:
    assert ask(hand.commands, "arm")["ok"]
    socket = context.socket(zmq.DEALER)
    socket.connect(hand.commands)
    socket.send_multipart([b"", msgpack.packb({"command": "status"})])
    assert socket.poll(60_000)  # it is connected
    socket.recv_multipart()
    hand.running.process.send_signal(signal.SIGSTOP)
    for request in ({"command": "move", "left": 0.1}, {"command": "stop"}):
        socket.send_multipart([b"", msgpack.packb(request)])
    select.select([], [], [], 0.5)  # the stall itself
    hand.running.process.send_signal(signal.SIGCONT)
    replies = []
    for _ in range(2):
        assert socket.poll(60_000)
        replies.append(msgpack.unpackb(socket.recv_multipart()[-1]))
    stop, move = replies  # a stop goes first
    assert not move["ok"]
    assert "send it again" in move["error"]
    assert stop["ok"]


def test_subscribers_that_come_late_stop_reading_or_die_change_nothing(
    hand: Shared, context: zmq.Context[Any]
) -> None:
    stuck = context.socket(zmq.SUB)
    stuck.setsockopt(zmq.RCVHWM, 1)
    stuck.setsockopt(zmq.RCVBUF, 4096)
    stuck.subscribe("hand")
    stuck.connect(hand.stream)
    dying = subprocess.Popen(
        [sys.executable, "-c", SUBSCRIBER.format(address=hand.stream)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert dying.stdout is not None
    assert dying.stdout.readline() == "first\n"
    late = context.socket(zmq.SUB)
    late.subscribe("hand/state")
    late.connect(hand.stream)
    seen = []
    for count in range(200):
        if count == 80:
            dying.kill()
        assert late.poll(60_000)
        seen.append(msgpack.unpackb(late.recv_multipart()[1])["seq"])
    assert seen == list(range(seen[0], seen[0] + len(seen))), "a state was lost or held up"
    dying.communicate()
    assert ask(hand.commands, "arm")["ok"]


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


def test_an_ipc_address_never_replaces_a_file(
    tmp_path: Path, profile: Profile, inline: Inline
) -> None:
    file = tmp_path / "precious"
    file.write_text("kept", encoding="utf-8")
    words = ("--set", f"stream.address=ipc://{file}", "--duration", "0.2")
    done = inline("run", "--config", profile(""), *words)
    assert done.returncode == 1
    assert "is there already and is no socket" in done.stderr
    assert file.read_text(encoding="utf-8") == "kept"
