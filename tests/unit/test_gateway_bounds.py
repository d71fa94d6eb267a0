"""Test the limits that protect the gateway's clients from each other."""

from collections.abc import Iterator

import msgpack
import pytest
import zmq
from zmq.utils.monitor import recv_monitor_message

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.gateway import bounds
from softfinger.daemon.wire.loop_link import Channel, Link, pair
from softfinger.daemon.wire.publisher import bit
from softfinger.daemon.wire.schema import EVENT, STATE
from tests.conftest import until
from tests.harness.gateway import Served
from tests.unit.test_commands import Asking, echo

Context = zmq.Context[zmq.Socket[bytes]]


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def served(addresses: tuple[str, str], clock: VirtualClock) -> Iterator[Served]:
    with Served(*addresses, clock=clock) as served:
        yield served


def connect(context: Context, kind: int, address: str) -> zmq.Socket[bytes]:
    socket = context.socket(kind)
    socket.connect(address)
    return socket


def is_served(served: Served, context: Context, address: str) -> bool:
    """Return True if a new client gets a reply."""
    return bool(Asking(context, served, address, "status").told()["ok"])


def test_few_requests_are_passed_to_the_loop_at_a_time_and_all_are_answered(
    served, context, addresses, clock
):
    clients = [
        Asking(context, served, addresses[1], "arm") for _ in range(2 * bounds.UNANSWERED_MAX)
    ]
    served.settle_until(lambda: served.service.commands.count == bounds.UNANSWERED_MAX)
    clock.sleep_until(clock.now() + 2.0)  # The delay simulates a busy machine.
    served.settle()
    assert len(served.link.asked) == bounds.UNANSWERED_MAX
    assert is_served(served, context, addresses[1])
    told = [client.told() for client in clients]
    assert [reply.get("heard") for reply in told] == ["arm"] * len(clients)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        # a frame that is longer than four requests and than any handshake message
        (zmq.DEALER, b"x" * (bounds.SUBSCRIPTION_SIZE_MAX + 1)),
        # a subscription that is longer than any topic
        (zmq.XSUB, b"\x01" + b"x" * bounds.SUBSCRIPTION_SIZE_MAX),
    ],
)
def test_a_client_that_sends_an_oversized_message_is_disconnected(
    served, context, addresses, kind, message
):
    client = context.socket(kind)
    monitor = client.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED)
    client.connect(addresses[kind == zmq.DEALER])
    events: list[int] = []

    def happens(event: int) -> bool:
        served.serve(echo)
        while monitor.poll(0):
            events.append(recv_monitor_message(monitor)["event"])
        return event in events

    until(lambda: happens(zmq.EVENT_HANDSHAKE_SUCCEEDED))
    client.send(message)
    until(lambda: happens(zmq.EVENT_DISCONNECTED))
    assert is_served(served, context, addresses[1])


def test_unknown_topics_are_not_stored(served, context, addresses):
    subscriber = connect(context, zmq.SUB, addresses[0])
    for k in range(500):
        subscriber.subscribe(f"hand/{k}")
    subscriber.subscribe(EVENT)
    served.settle_until(lambda: served.publisher.wanted == bit(EVENT))
    assert served.service.stream._prefixes == {EVENT}


def test_frequent_resubscriptions_do_not_repeat_all_messages_each_time(
    served, context, addresses, clock
):
    """Every subscriber receives each repetition, so repetitions must be limited."""
    served.publisher.event(0.0, 0.0, "info", "test", "told again")
    # Send the event before the first subscription, so that the reader receives it only as a
    # repetition.
    served.settle()
    reader = connect(context, zmq.SUB, addresses[0])
    reader.subscribe(EVENT)
    served.settle_until(lambda: reader.poll(0))
    reader.recv_multipart()
    for _ in range(20):
        other = connect(context, zmq.SUB, addresses[0])
        other.subscribe(STATE)
        served.settle_until(lambda: served.publisher.wanted & bit(STATE))
        other.subscribe(EVENT)
        other.unsubscribe(STATE)
        served.settle_until(lambda: not served.publisher.wanted & bit(STATE))
        other.close()
    assert not reader.poll(0)
    clock.sleep_until(clock.now() + 2.0 * bounds.REPEAT_INTERVAL)
    served.settle_until(lambda: reader.poll(0))
    reader.recv_multipart()
    assert not reader.poll(50)


def test_unread_replies_are_dropped(served, context, addresses, clock):
    """Unread replies cannot block the gateway or fill the memory, because the queue is limited."""
    client = context.socket(zmq.DEALER)
    client.setsockopt(zmq.RCVHWM, 1)
    client.setsockopt(zmq.RCVBUF, 4096)
    client.connect(addresses[1])
    status = msgpack.packb({"command": "status"})
    long, answered, read = {"told": "x" * 20_000}, list[object](), list[bytes]()

    def all_answered() -> bool:
        for _ in range(20):
            client.send(status)
            clock.sleep_until(clock.now() + 2.0 / bounds.TOTAL_RATE)
            served.serve(lambda *_: answered.append(None) or long)
        return len(answered) >= 2000

    def all_read() -> bool:
        """Ask once more: if the reply is not dropped, it follows all kept replies."""
        client.send(status)
        served.serve(lambda *_: {"told": "last"})
        while client.poll(0):
            read.append(client.recv())
        return bool(read) and msgpack.unpackb(read[-1]).get("told") == "last"

    until(all_answered)
    assert is_served(served, context, addresses[1])
    until(all_read)
    kept = sum(len(reply) > 20_000 for reply in read)
    assert 0 < kept < 2000


