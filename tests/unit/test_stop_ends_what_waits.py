"""Test that a stop cancels all earlier requests, in any order of events and clients.

Clients, gateway and loop act one at a time, in an order that Hypothesis chooses. A list contains
the requests that libzmq has received. The gateway reads only a few of these requests at a time.
When a stop is executed, an earlier request may therefore be waiting on the connection, in the
gateway, on the link, or in the loop.
"""

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import msgpack
import zmq
from hypothesis import given
from hypothesis import strategies as st

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.errors import Reason, Refused
from softfinger.daemon.gateway import bounds, commands
from softfinger.daemon.gateway.commands import CommandEndpoint
from tests.conftest import until
from tests.harness.gateway import Served

action = st.one_of(
    st.tuples(st.sampled_from(["arm", "stop", "repeat"]), st.integers(0, 3)),
    st.tuples(st.sampled_from(["gateway", "loop", "busy loop", "signal", "time"]), st.just(0)),
)


class Scene:
    """A gateway, a link and a loop, each of which acts step by step.

    Each event increments a counter. Each ``arm`` is identified by the value of the counter when the
    ``arm`` was first sent.
    """

    def __init__(self, folder: str) -> None:
        self.clock = VirtualClock()
        self.arrived: deque[list[zmq.Frame]] = deque()
        self.replies: list[dict[str, Any]] = []
        self.served = Served(commands=f"ipc://{folder}/c", per_second=1e6, clock=self.clock)
        # Simulated time for reading a message [s], which limits the messages per step.
        self.reading = 0.4 * bounds.TURN_TIME
        self.now = 0
        self.stopped_at = 0
        self.asked = 0
        self.last: dict[int, float] = {}  # last ``arm`` of each client, which the client may repeat
        self.carried_out: set[float] = set()
        self.busy = False

    def read(self, _: object) -> list[zmq.Frame]:
        """Replace libzmq's socket."""
        self.pass_time(self.reading)
        return self.arrived.popleft() if self.arrived else []

    def send(self, message: list[bytes]) -> None:
        self.replies.append(msgpack.unpackb(message[-1]))

    def pass_time(self, seconds: float) -> None:
        self.clock.sleep_until(self.clock.now() + seconds)

    def ask(self, client: int, **request: Any) -> None:
        parts = (b"client %d" % client, b"", msgpack.packb(request))
        self.arrived.append([zmq.Frame(part) for part in parts])
        self.asked += 1

    def act(self, what: str, client: int = 0) -> None:
        self.now += 1
        self.pass_time(1e-6)
        if what == "stop":
            self.ask(client, command="stop")
        elif what in ("arm", "repeat"):
            if what == "arm":
                self.last[client] = float(self.now)
            if client in self.last:
                first = self.last[client]
                self.ask(client, command="arm", force=first, key=f"{first}")
        elif what == "gateway":
            self.served.service.step(0.0)
        elif what in ("loop", "busy loop"):
            self.busy = what == "busy loop"
            self.served.server.serve(self._carry_out)
        elif what == "time":
            self.pass_time(bounds.REFUSAL_TIME)
        else:
            self.served.link.fence()
            self.stopped_at = self.now

    def _carry_out(self, request: dict[str, Any], age: float) -> dict[str, Any]:
        if request["command"] == "stop":
            self.stopped_at = self.now
            return {}
        if self.busy:
            raise Refused("the loop stood still", Reason.LATE)
        assert request["force"] > self.stopped_at, "a request from before a stop was executed"
        assert request["force"] not in self.carried_out, "a request was executed twice"
        self.carried_out.add(request["force"])
        return {}


@contextmanager
def played() -> Iterator[Scene]:
    """Yield a scene that replaces the gateway's socket."""
    with TemporaryDirectory() as folder:
        scene = Scene(folder)
        with (
            patch.object(commands, "read_parts", scene.read),
            patch.object(CommandEndpoint, "_send", scene.send),
            scene.served,
        ):
            yield scene


@given(st.lists(action, max_size=60))
def test_no_request_from_before_a_stop_is_executed(actions):
    with played() as scene:
        for what, client in actions:
            scene.act(what, client)
        for _ in range(100):  # Let the loop read all requests.
            scene.act("gateway")
            scene.act("loop")
        asked = scene.asked
        assert len(scene.replies) == asked, "each request must have exactly one reply"
        # Later requests are executed.
        scene.ask(0, command="arm", force=1e9)
        for _ in range(3):
            scene.act("gateway")
            scene.act("loop")
        assert scene.replies[asked:] == [{"ok": True}]


def test_a_backlog_that_libzmq_delivers_slowly_is_cancelled_by_a_stop():
    """libzmq delivers earlier requests so slowly that the gateway's queue is sometimes empty."""
    with played() as scene:
        scene.reading = 1e-5
        scene.stopped_at = 2
        scene.served.link.fence()
        for _ in range(500):
            for client in range(20):
                scene.ask(client, command="arm", force=1.0)
            until(lambda: scene.act("gateway") or not scene.arrived)
            scene.act("loop")
        for _ in range(3):
            scene.act("time")
            scene.act("gateway")
            scene.act("loop")
        assert [reply["ok"] for reply in scene.replies] == [False] * 10_000
        scene.ask(0, command="arm", force=1e9)
        for _ in range(3):
            scene.act("gateway")
            scene.act("loop")
        assert scene.replies[-1]["ok"]


def test_a_flood_does_not_count_as_old_forever():
    """The maximum number of connections limits the backlog, even if the socket is never empty."""
    with (
        patch.object(bounds, "CLIENT_COUNT_MAX", 1),
        patch.object(bounds, "SOCKET_QUEUE_LENGTH", 20),
        played() as scene,
    ):
        door = scene.served.service.commands
        scene.pass_time(0.5)
        for _ in range(100):
            scene.ask(0, command="status")
        scene.act("gateway")
        assert door._dated < math.inf
        until(lambda: scene.act("gateway") or len(scene.arrived) <= 70)
        assert door._dated == math.inf
