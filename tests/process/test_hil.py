"""Test a daemon and an emulated hand as separate processes, connected by serial lines.

The emulated hand's control socket reports the traffic on the servo bus. The socket also reports
each watchdog trip after the daemon dies, stalls or loses its port.
"""

import json
import select
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from softfinger import Hand
from softfinger.daemon.simulation.emulator.folder import send_words
from tests.conftest import Addresses, until
from tests.harness.daemon_process import Running, ask, softfinger, started
from tests.harness.descendants import ending
from tests.harness.emulated import HIL, EmulatorProcess

WATCHDOG = 2.0  # watchdog time [s], far above the delays of a busy machine
REAL = [
    *("--set", "loop.clock=real"),  # With a shared clock, the hand would wait for a stalled daemon.
    *("--set", f"servos.watchdog={WATCHDOG}", "--set", f"servos.fault_after={WATCHDOG}"),
    *("--set", "servos.reply_timeout=0.1", "--set", "servos.open_timeout=60"),
]
# timeouts on the hand's clock, which hardly advances while the emulator gets no processor time
WAITING = [
    *("--set", "servos.fault_after=1.0", "--set", "safety.frame_age_fault=100"),
    *("--set", "servos.open_timeout=60"),
]


class Rig:
    """An emulated hand, and a daemon that can be restarted."""

    def __init__(self, folder: Path, addresses: Addresses, *words: str) -> None:
        self.folder = folder / "hand"
        self.words = words
        self.commands = addresses[1]
        self.config = folder / "hil.toml"
        head = f'stream.address = "{addresses[0]}"\ncommands.address = "{addresses[1]}"\n'
        self.config.write_text(head + HIL.read_text(encoding="utf-8"), encoding="utf-8")
        clock = REAL[:2] if words[:2] == tuple(REAL[:2]) else ()
        self.hand = EmulatorProcess("--dir", self.folder, "--config", HIL, *clock).ready()
        self.daemon: Running | None = None

    def start(self) -> Running:
        self.daemon = Running("--config", str(self.config), "--dir", str(self.folder), *self.words)
        return self.daemon

    def send(self, name: str, **numbers: float) -> dict[str, Any]:
        return ask(self.commands, name, **numbers)

    def status(self) -> dict[str, Any]:
        return self.send("status")

    def report(self) -> dict[str, Any]:
        return json.loads(send_words(self.folder, "report"))

    def stopped(self) -> bool:
        return all(servo["stopped_by_watchdog"] for servo in self.report()["servos"])

    def does(self, name: str, **numbers: float) -> None:
        reply = self.send(name, **numbers)
        assert reply["ok"], reply

    def at_work(self) -> list[dict[str, Any]]:
        """Arm a disarmed hand and start moving; return the servo report."""
        self.does("arm")
        self.does("move", left=0.3, right=0.3)
        servos: list[dict[str, Any]] = []

        def under_way() -> bool:
            servos[:] = self.report()["servos"]
            return all(each["torque"] and not each["stopped_by_watchdog"] for each in servos)

        until(under_way)
        return servos

    def works(self) -> None:
        """Arm a disarmed hand, move to two positions and disarm."""
        self.does("arm")
        for target in (-0.1, 0.1):
            self.does("move", left=target, right=target)
            until(lambda: self.status()["mode"] != "moving")
            assert self.status()["mode"] == "armed"
            angles = [servo["q"] for servo in self.report()["servos"]]
            assert angles == pytest.approx([target, target], abs=0.05)
        for servo in self.report()["servos"]:
            assert not servo["stopped_by_watchdog"]
            assert servo["torque_on"]["far"] == 0, "torque was switched on far from the goal"
        self.does("disarm")
        until(lambda: not any(servo["torque"] for servo in self.report()["servos"]))

    def clears(self) -> None:
        """Clear the fault once torque off is confirmed."""
        until(lambda: not self.status()["torque"])
        self.does("clear")

    def close(self) -> None:
        if self.daemon is not None:
            self.daemon.kill()
        self.hand.end()


@pytest.fixture
def rig(tmp_path: Path, addresses: Addresses) -> Iterator[Rig]:
    rig = Rig(tmp_path, addresses, *REAL)
    yield rig
    rig.close()