def test_many_connections_do_not_limit_a_client_while_the_total_rate_is_low(addresses, context):
    """A program that polls the status opens a connection for each request."""
    clock = VirtualClock()
    with Served(*addresses, per_second=200.0, clock=clock) as served:
        client = Asking(context, served, addresses[1], "hold")
        for _ in range(150):
            clock.sleep_until(clock.now() + 0.02)
            assert client.told()["ok"]
            for _ in range(2):
                assert is_served(served, context, addresses[1])
            client.send("hold")


def test_a_client_below_its_rate_is_heard_again_after_a_burst(addresses, context, clock):
    """A setpoint stream is delivered in a burst after a pause of the network."""
    with Served(commands=addresses[1], per_second=100.0, clock=clock) as served:
        client, replies = connect(context, zmq.DEALER, addresses[1]), list[bool]()

        def stream(count: int, rate: float) -> list[bool]:
            """Send setpoints, and return whether each of them was accepted."""
            replies.clear()
            for k in range(count):
                client.send(msgpack.packb({"command": "hold", "force": float(k)}))
                until(served.has_request)
                clock.sleep_until(clock.now() + 1.0 / rate)
                served.serve_until(echo, lambda: client.poll(0))
                replies.append(msgpack.unpackb(client.recv())["ok"])
            return list(replies)

        assert all(stream(10, 50.0))
        assert not all(stream(120, 2000.0))
        assert all(stream(20, 50.0)[-10:])
        assert not any(stream(50, 200.0)[-10:]), "the limit still holds"


@pytest.mark.parametrize("stops", [0, 1])
def test_requests_that_waited_for_a_restart_of_the_gateway_are_old(
    addresses, context, clock, stops
):
    link = Link()
    with Served(*addresses, clock=clock, link=link) as served:
        assert is_served(served, context, addresses[1])
    link.look()
    for _ in range(stops):
        link.fence()
    ages: list[float] = []

    def note(request: dict[str, object], age: float) -> dict[str, object]:
        ages.append(age)
        return {}

    with Served(*addresses, clock=clock, link=link, restarted=True) as served:
        client = Asking(context, served, addresses[1], "arm")
        until(served.has_request)
        for _ in range(20):  # The gateway delays its replies.
            served.serve(note)
            clock.sleep_until(clock.now() + bounds.REFUSAL_TIME)
        assert client.told(note).get("reason") == ("stopped" if stops else None)
        assert [age > 1.0 for age in ages] == [True] * (1 - stops)
        clock.sleep_until(clock.now() + bounds.RECONNECT_TIME)
        for _ in range(3):
            served._is_open()
        assert Asking(context, served, addresses[1], "arm").told(note)["ok"]
        assert ages[-1] < 1.0


def test_requests_that_arrive_before_a_new_gateway_meets_the_loop_are_not_stopped(
    addresses, context, clock, monkeypatch
):
    link = Link()
    with Served(*addresses, clock=clock, link=link) as served:
        link.fence()
        until(served._is_open)
    link.look()
    with monkeypatch.context() as patch:
        patch.setattr(Served, "settle", lambda _: None)
        served = Served(*addresses, clock=clock, link=link, restarted=True)
    with served:
        client = Asking(context, served, addresses[1], "arm")
        until(served.has_request)
        served.service.step(0.0)
        for _ in range(20):  # The gateway delays its replies.
            served.serve(echo)
            clock.sleep_until(clock.now() + bounds.REFUSAL_TIME)
        assert client.told() == {"ok": True, "heard": "arm"}


@pytest.mark.parametrize("prefix", [b"\xa7command\xa4", b"\xd9\x07command\xd9\x04"])
def test_a_stop_is_urgent_in_each_format_of_short_strings(served, context, addresses, prefix):
    client = Asking(context, served, addresses[1], b"\x81" + prefix + b"stop")
    served.settle_until(lambda: served.link.asked)
    assert served.link.asked[0].urgent
    client.socket.close(0)


def test_delayed_replies_are_sent_when_the_daemon_ends(served, context, addresses):
    client = Asking(context, served, addresses[1], "stop")
    until(lambda: served.serve(echo) or served.link.stops)
    served.settle()
    assert not client.socket.poll(0), "the reply to a stop is delayed"
    served.link.close()
    served.service.step(0.0)
    assert client.socket.poll(30_000)
    assert msgpack.unpackb(client.socket.recv())["ok"]


def test_kept_messages_are_repeated_if_the_gateway_did_not_read():
    link, (ours, theirs) = Link(), pair()
    link.offer(Channel(ours))
    link.look()
    for _ in range(20):
        link.publish(0, bytes(1 << 18))
    link.publish(1, b"an event", keep=5)
    gateway, received = Channel(theirs), []
    event = ["publish", 1, 5, b"an event"]
    until(lambda: [link.look(), received.extend(gateway.receive()), event in received][-1])
    assert len(received) < 20
    link.close()
    gateway.close()
