"""Test how commands and faults switch torque, also if servos ignore writes."""

import math

import msgpack
import pytest
import zmq

from softfinger.daemon.errors import ServoError
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.types import Reading
from tests.conftest import until
from tests.harness.gateway import Served
from tests.harness.loop import advance_to, armed, command, grasped, heard, refusal, torque_of
from tests.harness.safety import bounded


def test_a_non_finite_goal_is_a_fault_even_after_a_refused_command(make):
    daemon = armed(make())
    daemon.loop.state.goal.q[0] = math.nan
    bounded(daemon.loop._safety, daemon.loop.state)
    assert "a goal that is not a finite number" in refusal(daemon, "grasp")
    daemon.loop.advance(daemon.loop.period)
    assert daemon.loop.state.fault_name == "goal.number"
    command(daemon, "clear")


def test_joints_are_held_at_their_positions_once_torque_is_on(make):
    """Move a joint while the daemon switches torque on."""
    daemon = make()
    daemon.loop.advance(daemon.loop.period)
    command(daemon, "arm")
    daemon.loop.advance(daemon.loop.period)
    daemon.hand.q[0] += 0.01
    for _ in range(10):
        daemon.loop.advance(daemon.loop.period)
        assert daemon.loop.state.goal.q == pytest.approx(list(daemon.hand.q), abs=2e-3)


def test_unconfirmed_torque_off_is_repeated_until_the_bus_is_silenced(make):
    """Lose all writes; successful reads keep the servos' watchdogs from tripping."""
    daemon = make()
    events = heard(daemon)
    armed(daemon)
    lost = Deaf(daemon)
    assert command(daemon, "stop")["torque_off"] == "unconfirmed"
    assert daemon.loop.state.torque
    daemon.loop.advance(0.17)
    assert not torque_of(daemon).any(), (
        "torque must be off after 1.5 times the watchdog time plus 20 ms"
    )
    assert daemon.loop.state.fault_name == "torque.off"
    assert daemon.loop.state.torque, "torque off is not confirmed yet"
    assert "clear: the servos have not yet confirmed that torque is off" in refusal(daemon, "clear")
    daemon.loop.advance(1.0)
    lost.mend()
    daemon.loop.advance(0.2)
    assert not daemon.loop.state.torque
    told = [text for _, kind, text in events if kind == "torque.off"]
    assert len(told) == 2, "must be reported once at the beginning and once at the end"
    assert "keeps the bus silent" in told[0]
    assert "that torque is off" in told[1]
    command(daemon, "clear")
    assert command(daemon, "stop")["torque_off"] == "confirmed"


def test_without_a_watchdog_the_bus_is_not_silenced(make):
    daemon = armed(make(servos={"watchdog": 0.0}))
    lost = Deaf(daemon)
    command(daemon, "stop")
    daemon.loop.advance(0.3)
    assert "switch off their supply" in daemon.loop.state.fault
    assert lost.tries > 140, "torque off must be requested on every tick"
    lost.mend()
    daemon.loop.advance(2 * daemon.loop.period)
    assert not torque_of(daemon).any()


def test_torque_off_is_tried_repeatedly_at_exit(make):
    daemon = armed(make())
    lost = Deaf(daemon, tries=5)
    daemon.loop.run(0.0)
    assert lost.tries == 6
    assert not torque_of(daemon).any()
    assert not daemon.loop.state.torque


class Deaf:
    """Servos that reply but ignore writes, for ``tries`` attempts or until they are repaired."""

    def __init__(self, daemon: Daemon, tries: float = math.inf) -> None:
        self._servos = daemon.loop.torque.servos
        self._really = self._servos.torque_off
        self._most = tries
        self.tries = 0
        self._servos.torque_off = self._try
        self._servos.write = lambda goal: None

    def _try(self, reading: Reading) -> bool:
        self.tries += 1
        if self.tries > self._most:
            return self._really(reading)
        self._servos.read(reading)
        return False

    def mend(self) -> None:
        self._most = 0


def test_failed_arming_is_a_fault_with_torque_off(make):
    daemon = make()
    servos = daemon.loop.torque.servos
    really = servos.torque_on

    def failing() -> None:
        really()
        raise ServoError("overload")

    servos.torque_on = failing
    command(daemon, "arm")
    daemon.loop.advance(daemon.loop.period)
    assert (daemon.loop.state.mode, daemon.loop.state.fault) == ("fault", "overload")
    assert not daemon.loop.state.torque
    assert not torque_of(daemon).any()


def test_a_stall_that_trips_the_servo_watchdog_is_a_fault(make):
    daemon = grasped(make(), 6.0)
    daemon.clock.sleep_until(daemon.clock.now() + 0.5)  # Simulate a suspended process.
    advance_to(daemon, "fault", 0.1)
    assert "watchdog" in daemon.loop.state.fault
    daemon.loop.advance(0.2)
    command(daemon, "clear")
    command(daemon, "arm")
    command(daemon, "move", left=-0.1, right=-0.1)
    advance_to(daemon, "armed", 3.0)
    assert daemon.hand.q.tolist() == pytest.approx([-0.1, -0.1], abs=0.04)


def test_stop_and_disarm_always_turn_torque_off(make):
    daemon = make()
    for name, more in (("stop", {}), ("disarm", {}), ("stop", {"client": 5, "why": "smoke"})):
        daemon.loop.torque.servos.torque_on()  # Another program switches torque on.
        assert command(daemon, name, **more)["torque_off"] == "confirmed"
        daemon.loop.advance(daemon.loop.period)
        assert not torque_of(daemon).any()
        assert not daemon.loop.state.torque


def test_a_stop_by_signal_precedes_waiting_commands_and_prevents_them_from_arming(
    make, context, addresses
):
    daemon = make()
    with Served(commands=addresses[1]) as served:
        daemon.loop._server = served.server
        client = context.socket(zmq.DEALER)
        client.connect(addresses[1])
        for _ in range(20):
            client.send(msgpack.packb({"command": "arm"}))
        queue = served.service.commands
        served.settle_until(lambda: len(served.link.asked) + queue.count == 20)
        daemon.loop.stop()
        told = []

        def tick() -> int:
            daemon.loop.advance(daemon.loop.period)
            assert daemon.loop.state.mode == "disarmed"
            served.settle()
            while client.poll(0):
                told.append(msgpack.unpackb(client.recv()))
            return len(told)

        until(lambda: tick() == 20)
        assert all("before the last stop" in reply["error"] for reply in told)
        client.send(msgpack.packb({"command": "arm"}))
        served.settle_until(lambda: served.link.asked)
        daemon.loop.advance(daemon.loop.period)
        assert daemon.loop.state.mode == "armed"


def test_arm_waits_until_torque_off_is_confirmed(make):
    daemon = armed(make())
    Deaf(daemon, tries=3)
    command(daemon, "stop")
    assert "arm: the servos have not yet confirmed that torque is off" in refusal(daemon, "arm")
    daemon.loop.advance(3 * daemon.loop.period)
    command(daemon, "arm")
