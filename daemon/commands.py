"""The command server and client: one msgpack map each way, and nothing that decides.

The server lives in the loop's own thread: it is asked once a tick, costs one look when
nobody speaks, and needs no lock. A plain REQ socket is enough for a client.

One command is carried out a tick. What has come beside it is looked through as far as a tick
allows: a ``stop`` goes first whoever else speaks, and whatever waits then is refused, since it may
have been sent before; a client that sends more than it may a second is refused, or in a flood not
even answered, so that a flood costs the tick a bounded time and no one else's command its turn.
"""

from __future__ import annotations

import logging
import math
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import msgpack
import zmq

from daemon.keys import ClientKeys
from daemon.messages import pack
from daemon.patience import PATIENCE, SILENCE, answer_to, still_waiting
from daemon.sockets import OWNER_ONLY, Bound, Guard

Handler = Callable[[dict[str, Any]], dict[str, Any]]

_QUEUE = 64  # commands that wait, of one client in its socket and of all of them here
_LOOK = 8  # messages that are taken in at a tick
_REFUSALS = 2  # answers at a tick to who sends too much
_CLIENTS = 256  # whose pace is remembered
_FULL = "too many commands wait already"
_STOPPED = "a stop came before its turn; send it again"
_STOP = b"stop"
_VALUES = (str, int, float)  # and bool, which is an int

_log = logging.getLogger(__name__)


class Refused(Exception):
    """A command that is not carried out. The message is what the client is told."""


