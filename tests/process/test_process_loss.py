"""What the servos do by themselves when the daemon dies, stands still, or loses its port.

Real processes and real bytes: the daemon on the stand-in hand, which tells by its control socket
what was on the servos' wire and when their bus watchdog stopped them.
"""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from softfinger.daemon.simulation.emulator.folder import send_words
from tests.conftest import until
from tests.harness.daemon_process import SOFTFINGER, Running, ask, softfinger

HIL = Path(__file__).parents[2] / "config" / "hil.toml"
WATCHDOG = 1.0  # s, well above what a busy machine holds the daemon up
REAL = ("--set", "loop.clock=real")  # else the hand waits for a daemon that stands still
PATIENT = [
    *REAL,
    *("--set", f"servos.watchdog={WATCHDOG}", "--set", f"servos.fault_after={WATCHDOG}"),
    *("--set", "servos.reply_timeout=0.1"),
]


class Rig:
    """The stand-in hand, and a daemon on it that can be started again."""

    def __init__(self, folder: Path, addresses: tuple[str, str]) -> None:
        self.folder = folder / "hand"
        self.folder.mkdir()
        self.commands = addresses[1]
        self.config = folder / "hil.toml"
        head = f'stream.address = "{addresses[0]}"\ncommands.address = "{addresses[1]}"\n'
        self.config.write_text(head + HIL.read_text(encoding="utf-8"), encoding="utf-8")
        words = [*SOFTFINGER, "emulate", "--dir", str(self.folder), "--config", str(HIL), *REAL]
        self.hand = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        self.daemon: Running | None = None
        assert self.hand.stdout is not None
        assert self.hand.stdout.readline() == "ready\n"

    def start(self) -> Running:
        self.daemon = Running("--config", str(self.config), "--dir", str(self.folder), *PATIENT)
        return self.daemon

    def send(self, name: str, **numbers: float) -> dict[str, Any]:
        return ask(self.commands, name, **numbers)

    def status(self) -> dict[str, Any]:
        return self.send("status")

    def report(self) -> dict[str, Any]:
        report: dict[str, Any] = json.loads(send_words(self.folder, "report"))
        return report

    def stopped(self) -> bool:
        return all(servo["stopped_by_watchdog"] for servo in self.report()["servos"])

    def at_work(self) -> None:
        """Arm, and be under way when this returns. A busy machine may trip it before."""

        def under_way() -> bool:
            if self.status()["mode"] == "fault":
                self.send("clear")
            self.send("arm")
            self.send("move", left=0.3, right=0.3)
            servos = self.report()["servos"]
            return all(each["torque"] and not each["stopped_by_watchdog"] for each in servos)

        until(under_way)

    def works(self) -> None:
        """From disarmed: arm, go somewhere, be there. A busy machine may trip it on the way."""
        until(lambda: self.goes_to(-0.1) and self.goes_to(0.1))
        for servo in self.report()["servos"]:
            assert not servo["stopped_by_watchdog"]
            assert servo["torque_on"]["far"] == 0, "torque went on with a goal elsewhere"
        assert self.send("disarm")["ok"]
        until(lambda: not any(servo["torque"] for servo in self.report()["servos"]))

    def goes_to(self, target: float) -> bool:
        mode = self.status()["mode"]
        if mode == "fault":
            self.send("clear")
        elif mode == "disarmed":
            self.send("arm")
        if not self.send("move", left=target, right=target)["ok"]:
            return False
        while (mode := self.status()["mode"]) == "moving":
            pass
        angles = [servo["q"] for servo in self.report()["servos"]]
        return mode == "armed" and angles == pytest.approx([target, target], abs=0.05)

    def cleared(self) -> bool:
        reply = self.send("clear")
        return bool(reply["ok"] or "not while disarmed" in reply["error"])

    def close(self) -> None:
        if self.daemon is not None:
            self.daemon.kill()
        self.hand.terminate()
        self.hand.wait(timeout=300)
        assert self.hand.stdout is not None
        self.hand.stdout.close()


@pytest.fixture
def rig(tmp_path: Path, addresses: tuple[str, str]) -> Iterator[Rig]:
    rig = Rig(tmp_path, addresses)
    yield rig
    rig.close()


def stops_in_time(rig: Rig, lose: Callable[[], object]) -> None:
    """Each servo stops once the watchdog's time has passed since the last packet it heard."""
    before = rig.report()["servos"]
    lose()
    until(rig.stopped)
    report = rig.report()
    for servo, earlier in zip(report["servos"], before, strict=True):
        fired, heard = servo["watchdog_fired"], report["t"] - servo["quiet"]
        assert fired["count"] == earlier["watchdog_fired"]["count"] + 1
        assert fired["t"] - heard == pytest.approx(WATCHDOG, abs=1e-6)


