"""Test `run` and `send` in processes, with signals, a second daemon and invalid settings."""

import json
import os
import select
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from softfinger import Hand
from softfinger.daemon.client import command_client
from tests.conftest import until
from tests.harness.daemon_process import ask, softfinger, started


def test_arm_grasp_and_stop_from_the_command_line(daemon, inline):
    def send(*words: str) -> tuple[int, dict[str, Any]]:
        done = inline("send", *words, "--address", daemon.commands, "--timeout", "60")
        return done.returncode, json.loads(done.stdout)

    refused = softfinger(
        "send", "grasp", "force=5", "--address", daemon.commands, "--timeout", "60"
    )
    assert refused.returncode == 1
    reply = json.loads(refused.stdout)
    assert reply["error"] == "grasp: not accepted in mode disarmed; arm first"
    assert reply["reason"] == "mode"
    assert send("arm") == (0, {"ok": True, "mode": "armed"})
    assert send("grasp", "force=5") == (0, {"ok": True, "mode": "grasping"})
    until(lambda: send("status")[1]["mode"] == "holding")
    assert send("rotate", "angle=5deg")[1]["mode"] == "rotating"
    assert send("stop") == (0, {"ok": True, "mode": "disarmed", "torque_off": "confirmed"})
    status, reply = send("status")
    assert (status, reply["torque"], reply["fault"]) == (0, False, "")


def test_sigusr1_stops_the_hand(daemon):
    assert ask(daemon.commands, "arm")["ok"]
    daemon.running.process.send_signal(signal.SIGUSR1)
    until(lambda: ask(daemon.commands, "status")["mode"] == "disarmed")


def test_duration_and_settings_on_the_command_line(profile, inline):
    path = str(profile(""))
    done = inline("run", "--config", path, "--set", "loop.rate=quick", "--set", "tip.radius=9")
    assert done.returncode == 2
    assert sorted(line.partition(": found")[0] for line in done.stderr.splitlines()) == [
        "--set: loop.rate", "--set: tip.radius"
    ]  # fmt: skip
    done = softfinger("run", "--config", path, "--set", "loop.rate=250", "--duration", "0.3")
    assert done.returncode == 0, done.stderr
    assert "simulated, 250 Hz" in done.stderr
    assert "exited; torque is off" in done.stderr


def test_a_second_daemon_reports_the_used_address_and_exits(daemon):
    second = softfinger("run", "--config", str(daemon.profile))
    assert second.returncode == 1
    # Both addresses are in use, and the daemon reports one of them.
    taken = (f"stream.address: {daemon.addresses[0]}", f"commands.address: {daemon.commands}")
    assert any(f"{each} is in use; is another softfinger" in second.stderr for each in taken)


def test_a_missing_serial_port_is_named(profile, inline):
    text = '[servos]\nbackend = "dynamixel"\nport = "/dev/absent"\n[tactile]\nbackend = "none"\n'
    done = inline("run", "--config", profile(text))
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("softfinger: ")
    assert "/dev/absent" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_send_without_a_daemon_or_with_an_invalid_command(addresses, inline):
    done = inline("send", "arm", "--address", addresses[1], "--timeout", "0.1")
    assert done.returncode == 2
    assert f"send: no reply to arm from {addresses[1]} within 0.1 s" in done.stderr
    assert "is softfinger running, or still starting?" in done.stderr
    done = softfinger("send", "arm", "--address", addresses[1], "--timeout", "1.5")
    assert f"no reply to arm from {addresses[1]} yet; waiting up to 1.5 s" in done.stderr
    done = inline("send", "grasp", "force:5", "--address", addresses[1])
    assert done.returncode == 2
    assert "found 'force:5', expected key=number" in done.stderr


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, marks=pytest.mark.extended), signal.SIGTERM]
)
def test_a_signal_during_start_up_exits_without_a_traceback(profile, number):
    process = started("run", "--config", profile(""))
    # The daemon prints the line after installing signal handlers and before compiling kernels.
    first = process.stderr.readline()
    process.send_signal(number)
    said = first + process.communicate(timeout=300)[1]
    assert process.returncode == 0
    assert "Traceback" not in said
    assert "exited during startup" in said.splitlines()[-1]


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGHUP,
        pytest.param(signal.SIGQUIT, marks=pytest.mark.extended),
        pytest.param(signal.SIGALRM, marks=pytest.mark.extended),
    ],
)
def test_fatal_signals_turn_torque_off_first(profile, addresses, number):
    process = started("run", "--config", profile(""))
    assert ask(addresses[1], "arm")["ok"]
    process.send_signal(number)
    said = process.communicate(timeout=300)[1]
    assert process.returncode == 0
    assert "exited; torque is off" in said