class CommandServer:
    """Answers commands, at most one a tick. Anything malformed is refused, never an exception."""

    def __init__(
        self,
        context: zmq.Context[Any],
        address: str,
        max_bytes: int,
        per_second: float = 1e9,
        guard: Guard = OWNER_ONLY,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """``per_second`` bounds each client's commands; one second's worth may come at once.

        ``now`` [s] is the clock that their pace is measured by.
        """
        self._bound = Bound(
            context, zmq.ROUTER, address, "commands.address", _QUEUE, 4 * max_bytes, guard
        )
        self._socket = self._bound.socket
        self._max_bytes = max_bytes
        self._per_second = per_second
        self._now = now
        self._paces: dict[bytes, tuple[float, float]] = {}  # of a client: may send, at time
        self._waiting: deque[tuple[list[bytes], bytes]] = deque()
        self._refusals = _REFUSALS  # that may still be answered at this tick
        self._settled = False  # nothing waits anywhere until the socket's descriptor tells
        self.refused_by_pace = 0

    def serve(self, handler: Handler) -> bool:
        """Answer one waiting command through ``handler``; False when there was nothing at all."""
        if self._settled and not self._bound.signalled():
            return False
        came = stopped = self._settled = False
        self._refusals = _REFUSALS
        for _ in range(_LOOK):
            if not self._bound.readable():
                self._settled = not came and not self._waiting  # else an answer is sent below
                break
            came = True
            frames = self._socket.recv_multipart(zmq.NOBLOCK)
            stopped = self._take_in(frames, handler) or stopped
        if stopped:
            self._refuse_waiting()
        if not self._waiting:
            return came
        envelope, payload = self._waiting.popleft()
        self._send(envelope, self._answer(payload, handler))
        return True

    def _take_in(self, frames: list[bytes], handler: Handler) -> bool:
        """Sort one message in; True when it was a stop, which has been carried out."""
        # A REQ socket sends [identity, empty, payload]. Without the empty frame, as from a DEALER,
        # the reply goes back in the same form.
        envelope, payload = frames[:-1], frames[-1]
        if not 0 < len(envelope) <= 2:
            return False  # no client's form; an answer would only send its frames back
        if _is_stop(payload, self._max_bytes):
            self._send(envelope, self._answer(payload, handler))
            return True
        if not self._in_pace(envelope[0], self._now()):
            self._refuse(envelope, f"too many commands: at most {self._per_second:g} a second")
        elif len(self._waiting) >= _QUEUE and not self._make_room(envelope[0]):
            self._refuse(envelope, _FULL)
        else:
            self._waiting.append((envelope, payload))
        return False

    def _refuse_waiting(self) -> None:
        while self._waiting:
            envelope, _ = self._waiting.popleft()
            self._send(envelope, {"ok": False, "error": _STOPPED})

    def _make_room(self, client: bytes) -> bool:
        """Refuse the last command of whoever has most waiting, unless that is this client."""
        counts = Counter([envelope[0] for envelope, _ in self._waiting])
        greedy, most = counts.most_common(1)[0]
        if counts[client] + 1 >= most:
            return False
        at = max(i for i, (envelope, _) in enumerate(self._waiting) if envelope[0] == greedy)
        envelope, _ = self._waiting[at]
        del self._waiting[at]
        self._refuse(envelope, _FULL)
        return True

    def _in_pace(self, client: bytes, now: float) -> bool:
        most = self._per_second
        left, then = self._paces.get(client, (most, now))
        left = min(left + (now - then) * most, most)
        if client not in self._paces and len(self._paces) >= _CLIENTS:
            self._paces.clear()
        self._paces[client] = (max(left - 1.0, 0.0), now)
        return left >= 1.0

    def _refuse(self, envelope: list[bytes], error: str) -> None:
        self.refused_by_pace += 1
        if self._refusals <= 0:
            return
        self._refusals -= 1
        self._send(envelope, {"ok": False, "error": error})

    def _send(self, envelope: list[bytes], reply: dict[str, Any]) -> None:
        try:
            self._socket.send_multipart([*envelope, pack(reply)], zmq.NOBLOCK)
        except zmq.ZMQError:
            pass  # the client has gone

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


def _is_stop(payload: bytes, max_bytes: int) -> bool:
    if _STOP not in payload or len(payload) > max_bytes:
        return False
    try:
        return bool(decode(payload)["command"] == "stop")
    except Refused:
        return False


def decode(payload: bytes) -> dict[str, Any]:
    """Unpack a command, a map of plain numbers and texts with a text under ``command``.

    Raises Refused for all else.
    """
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
    # Nothing nested: what comes from outside is told to subscribers as it came.
    if not all(value is None or isinstance(value, _VALUES) for value in request.values()):
        raise Refused("expected numbers and texts as values")
    return request


class NoAnswer(Exception):
    """The daemon did not answer in time."""


def send(
    address: str, request: dict[str, Any], timeout: float = PATIENCE, keys: ClientKeys | None = None
) -> dict[str, Any]:
    """Send one command and return the reply. Raises NoAnswer after ``timeout`` s.

    A warning is logged when that takes long, which without handlers goes to standard error.
    """
    context: zmq.Context[Any] = zmq.Context()
    socket = context.socket(zmq.REQ)
    socket.setsockopt(zmq.LINGER, 0)
    try:
        if keys is not None:
            keys.guard(socket)
        try:
            socket.connect(address)
        except zmq.ZMQError as error:
            raise NoAnswer(f"{address}: {error}") from None
        socket.send(pack(request))
        silence = min(SILENCE, timeout)
        answered = socket.poll(math.ceil(silence * 1e3))
        if not answered and silence < timeout:
            _log.warning(still_waiting(answer_to(request, address), timeout))
            answered = socket.poll(math.ceil((timeout - silence) * 1e3))
        if not answered:
            hint = " (with access.keys it needs keys: --keys, keys=)" if keys is None else ""
            raise NoAnswer(
                f"no {answer_to(request, address)} within {timeout:g} s; is softfinger running, "
                f"or still starting?{hint}"
            )
        reply = msgpack.unpackb(socket.recv(), raw=False)
    finally:
        socket.close()
        context.term()
    if not isinstance(reply, dict):
        raise NoAnswer(f"{address} answered something that is not a reply")
    return reply
