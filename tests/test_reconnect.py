"""The servos' port goes away under a running daemon and comes back: only on command, torque off."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.assembly import Daemon
from daemon.commands import Refused
from daemon.servos import registers as reg
from daemon.settings import Settings
from daemon.simulation.emulator import Emulator
from tests.conftest import until


class Rig:
    """A daemon on an emulated hand's servos, both in this process."""

    def __init__(self, folder: Path) -> None:
        servos = {
            "backend": "dynamixel",
            "port": str(folder / "servos"),
            "reply_timeout": 0.25,  # the emulator shares this process's interpreter lock
            "fault_after": 0.5,
            "watchdog": 0.0,  # a motor that was left on stays on
        }
        self.settings = Settings.model_validate(
            {"servos": servos, "tactile": {"backend": "none"}, "loop": {"rate": 100.0}}
        )
        self.emulator = Emulator(self.settings, folder)
        ready = threading.Event()
        self._thread = threading.Thread(target=self.emulator.run, args=(ready.set,))
        self._thread.start()
        assert ready.wait(60.0)
        self.events: list[tuple[str, str, str]] = []
        self.daemon = Daemon(
            self.settings, wire=False, on_event=lambda *event: self.events.append(event)
        )
        self.loop = self.daemon.loop

    def torque(self) -> list[int]:
        bus = self.emulator._servos.bus
        return [servo.table.memory[reg.TORQUE_ENABLE] for servo in bus.servos]

    def unplug(self) -> None:
        assert self.emulator.tell("unplug") == "ok"
        until(lambda: self.emulator._servos.fileno() < 0)

    def plug(self) -> None:
        assert self.emulator.tell("plug") == "ok"
        until(Path(self.settings.servos.port).exists)

    def close(self) -> None:
        self.daemon.close()
        self.emulator.stop()
        self._thread.join()
        self.emulator.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.close()


def test_an_unplugged_bus_comes_back_on_command_and_limp(rig: Rig) -> None:
    loop = rig.loop
    loop.advance(0.1)
    loop.command({"command": "arm"})
    loop.advance(0.1)
    assert rig.torque() == [1, 1]
    rig.unplug()
    loop.advance(0.7)
    assert loop.state.mode == "fault"
    assert "the port is gone" in loop.state.fault
    assert rig.torque() == [1, 1]  # nobody could tell them
    with pytest.raises(Refused, match="no such port"):
        loop.command({"command": "clear"})
    rig.plug()
    seq = loop.state.reading.seq
    loop.advance(0.2)
    assert loop.state.mode == "fault"  # not by itself
    assert not loop.state.reading.valid
    answer: dict[str, Any] = loop.command({"command": "clear"})
    assert answer["mode"] == "disarmed"
    assert rig.torque() == [0, 0]
    assert ("info", "servos", "connected anew") in rig.events
    loop.advance(0.2)
    assert loop.state.reading.valid
    assert loop.state.reading.seq > seq
    assert (loop.state.mode, loop.state.fault) == ("disarmed", "")
    loop.command({"command": "arm"})
    loop.advance(0.1)
    assert rig.torque() == [1, 1]


def test_clear_of_another_fault_leaves_the_port_alone(rig: Rig) -> None:
    loop = rig.loop
    loop.advance(0.1)
    loop.command({"command": "arm"})
    loop.advance(0.1)
    assert rig.emulator.tell("overload=1") == "ok"
    loop.advance(0.2)
    assert loop.state.mode == "fault"
    with pytest.raises(Refused, match="hardware error reported by left"):
        loop.command({"command": "clear"})
    assert ("info", "servos", "connected anew") not in rig.events
