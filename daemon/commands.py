"""The command server and client: one msgpack map each way, and nothing that decides.

The server lives in the loop's own thread: it is asked once a tick, costs one system-free look when
nobody speaks, and needs no lock. A plain REQ socket is enough for a client.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgpack
import zmq

from daemon.messages import pack
from daemon.sockets import Bound

Handler = Callable[[dict[str, Any]], dict[str, Any]]

# One command a tick keeps a flood from stretching the tick; more wait in their senders' queues.
_QUEUE = 64


class Refused(Exception):
    """A command that is not carried out. The message is what the client is told."""


class CommandServer:
    """Answers at most one command a tick. Anything malformed gets a refusal, never an exception."""

    def __init__(self, context: zmq.Context[Any], address: str, max_bytes: int) -> None:
        self._bound = Bound(context, zmq.ROUTER, address, "commands.address", _QUEUE, 4 * max_bytes)
        self._socket = self._bound.socket
        self._max_bytes = max_bytes

    def serve(self, handler: Handler) -> bool:
        """Answer one waiting command through ``handler``; False when nobody waits."""
        if not self._bound.readable():
            return False
        frames = self._socket.recv_multipart(zmq.NOBLOCK)
        # A REQ socket sends [identity, empty, payload]. Without the empty frame, as from a DEALER,
        # the reply goes back in the same form.
        envelope, payload = frames[:-1], frames[-1]
        if len(envelope) > 2:
            return True  # not the form of any client; an answer would only send its frames back
        reply = self._answer(payload, handler)
        try:
            self._socket.send_multipart([*envelope, pack(reply)], zmq.NOBLOCK)
        except zmq.ZMQError:
            pass  # the client has gone
        return True

    def drain(self, handler: Handler) -> None:
        """Answer all that wait, up to the queue's length."""
        for _ in range(_QUEUE):
            if not self.serve(handler):
                return

    def _answer(self, payload: bytes, handler: Handler) -> dict[str, Any]:
        try:
            if len(payload) > self._max_bytes:
                raise Refused(f"message of {len(payload)} bytes; at most {self._max_bytes}")
            return {"ok": True, **handler(decode(payload))}
        except Refused as refusal:
            return {"ok": False, "error": str(refusal)}

    def close(self) -> None:
        """Close the socket."""
        self._bound.close()


def decode(payload: bytes) -> dict[str, Any]:
    """Unpack a command. Raises Refused unless it is a map with a text under ``command``."""
    try:
        request = msgpack.unpackb(payload, raw=False, max_map_len=64, max_array_len=64)
    except Exception as error:  # msgpack raises many kinds, ValueError and its own among them
        raise Refused(f"not msgpack: {error}") from None
    if not isinstance(request, dict):
        raise Refused(f"expected a map, found {type(request).__name__}")
    if not isinstance(request.get("command"), str):
        raise Refused('expected a text under "command"')
    if not all(isinstance(key, str) for key in request):
        raise Refused("expected texts as keys")
    return request


class NoAnswer(Exception):
    """The daemon did not answer in time."""


def send(address: str, request: dict[str, Any], timeout: float = 2.0) -> dict[str, Any]:
    """Send one command and return the reply. Raises NoAnswer after ``timeout`` s."""
    context: zmq.Context[Any] = zmq.Context()
    socket = context.socket(zmq.REQ)
    socket.setsockopt(zmq.LINGER, 0)
    try:
        try:
            socket.connect(address)
        except zmq.ZMQError as error:
            raise NoAnswer(f"{address}: {error}") from None
        socket.send(pack(request))
        if not socket.poll(int(timeout * 1000)):
            raise NoAnswer(
                f"no answer from {address} within {timeout:g} s; is softfinger running, "
                "or still starting?"
            )
        reply = msgpack.unpackb(socket.recv(), raw=False)
    finally:
        socket.close()
        context.term()
    if not isinstance(reply, dict):
        raise NoAnswer(f"{address} answered something that is not a reply")
    return reply
