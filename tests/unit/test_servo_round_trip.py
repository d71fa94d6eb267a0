"""Compare instructions sent through packet handler and bus with direct access to servo tables."""

import dynamixel_sdk as sdk
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.protocol import FastGroupRead, GroupRead, PacketHandler, ServoLine
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from tests.harness.servos import RADIAN, DirectPort, make_bus

ADDRESSES = st.one_of(
    st.sampled_from([7, 11, 64, 65, 98, 100, 102, 104, 108, 116, 126, 132, 168, 224, 578, 634]),
    st.integers(0, 663),
    st.integers(640, 663),  # Some of the reads extend beyond the end of the control table.
)
# FF and FD are frequent, because they require stuffing. Small numbers are frequent, because most
# registers accept them.
DATA = st.one_of(
    st.lists(st.sampled_from([0xFF, 0xFD, 0, 1, 5, 100]), min_size=1, max_size=20).map(bytes),
    st.binary(min_size=1, max_size=20),
)
STEPS = st.one_of(
    st.tuples(st.just("write"), st.sampled_from([1, 2]), ADDRESSES, DATA),
    st.tuples(st.just("sync write"), st.just(0), ADDRESSES, DATA),
    st.tuples(st.just("bulk write"), st.just(0), ADDRESSES, DATA),
    st.tuples(st.just("read"), st.sampled_from([1, 2]), ADDRESSES, st.integers(1, 30)),
    st.tuples(st.just("sync read"), st.just(0), ADDRESSES, st.integers(1, 30)),
    st.tuples(st.just("fast sync read"), st.just(0), ADDRESSES, st.integers(1, 30)),
    st.tuples(st.just("bulk read"), st.just(0), ADDRESSES, st.integers(1, 30)),
    st.tuples(st.just("fast bulk read"), st.just(0), ADDRESSES, st.integers(1, 30)),
)


def placed(angles: tuple[float, float]) -> ServoBus:
    # `out_of_reach` excludes writes after which a servo might not reply.
    return make_bus("XM430-W210", for_daemon=True, counts=[angle / RADIAN for angle in angles])


def out_of_reach(address: int, data: bytes) -> bool:
    """Return True if a write could change which servos reply; the test excludes such a write."""
    span = range(address, address + len(data))
    kept = (reg.ID, reg.BAUD_RATE, reg.STATUS_RETURN_LEVEL)
    # Indirect data at 168 and above could refer to the registers in ``kept``.
    return any(a in span for a in kept) or address >= 168


@given(
    st.lists(STEPS, min_size=1, max_size=12),
    st.tuples(st.floats(-9, 9), st.floats(-9, 9)),
)
def test_any_instruction_equals_direct_access(steps, angles):
    port, twin = DirectPort(placed(angles)), placed(angles)
    handler = PacketHandler()
    servos = {servo.id: servo for servo in twin.servos}
    for number, (kind, servo_id, address, what) in enumerate(steps):
        port.t = t = 0.003 * (number + 1)
        port.bus.advance(t)
        twin.advance(t)
        if isinstance(what, bytes):
            if out_of_reach(address, what):
                continue
            if kind == "write":
                result, error = handler.writeTxRx(port, servo_id, address, len(what), list(what))
                error &= 0x7F  # Ignore bit 7, which reports hardware errors.
                assert (result, error) == (
                    sdk.COMM_SUCCESS,
                    servos[servo_id].write(address, what, t),
                )
            else:
                if kind == "sync write":
                    group = sdk.GroupSyncWrite(port, handler, address, len(what))
                    for each in servos:
                        group.addParam(each, what)
                else:
                    group = sdk.GroupBulkWrite(port, handler)
                    for each in servos:
                        group.addParam(each, address, len(what), list(what))
                assert group.txPacket() == sdk.COMM_SUCCESS
                for servo in servos.values():
                    servo.write(address, what, t)
        elif kind == "read":
            data, result, error = handler.readTxRx(port, servo_id, address, what)
            expected = servos[servo_id].read(address, what, t)
            assert result == sdk.COMM_SUCCESS
            error &= 0x7F
            assert (bytes(data), error) == ((bytes(what), 7) if expected is None else (expected, 0))
        else:
            expect = {each: servos[each].read(address, what, t) for each in servos}
            if "bulk" in kind:
                bulk = sdk.GroupBulkRead(port, handler)
                for each in servos:
                    bulk.addParam(each, address, what)
                # SDK version 3.7 has no fast bulk read.
                name = "fastBulkRead" if "fast" in kind else "txRxPacket"
                result = getattr(bulk, name, bulk.txRxPacket)()
                got = {each: bytes(bulk.data_dict[each][0]) for each in servos}
            else:
                make = FastGroupRead if "fast" in kind else GroupRead
                group_read = make(ServoLine(port, handler), address, what, list(servos))
                result = group_read.exchange()
                got = group_read.data
            if None not in expect.values():
                assert result == sdk.COMM_SUCCESS
                assert got == expect
            elif "sync read" in kind:
                assert result != sdk.COMM_SUCCESS
    for mine, other in zip(port.bus.servos, twin.servos, strict=True):
        assert mine.table.memory == other.table.memory
    assert np.array_equal(port.bus.plant.q, twin.plant.q)
