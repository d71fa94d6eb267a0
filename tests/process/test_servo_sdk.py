"""Test the SDK on emulated servos, with the packet handlers of the SDK and of softfinger."""

from collections.abc import Iterator

import dynamixel_sdk as sdk
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.protocol import (
    FastGroupRead,
    GroupRead,
    PacketHandler,
    SerialPort,
    ServoLine,
)
from tests.harness.servos import RunningBus

OK = sdk.COMM_SUCCESS
Line = tuple[SerialPort, PacketHandler]


@pytest.fixture
def line(bus: RunningBus) -> Iterator[Line]:
    port = SerialPort(bus.port, 2_000_000, 1.0)  # The bus shares this process's interpreter lock.
    port.openPort()
    yield port, PacketHandler()
    port.closePort()


@hypothesis_settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    data=st.lists(st.sampled_from([0xFF, 0xFD, 0x12, 0x00]), min_size=1, max_size=28).map(bytes),
    kind=st.sampled_from([GroupRead, FastGroupRead]),
)
def test_arbitrary_bytes_are_transferred_unchanged(bus, line, data, kind):
    port, handler = line
    start = 224  # Indirect data registers that refer to themselves behave like memory.
    assert handler.writeTxRx(port, 1, start, len(data), list(data)) == (OK, 0)
    assert bus.memory(0)[start : start + len(data)] == data
    assert handler.readTxRx(port, 1, start, len(data)) == (list(data), OK, 0)
    group = kind(ServoLine(port, handler), start, len(data), [1])
    assert group.exchange() == OK
    assert group.data[1] == data


def test_other_sdk_calls_work_with_our_handler(line):
    port, handler = line
    assert handler.ping(port, 1) == (1020, OK, 0)
    assert handler.write4ByteTxRx(port, 1, reg.PROFILE_VELOCITY, 77) == (OK, 0)
    assert handler.read4ByteTxRx(port, 1, reg.PROFILE_VELOCITY) == (77, OK, 0)
    assert handler.write1ByteTxOnly(port, 2, reg.LED, 1) == OK
    # The servo replies to the write; this reply must not count as the reply to the next request.
    assert handler.read1ByteTxRx(port, 2, reg.LED) == (1, OK, 0)
    bulk = sdk.GroupBulkRead(port, handler)
    bulk.addParam(1, reg.PRESENT_POSITION, 4)
    bulk.addParam(2, reg.PRESENT_TEMPERATURE, 1)
    for exchange in ("txRxPacket", "fastBulkRead"):
        assert getattr(bulk, exchange, lambda: OK)() == OK  # SDK version 3.7 has no fast reads.
        assert bulk.getData(1, reg.PRESENT_POSITION, 4) == 2048
        assert bulk.getData(2, reg.PRESENT_TEMPERATURE, 1) == 25
    assert handler.reboot(port, 1) == (OK, 0)


def test_the_unmodified_sdk_works(bus):
    port = sdk.PortHandler(bus.port)
    handler = sdk.PacketHandler(2.0)
    assert port.openPort()
    assert port.setBaudRate(1_000_000)  # The call closes and reopens the pty.
    # A busy machine may exceed the SDK's timeout of 35 ms.
    port.setPacketTimeout = lambda _: port.setPacketTimeoutMillis(60_000)
    assert handler.ping(port, 2) == (1020, OK, 0)
    read = sdk.GroupSyncRead(port, handler, reg.PRESENT_POSITION, 4)
    for servo in (1, 2):
        assert read.addParam(servo)
    for exchange in (read.txRxPacket, getattr(read, "fastSyncRead", read.txRxPacket)):
        assert exchange() == OK
        assert [read.getData(servo, reg.PRESENT_POSITION, 4) for servo in (1, 2)] == [2048, 2048]
    assert handler.broadcastPing(port) == ({1: [1020, 48], 2: [1020, 48]}, OK)
    assert handler.regWriteTxRx(port, 1, reg.LED, 1, [1]) == (OK, 0)
    assert handler.read1ByteTxRx(port, 1, reg.LED) == (0, OK, 0)
    assert handler.action(port, sdk.BROADCAST_ID) == OK
    assert handler.read1ByteTxRx(port, 1, reg.LED) == (1, OK, 0)
    assert handler.clearMultiTurn(port, 1) == (OK, 0)
    write = sdk.GroupBulkWrite(port, handler)
    assert write.addParam(1, reg.LED, 1, [0])
    assert write.addParam(2, reg.PROFILE_VELOCITY, 4, [7, 0, 0, 0])
    assert write.txPacket() == OK
    assert handler.read1ByteTxRx(port, 1, reg.LED) == (0, OK, 0)
    assert handler.read4ByteTxRx(port, 2, reg.PROFILE_VELOCITY) == (7, OK, 0)
    port.closePort()


def test_error_bytes_of_a_group_read_are_kept(bus, line):
    bus.fault("overload=1")
    for kind in (GroupRead, FastGroupRead):
        group = kind(ServoLine(*line), reg.PRESENT_POSITION, 4, [1, 2])
        assert group.exchange() == OK
        assert group.errors == {1: 0x80, 2: 0}
        # The addresses are beyond the end of the control table.
        assert kind(ServoLine(*line), 660, 4, [1, 2]).exchange() != OK


def test_noise_before_a_reply_is_skipped_and_counted():
    class Script(SerialPort):
        def __init__(self, data: bytes) -> None:
            super().__init__("script", 2_000_000, 0.01)
            self.received += data

        def fill(self) -> bool:
            return False

    status = bytes.fromhex("FFFFFD00010800 55 00 A6000000 8CC0")
    echo = bytes.fromhex("FFFFFD00010700 02 84000400 1D15")
    for noise in (b"\x00\xff", b"\xff\xff\xfd", echo, b"\xff\xff\xfd\x00\x01\xff\xff\x55"):
        handler = PacketHandler()
        assert handler.rxPacket(Script(noise + status), False) == (status, OK)
        assert handler.counters["skipped_bytes"] == len(noise)
    handler = PacketHandler()
    assert handler.rxPacket(Script(status[:-3]), False)[1] == sdk.COMM_RX_CORRUPT
    assert handler.rxPacket(Script(b""), False)[1] == sdk.COMM_RX_TIMEOUT
    assert (handler.counters["torn"], handler.counters["timeouts"]) == (1, 1)
