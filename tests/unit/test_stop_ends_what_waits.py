"""Whatever arrived before a stop dies with it, wherever it waits: any interleaving of any clients.

Clients, gateway and loop act one at a time in an order that hypothesis chooses, on real sockets of
which what was sent has arrived. So a request may wait in its connection, in the queue of those to
be accepted, in the gateway, on the link, or in the loop's hands when a stop is carried out.
"""

from __future__ import annotations

from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

from hypothesis import given
from hypothesis import strategies as st

from softfinger.daemon.gateway import bounds
from tests.conftest import until
from tests.harness.gateway import Served
from tests.harness.zmtp_client import RawClient

_CLIENTS = 4

action = st.one_of(
    st.tuples(st.just("arm"), st.integers(0, _CLIENTS - 1)),
    st.tuples(st.just("half"), st.integers(0, _CLIENTS - 1)),
    st.tuples(st.just("new"), st.integers(0, _CLIENTS - 1)),
    st.tuples(st.just("stop"), st.integers(0, _CLIENTS - 1)),
    st.tuples(st.sampled_from(["gateway", "loop", "signal"]), st.just(0)),
)


class Whole:
    """Takes what a client would send."""

    def __init__(self) -> None:
        self.data = b""

    def send(self, data: bytes) -> None:
        self.data += data


def arm(count: int) -> bytes:
    """The bytes of an ``arm`` that is told apart by a count."""
    whole = Whole()
    RawClient.ask(whole, command="arm", force=float(count))  # type: ignore[arg-type]
    return whole.data


class Scene:
    """Counts what happens; an ``arm`` is told apart by the count at its arrival."""

    def __init__(self, folder: str) -> None:
        self._address = f"ipc://{folder}/c"
        self.served = Served(commands=self._address)
        self.served.settle()
        self.clients = [RawClient(self._address, b"DEALER") for _ in range(_CLIENTS)]
        self._rest = [b""] * _CLIENTS  # of requests of which half has been sent
        self.now = 0
        self.stopped_at = 0

    def act(self, what: str, client: int) -> None:
        self.now += 1
        if what == "arm":
            self._finish(client)
            self.clients[client].send(arm(self.now))
        elif what == "half":
            self._finish(client)
            self.clients[client].send(arm(self.now)[:9])
            self._rest[client] = arm(self.now)[9:]
        elif what == "new":
            self.clients[client].close()
            self._rest[client] = b""
            self.clients[client] = RawClient(self._address, b"DEALER")
        elif what == "stop":
            self._finish(client)
            self.clients[client].ask(command="stop")
        elif what == "gateway":
            self.served.service.step(0.0)
        elif what == "loop":
            self.served.server.serve(self._carry_out)
        else:
            self.served.server.begin_epoch()
            self.stopped_at = self.now

    def _finish(self, client: int) -> None:
        """The rest of a request arrives now; it counts from its beginning, to be strict."""
        self.clients[client].send(self._rest[client])
        self._rest[client] = b""

    def _carry_out(self, request: dict[str, Any]) -> dict[str, Any]:
        if request["command"] == "stop":
            self.stopped_at = self.now
        else:
            assert request["force"] > self.stopped_at, "it arrived before a stop"
        return {}

    def close(self) -> None:
        for client in self.clients:
            client.close()
        self.served.close()


@given(st.lists(action, max_size=60))
def test_nothing_that_arrived_before_a_stop_is_carried_out(actions: list[tuple[str, int]]) -> None:
    with (
        TemporaryDirectory() as folder,
        # Little at a time, so that much waits.
        patch.object(bounds, "ACCEPTED", 1),
        patch.object(bounds, "READ", len(arm(0))),
    ):
        scene = Scene(folder)
        try:
            for what, client in actions:
                scene.act(what, client)

            def settled() -> bool:
                scene.act("gateway", 0)
                scene.act("loop", 0)
                return scene.served.link.begun == scene.served.link.epoch

            for _ in range(60):  # all that was sent has been read, stops included
                settled()
            until(settled)
            # And what arrives after it is.
            scene.act("new", 0)
            heard: list[dict[str, Any]] = []
            scene.clients[0].ask(command="status", force=1e9)
            until(lambda: (settled() and heard.extend(scene.clients[0].replies())) or heard)
            assert [reply["ok"] for reply in heard] == [True]
        finally:
            scene.close()
