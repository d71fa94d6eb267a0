"""Test the publisher with stuck, late and invalid subscribers on a real socket."""

import json
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from softfinger.daemon.types import Contact, Frame, HandInfo, SceneParts, SensorInfo, State
from softfinger.daemon.wire.publisher import bit
from softfinger.daemon.wire.schema import COMMAND, EVENT, STATE, TACTILE
from tests.conftest import until
from tests.harness.gateway import Served
from tests.harness.golden_wire import message_maker

state_message = message_maker(STATE)

BOTH = SceneParts((True, True), has_servos=True, has_sensors=False)


def subscribe(context: zmq.Context[Any], address: str, topic: bytes = b"") -> zmq.Socket[Any]:
    socket = context.socket(zmq.SUB)
    socket.setsockopt(zmq.SUBSCRIBE, topic)
    socket.connect(address)
    return socket


def receive(socket: zmq.Socket[Any], served: Served | None = None) -> tuple[bytes, dict[str, Any]]:
    if served is not None:
        served.settle_until(lambda: socket.poll(0))
    assert socket.poll(60_000)
    topic, payload = socket.recv_multipart()
    return topic, msgpack.unpackb(payload)


def wanted(served: Served, topic: bytes = STATE) -> bool:
    served.settle()
    return bool(served.publisher.wanted & bit(topic))


@pytest.fixture
def served(addresses: tuple[str, str]) -> Iterator[Served]:
    with Served(addresses[0]) as served:
        yield served


def test_frame_age_counts_from_the_sample():
    state = State(t=3.0, contacts=[Contact(seq=4, t=2.96), Contact()])
    message = state_message(state, BOTH)
    assert message["left"]["frame_age_s"] == pytest.approx(0.04)
    assert message["right"]["frame_age_s"] == 0.0


def test_tactile_data_is_little_endian_uint16_row_major(context, addresses, served):
    publisher = served.publisher
    socket = subscribe(context, addresses[0], b"hand/tactile")
    until(lambda: wanted(served, TACTILE))
    assert not publisher.wanted & bit(STATE)
    data = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000
    facts = SensorInfo(0.002, 0.003, 1e-4, -2e-4, 0.1, "count", 4.0, False, "A17 2026-01-02")
    publisher.send(TACTILE, Frame(7, 1.0, 1.25, True, data), data, 1, facts, 99.0)
    topic, message = receive(socket, served)
    assert topic == b"hand/tactile"
    assert np.array_equal(np.frombuffer(message.pop("data"), "<u2").reshape(3, 4), data)
    assert (message["seq"], message["mono_ns"], message["delay_s"]) == (7, 1_000_000_000, 0.25)
    assert (message["finger"], message["rows"], message["cols"]) == ("right", 3, 4)


def test_topics_without_subscribers_are_not_wanted(context, addresses, served):
    publisher = served.publisher
    served.settle()
    assert not publisher.wanted & bit(STATE)
    socket = subscribe(context, addresses[0], b"hand")
    until(lambda: wanted(served))
    assert publisher.wanted & bit(TACTILE)
    socket.close()
    until(lambda: not wanted(served))


def test_invalid_subscriptions_do_not_affect_others(context, addresses, served):
    listener = subscribe(context, addresses[0])
    until(lambda: wanted(served))
    other = context.socket(zmq.XSUB)
    other.connect(addresses[0])
    for message in (b"", b"\x05", b"\x05hand/state", b"\x01hand/nothing", b"\x01hand/event"):
        other.send(message)
    served.publisher.event(1.0, 1.0, "info", "test", "all has come")
    served.settle_until(lambda: other.poll(0))
    listener.close()
    until(lambda: not wanted(served))
    assert wanted(served, EVENT), "the other subscription must remain"
    other.close()
    until(lambda: not wanted(served, EVENT))


def test_a_stuck_subscriber_blocks_no_others_and_its_queue_is_bounded(context, addresses):
    with Served(addresses[0], queue=50) as served:
        publisher = served.publisher
        stuck = context.socket(zmq.SUB)
        stuck.setsockopt(zmq.RCVHWM, 10)
        stuck.setsockopt(zmq.RCVBUF, 4096)
        stuck.setsockopt(zmq.SUBSCRIBE, b"")
        reading = subscribe(context, addresses[0], b"hand/state")
        until(lambda: wanted(served))
        stuck.connect(addresses[0])
        until(lambda: wanted(served, TACTILE))  # Only the stuck one has subscribed to this topic.
        state = State()
        for seq in range(10_000):
            state.seq = seq
            publisher.send(STATE, state, BOTH)
            # The call must return, even though one subscriber is stuck.
            served.service.step(0.0)
            assert receive(reading)[1]["seq"] == seq
        kept: list[bytes] = []

        def drained() -> bool:
            publisher.event(1.0, 1.0, "info", "test", "follows all states")
            served.settle()
            while stuck.poll(0):
                kept.append(receive(stuck)[0])
            return EVENT in kept

        until(drained)
        assert 0 < kept.count(STATE) < 10_000, "the stuck subscriber's queue is unbounded"


