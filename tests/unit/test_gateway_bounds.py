"""What a client may do to the gateway: each bound, and that others are served meanwhile."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.zmtp import GREETING, Broken, FrameParser, frame
from softfinger.daemon.types import Parts, State
from softfinger.daemon.wire.publisher import bit
from softfinger.daemon.wire.schema import EVENT, STATE
from tests.conftest import until
from tests.harness.gateway import Served
from tests.harness.zmtp_client import RawClient, ready

BOTH = Parts((True, True), servos=True, sensors=True)


def echo(request: dict[str, Any]) -> dict[str, Any]:
    return {"heard": request["command"]}


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def served(addresses: tuple[str, str], clock: VirtualClock) -> Iterator[Served]:
    with Served(*addresses, places=40, now=clock.now) as served:
        yield served


def is_served(served: Served, address: str) -> bool:
    """A client that comes now is answered."""
    client = RawClient(address, b"REQ")
    client.ask(command="status")
    heard: list[dict[str, Any]] = []
    until(lambda: served.serve(echo) or heard.extend(client.replies()) or heard)
    client.close()
    return bool(heard[0]["ok"])


def test_an_answer_that_the_loop_is_long_about_comes_and_holds_up_nobody(
    served: Served, addresses: tuple[str, str], clock: VirtualClock
) -> None:
    clients = [RawClient(addresses[1], b"REQ") for _ in range(2 * bounds.UNDER_WAY)]
    for client in clients:
        client.ask(command="arm")
    until(lambda: served.settle() or len(served.link.asked) == bounds.UNDER_WAY)
    clock.sleep_until(clock.now() + 0.9 * bounds.OLDEST)  # a machine that is busy
    served.settle()
    assert len(served.link.asked) == bounds.UNDER_WAY
    clock.sleep_until(clock.now() + bounds.LATE)
    served.settle()
    assert is_served(served, addresses[1])
    for client in clients:
        heard: list[dict[str, Any]] = []
        until(lambda c=client, h=heard: served.serve(echo) or h.extend(c.replies()) or h)
        assert heard[0].get("heard") == "arm" or "waited too long" in heard[0]["error"]
        client.close()


@pytest.mark.parametrize(
    "sent",
    [
        GREETING[:10] + b"\x01" + GREETING[11:],  # ZMTP 2.0's number
        GREETING.replace(b"NULL", b"PLAI"),
        b"GET / HTTP/1.1\r\n\r\n",
        b"\x01\x00\x01\x01",  # ZMTP/1.0
        GREETING + frame(b"a message before the handshake"),
        GREETING + ready(b"SUB"),  # no socket of commands
        GREETING + ready(b"DEALER") + b"\x01\x01x" * 3,  # parts without end
        GREETING + ready(b"DEALER") + b"\x02" + (1 << 40).to_bytes(8, "big"),  # a frame likewise
        GREETING + ready(b"DEALER") + b"\x02" + (801).to_bytes(8, "big"),
        GREETING + ready(b"DEALER") + b"\x08\x00",
        GREETING + ready(b"DEALER") + (bytes((4, 7)) + b"\x04PING\x00\x0a") * 80,
    ],
)
def test_what_breaks_the_protocol_is_hung_up_on(
    served: Served, addresses: tuple[str, str], sent: bytes
) -> None:
    client = RawClient(addresses[1], b"DEALER", sent)
    until(lambda: served.serve(echo) or client.hung_up())
    assert is_served(served, addresses[1])


@pytest.mark.parametrize(
    "sent",
    [
        frame(b"\x01" + b"x" * 100),  # longer than any topic
        frame(b"\x01hand/state") * 100,  # more than a few dozen
        b"".join(frame(b"\x01%d" % k) for k in range(100)),
        frame(b"\x01hand/state", more=True),
        (bytes((4, 20)) + b"\x09SUBSCRIBEhand/state") * 100,
        (bytes((4, 7)) + b"\x04PING\x00\x0a") * 100,
    ],
)
def test_more_subscriptions_than_anybody_needs_are_hung_up_on(
    served: Served, addresses: tuple[str, str], sent: bytes
) -> None:
    client = RawClient(addresses[0], b"SUB")
    client.send(sent)
    until(lambda: served.serve(echo) or client.hung_up())
    until(lambda: served.settle() or not served.publisher.wanted)


def test_subscriptions_that_change_now_and_then_may_go_on_for_ever(
    served: Served, addresses: tuple[str, str], clock: VirtualClock
) -> None:
    client = RawClient(addresses[0], b"SUB")
    for k in range(300):
        clock.sleep_until(0.1 * k)
        client.send(frame(bytes((k % 2,)) + b"hand/state"))
        served.service.step(0.0)
    until(lambda: served.settle() or served.publisher.wanted == bit(STATE))


def test_a_subscriber_of_zmtp_3_1_subscribes_by_commands(
    served: Served, addresses: tuple[str, str]
) -> None:
    client = RawClient(addresses[0], b"SUB")
    subscribe, cancel = b"\x09SUBSCRIBEhand/event", b"\x06CANCELhand/event"
    client.send(bytes((4, len(subscribe))) + subscribe)
    until(lambda: served.settle() or served.publisher.wanted == bit(EVENT))
    client.send(bytes((4, len(cancel))) + cancel)
    until(lambda: served.settle() or not served.publisher.wanted)


def test_a_ping_is_answered(served: Served, addresses: tuple[str, str]) -> None:
    client = RawClient(addresses[1], b"DEALER")
    until(lambda: served.serve(echo) or client.read())
    client.send(bytes((4, 9)) + b"\x04PING\x00\x0aab")
    got = []
    until(lambda: served.serve(echo) or got.append(client.read()) or b"PONGab" in b"".join(got))


def test_whoever_does_not_shake_hands_leaves_after_a_while_or_when_others_come(
    served: Served, addresses: tuple[str, str], clock: VirtualClock
) -> None:
    silent = [RawClient(addresses[1], b"", b"") for _ in range(40)]
    until(lambda: served.serve(echo) or len(served.service._endpoints[1]._connections) == 40)
    assert is_served(served, addresses[1])
    assert silent[0].hung_up(), "the oldest of them made room"
    assert not silent[-1].hung_up()
    clock.sleep_until(3.0)
    until(lambda: served.serve(echo) or all(each.hung_up() for each in silent))


def test_a_client_finds_a_place_when_all_are_taken(
    served: Served, addresses: tuple[str, str]
) -> None:
    idle = [RawClient(addresses[1], b"DEALER") for _ in range(40)]
    until(lambda: served.serve(echo) or len(served.service._endpoints[1]._connections) == 40)
    idle[0].ask(command="status")  # it was heard of last
    until(lambda: served.serve(echo) or idle[0].replies())
    assert is_served(served, addresses[1])
    assert not idle[0].hung_up()
    assert idle[1].hung_up()


def test_a_reader_that_reads_nothing_does_not_fill_the_memory(
    addresses: tuple[str, str],
) -> None:
    with Served(*addresses, queue=100_000) as served:
        stuck = [RawClient(addresses[0], b"SUB") for _ in range(5)]
        for client in stuck:
            client.send(frame(b"\x01hand/"))
        until(lambda: served.settle() or served.publisher.wanted & bit(STATE))
        stream: Any = served.service._endpoints[0]
        state = State()
        for _ in range(60_000):
            served.publisher.send(STATE, state, BOTH)
            served.service.step(0.0)
            assert stream.backlog <= 33 << 20
        assert any(client.hung_up() for client in stuck), "the slowest leave"


def test_answers_that_are_not_read_end_the_connection(addresses: tuple[str, str]) -> None:
    with Served(commands=addresses[1]) as served:
        client = RawClient(addresses[1], b"DEALER")
        door: Any = served.service._endpoints[0]
        long = {"told": "x" * 20_000}

        def gone() -> bool:
            if door._connections or not door.begun:
                try:
                    client.ask(command="status")
                except OSError:
                    return True
            served.serve(lambda _: long)
            return not door._connections

        until(lambda: served.serve(echo) or door._connections)
        until(gone)


def test_who_comes_after_a_stop_is_heard_while_others_still_wait_to_be_let_in(
    addresses: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A flood of connections never lets the queue of them be seen empty."""
    monkeypatch.setattr("softfinger.daemon.gateway.bounds.ACCEPTED", 1)
    with Served(commands=addresses[1]) as served:
        before = [RawClient(addresses[1], b"DEALER") for _ in range(3)]
        for client in before:
            client.ask(command="arm")
        served.server.begin_epoch()
        served.service.step(0.0)  # the gateway hears of it while some of them wait
        client, *_ = after = [RawClient(addresses[1], b"DEALER") for _ in range(40)]
        client.ask(command="status")
        heard: list[dict[str, Any]] = []
        until(lambda: served.serve(echo) or heard.extend(client.replies()) or heard)
        assert heard[0]["ok"], "it came after the stop"
        refused: list[dict[str, Any]] = []
        for each in before:
            until(lambda each=each: served.serve(echo) or refused.extend(each.replies()) or refused)
            assert not refused.pop()["ok"], "it came before"
        assert len(after) == 40


@given(st.lists(st.binary(max_size=40), max_size=8), st.integers(1, 30))
def test_a_message_arrives_whole_however_it_is_cut(parts: list[bytes], cut: int) -> None:
    wire = GREETING + b"".join(frame(part, more=True) for part in parts) + frame(b"x" * 300)
    parser, found = FrameParser(300), []
    for at in range(0, len(wire), cut):
        found += parser.feed(wire[at : at + cut])
    assert found == [*((False, True, part) for part in parts), (False, False, b"x" * 300)]
    assert parser.empty


@given(st.binary(max_size=300))
def test_any_bytes_are_frames_or_break_the_protocol(data: bytes) -> None:
    for begin in (b"", GREETING):
        parser = FrameParser(100)
        try:
            frames = parser.feed(begin + data)
        except Broken:
            continue
        assert sum(len(body) for *_, body in frames) <= len(data)