def test_servos_stop_by_themselves_and_the_hand_works_again(rig: Rig) -> None:
    # Boards of another size than the profile's are no start.
    where = ("--config", str(rig.config), "--dir", str(rig.folder))
    done = softfinger("run", *where, "--set", "tactile.rows=16")
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert "1024" in last
    assert "16" in last
    assert "Traceback" not in done.stderr

    # Killed: nothing is left that could say anything to the servos.
    daemon = rig.start()
    rig.at_work()
    stops_in_time(rig, daemon.kill)
    daemon = rig.start()
    status = rig.status()
    assert (status["mode"], status["torque"], status["fault"]) == ("disarmed", False, "")
    assert rig.stopped(), "starting touches nothing"
    send_words(rig.folder, "forget")
    rig.works()

    # Stopped for longer than the watchdog allows, then continued.
    rig.at_work()
    stops_in_time(rig, lambda: daemon.process.send_signal(signal.SIGSTOP))
    daemon.process.send_signal(signal.SIGCONT)
    until(lambda: rig.status()["mode"] == "fault")
    assert rig.status()["fault_name"] in ("servos.bus", "servos.silent")
    until(rig.cleared)
    send_words(rig.folder, "forget")
    rig.works()

    # Unplugged, and plugged in again.
    rig.at_work()
    stops_in_time(rig, lambda: send_words(rig.folder, "unplug"))
    until(lambda: rig.status()["mode"] == "fault")
    assert rig.status()["fault_name"] == "servos.bus"
    assert not rig.send("clear")["ok"], "nothing is there to be cleared"
    send_words(rig.folder, "plug")
    until(rig.cleared)
    send_words(rig.folder, "forget")
    rig.works()

    # The other end of the line is gone for good.
    assert rig.send("arm")["ok"]
    rig.hand.kill()
    until(lambda: rig.status()["mode"] == "fault")
    assert rig.status()["fault_name"] == "servos.bus"
    assert not rig.send("clear")["ok"]
    assert daemon.end() == 1
    assert "ended with a fault" in "".join(daemon.lines)


def test_a_command_sent_while_the_daemon_stands_still_is_not_carried_out(
    rig: Rig, context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    daemon = rig.start()
    client = context.socket(zmq.REQ)
    client.connect(rig.commands)

    def told(name: str) -> Any:
        client.send(msgpack.packb({"command": name}))
        return msgpack.unpackb(client.recv())

    for _ in range(8):
        assert not told("status")["torque"]
        stood_still = rig.report()["t"] + 0.5
        daemon.process.send_signal(signal.SIGSTOP)
        client.send(msgpack.packb({"command": "arm"}))
        until(lambda at=stood_still: rig.report()["t"] > at)
        daemon.process.send_signal(signal.SIGCONT)
        assert "stood still" in msgpack.unpackb(client.recv())["error"]
    until(lambda: told("arm")["ok"])


def test_what_gets_lost_on_the_line_does_not_keep_torque_on(rig: Rig) -> None:
    rig.start()

    # A stop of which no write arrives, though readings do, and feed the servos' watchdogs.
    rig.at_work()
    send_words(rig.folder, "lose-writes=1")
    told = softfinger("send", "stop", "--address", rig.commands)
    assert told.returncode == 3
    assert json.loads(told.stdout)["torque_off"] == "unconfirmed"
    assert "have not confirmed torque off" in told.stderr
    until(rig.stopped)
    assert rig.status()["torque"], "they are stopped, and it is not confirmed to be off"
    send_words(rig.folder, "lose-writes=0")
    until(lambda: not rig.status()["torque"])
    assert not any(servo["torque"] for servo in rig.report()["servos"])
    until(rig.cleared)

    # Goals that no longer arrive are noticed by themselves. A busy machine may trip the hand first.
    def goals_are_missed() -> bool:
        rig.at_work()
        send_words(rig.folder, "lose-writes=1")
        until(lambda: rig.status()["mode"] == "fault")
        told = rig.status()["fault_name"]
        until(rig.stopped)
        send_words(rig.folder, "lose-writes=0")
        until(rig.cleared)
        return bool(told == "goal.lost")

    until(goals_are_missed)

    # Nine packets in ten, both ways.
    rig.at_work()
    send_words(rig.folder, "lose=0.9 drop=0.9")
    rig.send("stop")
    until(
        lambda: (
            not any(s["torque"] and not s["stopped_by_watchdog"] for s in rig.report()["servos"])
        )
    )
    send_words(rig.folder, "well")
    until(lambda: not rig.status()["torque"])
    until(lambda: rig.status()["mode"] == "disarmed" or rig.cleared())
    rig.works()
