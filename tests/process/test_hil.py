"""Hardware in the loop: the daemon's process on the stand-in hand's, over real serial bytes."""

from __future__ import annotations

import json
import select
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import pytest
import zmq

from softfinger.daemon.simulation.emulator.folder import send_words
from tests.conftest import own_addresses, until
from tests.harness.daemon_process import PATIENT, SOFTFINGER, Running, ask, softfinger

HIL = Path(__file__).parents[2] / "config" / "hil.toml"


class Emulated:
    """A stand-in hand in a process of its own, ready when constructed."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder = folder
        words = ("emulate", "--dir", str(folder), "--config", str(HIL))
        self.process = subprocess.Popen([*SOFTFINGER, *words], stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"

    def end(self) -> None:
        self.process.terminate()
        self.process.wait(timeout=300)
        assert self.process.stdout is not None
        self.process.stdout.close()


def profile(path: Path) -> tuple[Path, tuple[str, str]]:
    """config/hil.toml at ``path``, on addresses of its own."""
    stream, commands = addresses = own_addresses()
    head = f'stream.address = "{stream}"\ncommands.address = "{commands}"\n'
    path.write_text(head + HIL.read_text(encoding="utf-8"), encoding="utf-8")
    return path, addresses


class Pair(NamedTuple):
    """A stand-in hand and a daemon on it, for several tests."""

    folder: Path
    stream: str
    commands: str


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    place = tmp_path_factory.mktemp("pair")
    hand = Emulated(place / "hand")
    config, addresses = profile(place / "hil.toml")
    # It sits out a busy machine's stalls.
    daemon = Running("--config", str(config), "--dir", str(hand.folder), *PATIENT)
    yield Pair(hand.folder, *addresses)
    try:
        status, said = daemon.end(signal.SIGINT), "".join(daemon.lines)
        assert status == ("ended with a fault" in said), said  # a busy machine may trip it
    finally:
        daemon.kill()
        hand.end()


class Stream:
    """The state stream of a running daemon."""

    def __init__(self, context: zmq.Context[Any], address: str) -> None:
        self._socket = context.socket(zmq.SUB)
        self._socket.subscribe("hand/state")
        self._socket.connect(address)

    def next(self) -> dict[str, Any]:
        assert self._socket.poll(60_000), "no state for 60 s"
        state: dict[str, Any] = msgpack.unpackb(self._socket.recv_multipart()[1])
        return state

    def newest(self) -> dict[str, Any]:
        state = self.next()
        while self._socket.poll(0):
            state = self.next()
        return state


def near(state: dict[str, Any], force: float) -> bool:
    return all(abs(state[f]["force"] - force) <= 0.05 * force for f in ("left", "right"))


def held_on(pair: Pair, stream: Stream, count: int) -> list[dict[str, Any]]:
    """So many states in a row of a hand that holds with 10 N.

    One that a busy machine made let go, as it must, is told to take hold again.
    """
    held: list[dict[str, Any]] = []
    next_step = {"fault": "clear", "disarmed": "arm", "armed": "grasp"}

    def look() -> bool:
        state = stream.next()
        if state["mode"] == "holding" and (held or near(state, 10.0)):
            held.append(state)
        else:
            held.clear()
            if command := next_step.get(state["mode"]):
                force = {"force": 10.0} if command == "grasp" else {}
                reply = ask(pair.commands, command, **force)
                print(state["mode"], state["fault"], command, reply)  # shown if it fails
        return len(held) == count

    until(look, 500.0)
    return held


def test_arm_grasp_10_n_hold_release_and_stop_over_bytes(
    pair: Pair, context: zmq.Context[Any]
) -> None:
    stream = Stream(context, pair.stream)
    before = stream.next()
    assert (before["mode"], before["torque"]) == ("disarmed", False)
    held = held_on(pair, stream, 60)
    # A busy machine may keep a reading or a frame from being fresh for a moment.
    sound = [state for state in held if state["left"]["valid"] and state["right"]["valid"]]
    assert sum(near(state, 10.0) for state in sound) > 0.9 * len(sound) > 0
    assert sound[-1]["object"]["width"] == pytest.approx(0.040, abs=1e-3)
    assert ask(pair.commands, "release")["ok"]
    until(lambda: stream.newest()["mode"] == "armed")
    state = stream.newest()
    assert not state["left"]["contact"]
    assert not state["right"]["contact"]
    assert abs(state["left"]["q"]) < 0.05
    assert ask(pair.commands, "stop")["ok"]
    until(lambda: not stream.newest()["torque"])


@pytest.mark.waits
def test_daemon_and_emulated_hand_wait_for_each_other(
    tmp_path: Path, context: zmq.Context[Any]
) -> None:
    hand = Emulated(tmp_path / "hand")
    config, (stream_address, commands) = profile(tmp_path / "hil.toml")
    daemon = Running("--config", str(config), "--dir", str(hand.folder))
    try:
        stream = Stream(context, stream_address)
        assert ask(commands, "arm")["ok"]
        assert ask(commands, "grasp", force=8.0)["ok"]
        # Older states of an armed hand may still be in the queue.
        until(lambda: (mode := stream.next()["mode"]) == "holding" or mode == "fault")
        for process in (daemon.process, hand.process):
            stood = stream.newest()["behind_s"] + 0.4
            process.send_signal(signal.SIGSTOP)
            select.select([], [], [], 0.5)  # five times what the servos' watchdog allows
            process.send_signal(signal.SIGCONT)
            until(lambda at=stood: stream.next()["behind_s"] > at)
        state = stream.newest()
        assert (state["mode"], state["fault"]) == ("holding", "")
        report = json.loads(send_words(hand.folder, "report"))
        assert not any(servo["watchdog_fired"]["count"] for servo in report["servos"])
        # A daemon that is gone is waited for no longer.
        daemon.kill()
        until(lambda: stopped(hand.folder))
    finally:
        daemon.kill()
        hand.end()


def stopped(folder: Path) -> bool:
    """Whether the servos' watchdogs have stopped them."""
    servos = json.loads(send_words(folder, "report"))["servos"]
    return all(servo["stopped_by_watchdog"] for servo in servos)


def test_a_second_daemon_on_the_same_ports_says_so_before_torque_is_on(
    pair: Pair, tmp_path: Path
) -> None:
    config, _ = profile(tmp_path / "other.toml")
    second = softfinger("run", "--config", str(config), "--dir", str(pair.folder))
    assert second.returncode == 1
    assert f"{pair.folder}/servos" in second.stderr.splitlines()[-1]
    assert "Traceback" not in second.stderr
    ask(pair.commands, "disarm")
    reply = ask(pair.commands, "arm")
    assert reply["ok"], f"the first one must live on: {reply}"
    assert ask(pair.commands, "disarm")["ok"]


def test_the_daemon_lives_through_a_torn_tactile_stream(pair: Pair) -> None:
    def counters() -> dict[str, int]:
        told: dict[str, int] = ask(pair.commands, "status")["counters"]["tactile-left"]
        return told

    before = counters()["frames"]
    assert send_words(pair.folder, "left:torn") == "ok"
    until(lambda: counters()["resyncs"] > 2 and counters()["frames"] > before + 20)
    assert send_words(pair.folder, "left:well") == "ok"