@pytest.mark.extended
def test_a_log_reader_that_stops_reading_does_not_block_the_daemon(profile, addresses):
    process = started("run", "--config", profile(""))
    process.stderr.close()  # From now on, every write to stderr fails.
    assert ask(addresses[1], "arm")["ok"]
    assert ask(addresses[1], "status")["mode"] == "armed"
    process.terminate()
    assert process.wait(300) == 0


def stalled(daemon: Any, context: Any, *requests: dict[str, Any]) -> list[dict[str, Any]]:
    """Suspend the daemon for half a second; return its replies to the requests sent meanwhile."""
    socket = context.socket(zmq.DEALER)
    socket.connect(daemon.commands)
    socket.send_multipart([b"", msgpack.packb({"command": "status"})])
    assert socket.poll(60_000)  # The client is connected.
    socket.recv_multipart()
    daemon.running.process.send_signal(signal.SIGSTOP)
    for request in requests:
        socket.send_multipart([b"", msgpack.packb(request)])
    # The gateway itself refuses any message above the size limit.
    socket.send_multipart([b"", b"x" * 5000])
    assert socket.poll(60_000)  # By then, the gateway has also read all earlier requests.
    assert msgpack.unpackb(socket.recv_multipart()[-1])["reason"] == "request"
    select.select([], [], [], 0.5)  # Stall for half a second.
    daemon.running.process.send_signal(signal.SIGCONT)
    replies = []
    for _ in requests:
        assert socket.poll(60_000)
        replies.append(msgpack.unpackb(socket.recv_multipart()[-1]))
    return replies


def test_a_command_received_during_a_stall_is_refused(daemon, context):
    (arm,) = stalled(daemon, context, {"command": "arm"})
    assert (arm["ok"], arm["reason"]) == (False, "late")
    assert ask(daemon.commands, "status")["torque"] is False


def test_a_stop_received_during_a_stall_also_cancels_waiting_commands(daemon, context):
    assert ask(daemon.commands, "arm")["ok"]
    move = {"command": "move", "left": 0.1}
    replies = stalled(daemon, context, move, {"command": "stop"}, move)
    assert sorted(reply.get("reason", "done") for reply in replies) == [
        "done",
        "stopped",
        "stopped",
    ]


def test_a_client_waiting_for_its_reply_is_served_after_a_stall(daemon, caplog, monkeypatch):
    monkeypatch.setattr(command_client, "SILENCE_TIME", 0.5)
    with Hand(*daemon.addresses, timeout=60.0) as hand, ThreadPoolExecutor() as pool:
        hand.status()
        daemon.running.process.send_signal(signal.SIGSTOP)
        arming = pool.submit(hand.arm)
        # This warning means that the command was sent at least half a second ago.
        until(lambda: "no reply to arm" in caplog.text)
        daemon.running.process.send_signal(signal.SIGCONT)
        arming.result(60.0)
        assert hand.status()["torque"] is True


def test_an_ipc_address_never_replaces_a_file(tmp_path, profile, inline):
    file = tmp_path / "precious"
    file.write_text("kept", encoding="utf-8")
    words = ("--set", f"stream.address=ipc://{file}", "--duration", "0.2")
    done = inline("run", "--config", profile(""), *words)
    assert done.returncode == 1
    assert "exists but is not a socket" in done.stderr
    assert file.read_text(encoding="utf-8") == "kept"


@pytest.mark.parametrize("words", [("limits",), ("config", "reference"), ("help", "run")])
def test_characters_that_a_pipe_cannot_encode_are_replaced(words):
    plain, ascii_alone = (
        softfinger(*words, env=os.environ | {"PYTHONIOENCODING": encoding})
        for encoding in ("utf-8", "ascii")
    )
    assert (ascii_alone.returncode, ascii_alone.stderr) == (0, "")
    assert ascii_alone.stdout == plain.stdout.encode("ascii", "replace").decode()


def test_output_to_a_full_disk_is_reported_in_one_line():
    with Path("/dev/full").open("w") as full:
        process = started("config", "list", stdout=full)
    assert process.communicate(timeout=300)[1] == "config: No space left on device\n"
    assert process.returncode == 1


def test_a_disabled_compiler_is_reported_in_one_line():
    done = softfinger("limits", env=os.environ | {"NUMBA_DISABLE_JIT": "1"})
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr == (
        "limits: NUMBA_DISABLE_JIT is set, but the kernels must be compiled; unset this variable\n"
    )