@pytest.mark.waits
def test_a_grasp_over_serial_bytes_with_a_shared_clock(tmp_path, addresses):
    rig = Rig(tmp_path, addresses, *WAITING)
    try:
        daemon = rig.start()
        with Hand(*addresses, timeout=120.0) as hand:
            before = hand.state()
            assert (before.mode, before.torque) == ("disarmed", False)
            send_words(rig.folder, "forget")
            hand.arm()
            hand.grasp(force=10.0)
            hand.wait_for(lambda state: state.mode == "holding", 120.0)
            for process in (daemon.process, rig.hand.popen):
                stood = hand.state().behind_s + 0.4
                process.send_signal(signal.SIGSTOP)
                select.select([], [], [], 0.5)  # Pause for five times the watchdog time.
                process.send_signal(signal.SIGCONT)
                hand.wait_for(lambda state, at=stood: state.behind_s > at, 120.0)
            with hand.stream(120.0) as states:
                held = [next(states) for _ in range(60)]
            assert {(state.mode, state.fault) for state in held} == {("holding", "")}
            # A late frame makes a contact invalid for a short time.
            sound = [state for state in held if state.left.valid and state.right.valid]
            forces = [(state.left.force, state.right.force) for state in sound]
            near = [each == pytest.approx((10.0, 10.0), rel=0.05) for each in forces]
            assert sum(near) > 0.9 * len(near) > 0
            assert sound[-1].object.width == pytest.approx(0.040, abs=1e-3)
            hand.release()
            hand.wait_for(lambda state: state.mode == "armed", 120.0)
            state = hand.state()
            assert (state.left.contact, state.right.contact) == (False, False)
            assert abs(state.left.q) < 0.05
            hand.stop()
            hand.wait_for(lambda state: not state.torque, 120.0)
            assert not any(each["watchdog_fired"]["count"] for each in rig.report()["servos"])
            hand.arm()
            hand.wait_for(lambda state: state.torque, 120.0)
        daemon.kill()  # The hand does not wait for a dead daemon process.
        until(rig.stopped)
    finally:
        rig.close()


def test_start_up_waits_for_servos_that_have_not_responded_yet(tmp_path, addresses):
    rig = Rig(tmp_path, addresses)
    words = ("run", "--config", rig.config, "--dir", rig.folder, "--set")
    try:
        send_words(rig.folder, "silent=2")
        refused = softfinger(*words, "servos.open_timeout=0.1")
        assert refused.returncode == 1
        assert "servo 2 (right): no reply at 2000000 baud" in refused.stderr
        assert refused.stderr.rstrip().endswith("gave up after servos.open_timeout = 0.1 s")
        waiting = started(*words, "servos.open_timeout=60", stdout=None)
        with ending(waiting):
            text = "waiting for up to servos.open_timeout = 60 s"
            assert any(text in line for line in waiting.stderr)
            send_words(rig.folder, "answer=2")
            assert any("running, disarmed" in line for line in waiting.stderr)
            waiting.terminate()
            waiting.stderr.read()
            assert waiting.wait(300) == 0
    finally:
        rig.close()


def stops_in_time(rig: Rig, lose: Callable[[], object]) -> None:
    """Call ``lose``; check that each active servo stops when its watchdog times out."""
    before = rig.at_work()
    lose()
    until(rig.stopped)
    report = rig.report()
    for servo, earlier in zip(report["servos"], before, strict=True):
        fired, heard = servo["watchdog_fired"], report["t"] - servo["quiet"]
        assert fired["count"] == earlier["watchdog_fired"]["count"] + 1
        assert fired["t"] - heard == pytest.approx(WATCHDOG, abs=1e-6)


