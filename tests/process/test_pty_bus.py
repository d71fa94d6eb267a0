"""Test the timing, baud rates, links and connections of the servo bus on a pty."""

import os
import select
import termios
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.simulation.emulator.pty_bus import PASSAGE_TIME, PtyServoBus
from softfinger.daemon.simulation.servo_model import framing
from softfinger.daemon.simulation.servo_model.framing import BROADCAST, frame
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from tests.harness.servos import make_bus

PING = frame(1, framing.PING)
PONG = 14


class Wire:
    """A bus that simulates the line timing, and the client's end of the bus's pseudo-terminal."""

    def __init__(self, bus: ServoBus, baud: int, **options: float) -> None:
        self.t = 1.0
        bus.advance(self.t)
        self.port = PtyServoBus(bus, baud=baud, clock=lambda: self.t, **options)
        self.client = serial.Serial(self.port.path, baud or 57600, timeout=0)

    def send(self, data: bytes) -> None:
        self.client.write(data)
        assert select.select([self.port], [], [], 60)[0]
        self.port.service(self.t)

    def received(self) -> bytes:
        """Return the available bytes, which the pseudo-terminal delivers after a short delay."""
        data = b""
        while select.select([self.client], [], [], 0.05)[0]:
            data += self.client.read(4096)
        return data

    def when(self, seconds: float) -> bytes:
        """Advance the time, and serve every event that is due."""
        end = self.t + seconds
        while (due := self.port.next_event()) <= end:
            self.t = max(due, self.t + 1e-7)
            self.port.service(self.t)
        self.t = end
        self.port.service(end)
        return self.received()

    def close(self) -> None:
        self.client.close()
        self.port.unplug()


@pytest.fixture
def wires() -> Iterator[list[Wire]]:
    made: list[Wire] = []
    yield made
    for wire in made:
        wire.close()


def test_replies_take_wire_time_and_return_delay_one_after_another(wires):
    wires.append(wire := Wire(make_bus(), 57600, spin=0.0))
    write = frame(BROADCAST, framing.WRITE, b"\x41\x00\x01")
    wire.send(write)
    wire.send(PING)
    due = (len(write) + len(PING) + PONG) * 10 / 57600 + 500e-6 - 2 * PASSAGE_TIME
    assert wire.when(due - 1e-5) == b""
    assert len(wire.when(2e-5)) == PONG
    wires.append(wire := Wire(make_bus(), 57600, spin=0.0))
    wire.send(frame(BROADCAST, framing.PING))
    byte = 10 / 57600
    first = (len(PING) + PONG) * byte + 500e-6 - 2 * PASSAGE_TIME
    assert wire.when(first - 1e-5) == b""
    assert len(wire.when(2e-5)) == PONG
    second = PONG * byte + 500e-6  # The servos of a group reply one after another.
    assert wire.when(second - 4e-5) == b""
    assert len(wire.when(6e-5)) == PONG


def test_a_late_reply_is_late_even_without_pacing(wires):
    wires.append(wire := Wire(make_bus(), 0, spin=0.0))
    wire.port.bus.fault("late", 1.0, wire.t)
    wire.send(PING)
    assert wire.when(0.009) == b""
    assert len(wire.when(0.002)) == PONG


def test_only_the_correct_baud_rate_is_answered(wires):
    wires.append(wire := Wire(make_bus(), 57600, spin=0.0))
    for baud, answers in ((1_000_000, 0), (57600, PONG), (4_000_000, 0), (57600, PONG)):
        wire.client.baudrate = baud
        assert wire.port.client_baud() == baud
        wire.send(PING)
        assert len(wire.when(0.02)) == answers
    wires.append(unpaced := Wire(make_bus(), 0, spin=0.0))
    for baud in (9600, 4_000_000):
        unpaced.client.baudrate = baud
        unpaced.send(PING)
        assert len(unpaced.received()) == PONG


def test_a_client_may_reconnect_and_leave_the_terminal_in_cooked_mode(wires):
    wires.append(wire := Wire(make_bus(), 0, spin=0.0))
    wire.client.close()
    for _ in range(3):
        # The terminal must be in raw mode, because a client without pyserial does not set the mode.
        end = os.open(wire.port.path, os.O_RDWR | os.O_NOCTTY)
        assert not termios.tcgetattr(end)[tty.LFLAG] & (termios.ECHO | termios.ICANON)
        os.write(end, PING)
        assert select.select([wire.port], [], [], 60)[0]
        wire.port.service(wire.t)
        assert select.select([end], [], [], 60)[0]
        assert len(os.read(end, 100)) == PONG
        os.close(end)


def test_a_client_that_never_reads_does_not_block_the_bus(wires):
    wires.append(wire := Wire(make_bus(), 0, spin=0.0))
    request = frame(1, framing.READ, b"\x00\x00\x93\x00")
    for _ in range(400):  # far more bytes than a terminal can buffer
        wire.send(request)
    assert wire.port.bus.packets == 400


def test_servos_continue_while_the_terminal_is_replaced(wires):
    wires.append(wire := Wire(make_bus(), 0, spin=0.0))
    wire.port.unplug()
    assert (wire.port.plugged, wire.port.fileno()) == (False, -1)
    wire.port.service(2.0)
    assert wire.port.bus.servos[0].read(reg.REALTIME_TICK, 2, 2.0) == b"\xd0\x07"
    wire.port.plug()
    assert Path(wire.port.path).is_char_device()