def test_a_subscriber_of_only_the_latest_state_gets_it_in_one_frame(
    context, addresses, tmp_path_factory
):
    latest = f"ipc://{tmp_path_factory.mktemp('s')}/latest"
    with Served(addresses[0], latest=latest) as served:
        both = subscribe(context, addresses[0])
        newest = context.socket(zmq.SUB)
        newest.setsockopt(zmq.CONFLATE, 1)
        newest.subscribe(b"")
        newest.connect(latest)
        state, found = State(), dict[str, Any]()

        def publish() -> None:
            state.seq += 1
            served.publisher.send(STATE, state, BOTH)

        def came() -> int | None:
            served.settle()
            if newest.poll(0):
                found.update(msgpack.unpackb(newest.recv()))
            return found.get("seq")

        until(lambda: publish() or came())
        for _ in range(50):
            served.publisher.event(0.0, 0.0, "info", "test", "goes out on the other address alone")
        publish()
        until(lambda: came() == state.seq)
        told = dict[bytes, Any]()

        def heard() -> bool:
            publish()
            served.settle()
            while both.poll(0):
                told.update([receive(both)])
            return told.keys() >= {STATE, EVENT}

        until(heard)
        assert told.keys() == {STATE, EVENT}
        assert found.keys() <= told[STATE].keys(), "state maps must be complete"


def test_late_subscribers_receive_settings_and_events_again(context, addresses, served):
    publisher = served.publisher
    publisher.settings(98.0, 0.5, HandInfo("0.1.0", "{}", "", "", "{}", "{}"))
    for k in range(60):
        publisher.event(99.0 + k, 1.0 + k, "info", "mode", f"event {k + 1}")
    served.settle()  # Deliver the events before the subscription.
    early = subscribe(context, addresses[0])
    told: list[tuple[bytes, dict[str, Any]]] = []

    def tick(socket: zmq.Socket[Any]) -> int:
        served.settle()
        while socket.poll(0):
            told.append(receive(socket))
        return len(told)

    until(lambda: tick(early) == 51)
    assert told[0][0] == b"hand/settings"
    assert told[0][1]["version"] == "0.1.0"
    assert [message["seq"] for _, message in told[1:]] == list(range(11, 61))
    assert all(message["again"] for _, message in told)
    last = told[-1][1]  # The message keeps its original times.
    assert (last["timestamp"], last["mono_ns"]) == (158.0, 60_000_000_000)
    assert (last["level"], last["kind"], last["text"]) == ("info", "mode", "event 60")
    told.clear()
    publisher.event(200.0, 100.0, "info", "mode", "new")
    until(lambda: tick(early) == 1)
    assert not told[0][1]["again"]
    # When another client subscribes to a single topic, only that topic is resent.
    told.clear()
    late = subscribe(context, addresses[0], b"hand/event")
    until(lambda: tick(late) == 50)
    assert {topic for topic, _ in told} == {b"hand/event"}


def test_a_long_message_is_sent_in_pieces_and_received_whole(context, addresses, served):
    facts = HandInfo("0.1.0", "x" * 150_000, "", "", "{}", "{}")
    grid = np.arange(256 * 256, dtype=np.uint16).reshape(256, 256)
    sensor = SensorInfo(0.002, 0.003, 0.0, 0.0, 0.0, "count", 4.0, False, "")
    served.publisher.settings(98.0, 0.5, facts)
    served.settle()  # Send the message before anyone subscribes.
    socket = subscribe(context, addresses[0])
    assert receive(socket, served)[1]["settings"] == facts.settings
    served.publisher.send(TACTILE, Frame(7, 1.0, 1.25, True, grid), grid, 1, sensor, 99.0)
    assert receive(socket, served)[1]["data"] == grid.tobytes()


def test_commands_are_published_only_to_subscribers(context, addresses, served):
    publisher = served.publisher
    # Without subscribers, a command is neither sent nor counted.
    publisher.command(99.0, 1.0, 500, {"command": "arm"}, "")
    socket = subscribe(context, addresses[0], b"hand/command")
    until(lambda: wanted(served, COMMAND))
    publisher.command(99.0, 1.0, 501, {"command": "grasp", "force": 5.0, "client": "me"}, "no")
    topic, message = receive(socket, served)
    assert topic == b"hand/command"
    assert (message["seq"], message["tick"], message["client"]) == (1, 501, "me")
    assert (message["ok"], message["error"]) == (False, "no")
    assert json.loads(message["request"]) == {"command": "grasp", "force": 5.0, "client": "me"}