def test_servos_stop_by_themselves_and_the_hand_works_again(rig):
    # The daemon refuses to start if the board size differs from the profile.
    where = ("--config", str(rig.config), "--dir", str(rig.folder))
    done = softfinger("run", *where, "--set", "tactile.rows=16")
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert "1024" in last
    assert "16" in last
    assert "Traceback" not in done.stderr

    # Kill the daemon, so that nothing is sent to the servos.
    daemon = rig.start()
    stops_in_time(rig, daemon.kill)
    daemon = rig.start()
    status = rig.status()
    assert (status["mode"], status["torque"], status["fault"]) == ("disarmed", False, "")
    assert rig.stopped(), "starting the daemon must not move the servos"
    send_words(rig.folder, "forget")
    rig.works()

    # Suspend the daemon for longer than the watchdog time, then continue it.
    stops_in_time(rig, lambda: daemon.process.send_signal(signal.SIGSTOP))
    daemon.process.send_signal(signal.SIGCONT)
    until(lambda: rig.status()["mode"] == "fault")
    assert rig.status()["fault_name"] in ("servos.bus", "servos.silent")
    rig.clears()
    send_words(rig.folder, "forget")
    rig.works()

    # Unplug the port and plug it in again.
    stops_in_time(rig, lambda: send_words(rig.folder, "unplug"))
    until(lambda: rig.status()["mode"] == "fault")
    assert rig.status()["fault_name"] == "servos.bus"
    assert not rig.send("clear")["ok"], "clear must fail while the port is missing"
    send_words(rig.folder, "plug")
    until((rig.folder / "servos").exists)
    rig.does("clear")
    send_words(rig.folder, "forget")
    rig.works()

    # Close the emulator's end of the line permanently.
    rig.at_work()
    rig.hand.popen.kill()
    until(lambda: rig.status()["mode"] == "fault")
    assert rig.status()["fault_name"] == "servos.bus"
    assert not rig.send("clear")["ok"]
    assert daemon.end() == 1
    assert "exited with a fault" in "".join(daemon.lines)


def test_lost_packets_do_not_keep_torque_on(rig):
    rig.start()

    # The servos do not receive the stop, but readings arrive and keep resetting the servos'
    # watchdogs.
    rig.at_work()
    send_words(rig.folder, "lose-writes=1")
    told = softfinger("send", "stop", "--address", rig.commands)
    assert told.returncode == 3
    assert json.loads(told.stdout)["torque_off"] == "unconfirmed"
    assert "have not yet confirmed that torque is off" in told.stderr
    until(rig.stopped)
    assert rig.status()["torque"], "torque off is not confirmed yet"
    send_words(rig.folder, "lose-writes=0")
    until(lambda: not rig.status()["torque"])
    assert not any(servo["torque"] for servo in rig.report()["servos"])
    rig.clears()

    # The daemon detects lost goals by itself.
    rig.at_work()
    send_words(rig.folder, "lose-writes=1")
    until(lambda: rig.status()["mode"] == "fault")
    assert rig.status()["fault_name"] == "goal.lost"
    until(rig.stopped)
    send_words(rig.folder, "lose-writes=0")
    rig.clears()

    # Lose nine out of ten packets in each direction.
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
    # The mode depends on how soon the servos confirmed that torque is off.
    if rig.status()["mode"] == "fault":
        rig.does("clear")
    rig.works()


@pytest.mark.extended
def test_swapped_ids_are_a_fault_during_the_approach(tmp_path, addresses):
    """Use the zero offsets and directions that `calibrate joints` would find for swapped servos."""
    hand = tmp_path / "hand"
    # A heavy object resists the first tip that touches it. A light object would slide away.
    heavy = ("object_position=[0.006, 0.08]", "object_mass=0.5", "table_friction=0.5")
    words = [word for each in heavy for word in ("--set", f"simulation.{each}")]
    config = tmp_path / "hil.toml"
    head = f'stream.address = "{addresses[0]}"\ncommands.address = "{addresses[1]}"\n'
    config.write_text(head + HIL.read_text(encoding="utf-8"), encoding="utf-8")
    with EmulatorProcess("--dir", hand, "--config", HIL, *words).ready() as emulator:
        swapped = ("--set", "servos.ids=[2, 1]", "--set", "servos.direction=[-1, 1]")
        daemon = Running("--config", str(config), "--dir", str(hand), *swapped, *WAITING)
        for command, numbers in (("arm", {}), ("grasp", {"force": 6.0})):
            reply = ask(addresses[1], command, **numbers)
            assert reply["ok"], reply
        until(lambda: ask(addresses[1], "status")["fault"])
        status = ask(addresses[1], "status")
        assert status["fault_name"] == "joint.swapped"
        assert status["fault"].endswith("check whether the servo IDs are swapped (servos.ids)")
        assert daemon.end() == 1
        emulator.end()
