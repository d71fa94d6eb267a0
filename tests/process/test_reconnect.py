"""Test that only a command reopens a lost servo port, and that torque is then off."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from tests.conftest import until
from tests.harness.emulated import emulated


class Rig:
    """A daemon and its emulated servos, which run in the test process."""

    def __init__(self, folder: Path, **sections: Any) -> None:
        servos = {
            "backend": "dynamixel",
            "port": str(folder / "servos"),
            "reply_timeout": 1.0,  # The emulator shares this process's interpreter lock.
            "fault_after": 3.0,
            "watchdog": 0.0,  # Without a watchdog, a servo keeps its torque on.
        }
        own = {"servos": servos, "tactile": {"backend": "none"}, "loop": {"rate": 100.0}}
        self.settings = Settings.model_validate(own | sections)
        self._stack = contextlib.ExitStack()
        self.emulator = self._stack.enter_context(emulated(folder, settings=self.settings))
        self.events: list[tuple[str, str, str]] = []
        self.daemon = Daemon(
            self.settings, wire=False, on_event=lambda *event: self.events.append(event)
        )
        self.loop = self.daemon.loop

    def until(self, condition: Callable[[], object]) -> None:
        """Tick until ``condition`` is true."""
        until(lambda: self.loop.advance(0.1) or condition())

    def does(self, name: str) -> dict[str, Any]:
        """Wait for a valid reading, except for ``clear``; then send a command that must succeed."""
        if name != "clear":
            self.until(lambda: self.loop.state.reading.valid)
        return self.loop.command({"command": name})

    def refuses(self, name: str, reason: str) -> None:
        with pytest.raises(Refused, match=reason):
            self.loop.command({"command": name})

    def torque(self) -> list[int]:
        bus = self.emulator._servos.bus
        return [servo.table.memory[reg.TORQUE_ENABLE] for servo in bus.servos]

    def unplug(self) -> None:
        assert self.emulator.request("unplug") == "ok"
        until(lambda: not self.emulator._servos.plugged)

    def plug(self) -> None:
        assert self.emulator.request("plug") == "ok"
        until(Path(self.settings.servos.port).exists)

    def close(self) -> None:
        self.daemon.close()
        self._stack.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.close()


@pytest.mark.waits
def test_an_unplugged_bus_is_reopened_on_command_with_torque_off(rig):
    loop = rig.loop
    rig.does("arm")
    rig.until(lambda: rig.torque() == [1, 1])
    rig.unplug()
    rig.until(lambda: loop.state.mode == "fault")
    assert "the port is lost" in loop.state.fault
    assert rig.torque() == [1, 1]  # The daemon could not switch torque off.
    # After the lost port's timeout, `clear` tries to reopen the port.
    rig.until(lambda: loop.state.t - loop.state.reading.t > rig.settings.servos.fault_after)
    rig.refuses("clear", "port not found")
    rig.plug()
    seq = loop.state.reading.seq
    loop.advance(0.2)
    assert loop.state.mode == "fault"  # The daemon does not clear the fault automatically.
    assert not loop.state.reading.valid
    assert rig.does("clear")["mode"] == "disarmed"
    assert rig.torque() == [0, 0]
    assert ("info", "servos", "reconnected") in rig.events
    rig.until(lambda: loop.state.reading.valid)
    assert loop.state.reading.seq > seq
    assert (loop.state.mode, loop.state.fault) == ("disarmed", "")
    rig.does("arm")
    rig.until(lambda: rig.torque() == [1, 1])


@pytest.mark.waits
@pytest.mark.parametrize(
    ("fault", "responds", "mended", "refusal"),
    [("silent=2", 0, "answer=2", "no reply"), ("overload=1", 1, "reboot=1", "hardware error")],
)
def test_torque_goes_off_although_the_servos_fail_the_checks_after_a_lost_port(
    rig, fault, responds, mended, refusal
):
    loop = rig.loop
    rig.does("arm")
    rig.until(lambda: rig.torque() == [1, 1])
    rig.unplug()
    rig.until(lambda: loop.state.mode == "fault")
    rig.until(lambda: loop.state.t - loop.state.reading.t > rig.settings.servos.fault_after)
    assert rig.emulator.request(fault) == "ok"
    rig.plug()
    assert rig.torque()[1] == 1
    rig.refuses("clear", refusal)
    rig.until(lambda: rig.torque()[responds] == 0)
    # The daemon repeats the request until every servo has confirmed it.
    assert rig.emulator.request(mended) == "ok"
    rig.until(lambda: rig.torque() == [0, 0] and not loop.state.torque)
    rig.until(lambda: loop.state.t - loop.state.reading.t > rig.settings.servos.fault_after)
    assert rig.does("clear")["mode"] == "disarmed"


def test_clearing_another_fault_does_not_reopen_the_port(rig):
    rig.does("arm")
    assert rig.emulator.request("overload=1") == "ok"
    rig.until(lambda: rig.loop.state.mode == "fault")
    rig.refuses("clear", "hardware error reported by left")
    assert ("info", "servos", "reconnected") not in rig.events


def test_a_board_port_is_reopened_on_clear_and_on_arm(tmp_path):
    board = {
        "backend": "flexitac",
        "port": (str(tmp_path / "tactile-left"), str(tmp_path / "tactile-right")),
        "rows": 8,
        "cols": 8,
        "pitch": 0.00725,
        "pascal_per_count": 500.0,
        "full_count": 255,
        "rate": 50.0,
    }
    # The emulator shares this process's interpreter lock, so frames may be late. The hand does not
    # close until tactile data arrive.
    rig = Rig(tmp_path, tactile=board, safety={"frame_age_hold": 3.0, "frame_age_fault": 40.0})
    try:
        loop, left = rig.loop, rig.loop.perception.fingers[0].sensor
        rig.does("arm")
        rig.does("grasp")
        assert rig.emulator.request("left:unplug") == "ok"
        until(lambda: left.counters()["port_lost"] == 1)
        rig.until(lambda: loop.state.mode == "fault")
        assert loop.state.fault_name == "tactile.silent"
        for _ in range(2):  # A failed attempt can be repeated.
            rig.refuses("clear", "port not found")
        assert rig.emulator.request("left:plug") == "ok"
        until(Path(rig.settings.tactile.port[0]).exists)
        assert rig.does("clear")["mode"] == "disarmed"
        assert ("info", "tactile", "the left sensor was reopened") in rig.events
        seq = loop.state.contacts[0].seq
        rig.until(lambda: loop.state.contacts[0].seq > seq and loop.state.contacts[0].valid)

        # Without a grip, the loss is not a fault, so there is nothing to clear.
        assert rig.emulator.request("left:unplug") == "ok"
        until(lambda: left.counters()["port_lost"] == 1)
        rig.does("arm")
        assert rig.events[-1][:2] != ("info", "tactile")
        assert any("port not found" in text for level, _, text in rig.events if level == "warning")
        rig.until(lambda: loop.state.t - loop.state.contacts[0].t_valid > 0.9)
        rig.refuses("grasp", "the port is lost; send `clear`, or `disarm` and `arm`, to reopen it")
        rig.does("disarm")
        assert rig.emulator.request("left:plug") == "ok"
        until(Path(rig.settings.tactile.port[0]).exists)
        rig.does("arm")
        rig.does("grasp")
        rig.until(lambda: loop.state.mode == "grasping")
    finally:
        rig.close()
