"""Forward requests to the loop, within the limits in `bounds`, and replies to clients.

The gateway does not unpack requests. Requests that look like a stop bypass the queues, one at a
time for each client. Apart from stops, only a few requests are forwarded to the loop at a time.
Further requests wait in queues, and the clients are served in turn. If a client exceeds its rate,
its requests are refused until it pauses.

Each request is stamped with its arrival time and the number of stops that preceded it. The libzmq
thread reads ahead, so the gateway can't determine whether a request arrived before or after a stop.
After a stop or a gap between two polls, the gateway therefore stamps requests as if they had
arrived earlier, until the socket has been empty and few requests have arrived. Replies are also
held back, for a limited time, because clients may respond to a reply with new requests, which would
be refused.
"""

from __future__ import annotations

import contextlib
from collections import OrderedDict, deque
from collections.abc import Callable

import msgpack
import zmq

from softfinger.daemon.errors import Reason
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.endpoints import NO_WAIT, Admission, Endpoint
from softfinger.daemon.wire.command_server import refusal
from softfinger.daemon.wire.loop_link import ASK, Ask

# This byte sequence cannot occur inside a string.
_PACKED_STOP = msgpack.packb("command") + msgpack.packb("stop")
_MALFORMED_REFUSAL = refusal(
    "envelope: expected a single frame with the command; an envelope may precede this frame if "
    f"the envelope ends with an empty frame and has at most {bounds.PART_COUNT_MAX - 2} frames and "
    f"{bounds.ENVELOPE_SIZE_MAX} bytes",
    Reason.REQUEST,
)
_QUEUE_FULL_REFUSAL = refusal("too many commands are waiting", Reason.BUSY)


class Client:
    """One connection, with its queued requests and a token bucket of one second's requests."""

    __slots__ = ("_behind", "_left", "_then", "urgent", "waiting")

    def __init__(self, per_second: float, now: float) -> None:
        self.waiting: deque[Ask] = deque()
        self.urgent = False  # True while an urgent request awaits its reply
        self._behind = False  # True after the client has exceeded the rate, until it pauses
        self._left = per_second
        self._then = now

    def floods(self, per_second: float, now: float) -> bool:
        """Count one request; return True if the client has exceeded its rate and must pause."""
        passed = now - self._then
        left = min(self._left + passed * per_second, per_second) - 1.0
        self._left = max(left, 0.0)
        self._then = now
        self._behind = left < 0.0 or (self._behind and passed < bounds.RECOVERY_TIME)
        return self._behind


class CommandEndpoint(Endpoint):
    """Socket that receives requests and sends replies."""

    def __init__(
        self,
        admission: Admission,
        config: Config,
        send_to_loop: Callable[..., None],
        clock: Callable[[], float],
    ) -> None:
        """Bind the socket. Raises AddressError."""
        self._admission = admission
        self._config = config
        text = f"too many commands: expected at most {config.per_second:g} per second"
        self._too_many = refusal(text, Reason.BUSY)
        self._send_to_loop = send_to_loop
        self._clock = clock
        self.refused = 0  # number of requests refused because of rate and queue limits
        self.stops = 0  # stop count stamped on new requests
        self._fence = 0  # current stop count
        self._last_poll = clock()
        # Time of the last poll before a gap, or None once all requests from the gap have been read.
        self._dated: float | None = None
        self._left = 0  # maximum number of requests from the gap that are still unread
        self._since = 0.0  # time of the last stop, gap or `_arrived` check
        self._arrived = 0  # number of requests since `_since`, except status
        self._held: list[list[bytes]] = []  # replies held back
        # Time for which replies have been held back [s]. A step adds at most REFUSAL_TIME, so that
        # a stall of the process has little effect.
        self._held_for = 0.0
        self._clients: OrderedDict[bytes, Client] = OrderedDict()
        self._active: set[bytes] = set()  # clients that sent a request in the current second
        self._active_until = 0.0
        self._turns: deque[Client] = deque()  # clients with queued requests
        self._urgent: deque[Ask] = deque()
        self.count = 0  # number of queued requests, not counting urgent ones
        self._under_way = [0, 0]  # number of requests that await the loop's reply: normal, urgent
        limit = bounds.PART_SIZE_RATIO * config.max_bytes
        super().__init__(admission, zmq.ROUTER, config.commands, "commands.address", config, limit)

    def fence(self, stops: int) -> None:
        """Stamp new requests as older than the last stop until all earlier requests are read."""
        self._fence = stops
        self._since, self._arrived = self._clock(), 0

    def read(self) -> None:
        """Read requests for up to `bounds.TURN_TIME`, and forward them within the loop's limits."""
        began = self._clock()
        if began - self._last_poll > bounds.POLL_GAP_MAX:
            if self._dated is None:
                self._dated = self._last_poll
            self._left = bounds.CLIENT_COUNT_MAX * bounds.SOCKET_QUEUE_LENGTH
            self._since, self._arrived = began, 0
        self._held_for += min(began - self._last_poll, bounds.REFUSAL_TIME)
        self._last_poll = began
        if self.stops == self._fence or self._held_for > bounds.ANSWER_DELAY_MAX:
            held, self._held = self._held, []
            for answer in held:
                self._send(answer)
        while (now := self._clock()) < began + bounds.TURN_TIME:
            parts = self._parts()
            if not parts:
                self._note_empty(now)
                break
            self._take([part.bytes for part in parts], self._admission.name(parts[-1]), now)
        while self._urgent and self._under_way[True] < bounds.URGENT_UNANSWERED_MAX:
            self._pass_on(self._urgent.popleft())
        while self._turns and self._under_way[False] < bounds.UNANSWERED_MAX:
            client = self._turns.popleft()
            self._pass_on(client.waiting.popleft())
            self.count -= 1
            if client.waiting:
                self._turns.append(client)

    def _note_empty(self, now: float) -> None:
        """Check whether all requests from before a stop or a gap have been read.

        The socket is empty, but the libzmq thread may still deliver older requests. Older requests
        count as read only after `bounds.REFUSAL_TIME` with few new requests.
        """
        if now - self._since > bounds.REFUSAL_TIME:
            if self._arrived <= bounds.TOTAL_RATE * bounds.REFUSAL_TIME:
                self.stops, self._dated = self._fence, None
            self._since, self._arrived = now, 0

    def _take(self, parts: list[bytes], name: str, now: float) -> None:
        """Queue or refuse one client message."""
        # Like a REP socket, return the frames up to the first empty frame with the reply.
        ends = parts.index(b"", 1) + 1 if b"" in parts[1:-1] else 1
        route, payload = parts[:ends], parts[-1]
        if sum(map(len, route)) > bounds.ENVELOPE_SIZE_MAX or len(parts) > bounds.PART_COUNT_MAX:
            ends, route = 0, parts[:1]
        client = self._client(parts[0], now)
        self._arrived += b"status" not in payload
        self._left -= 1
        if self._left < 0:  # The gateway has read more requests than the socket queues can hold.
            self._dated = None
        is_urgent = (
            _PACKED_STOP in payload and len(payload) <= bounds.URGENT_SIZE_MAX and not client.urgent
        )
        if client.floods(self._client_rate(parts[0], now), now) and not is_urgent:
            self.refused += 1
            self._answer(route, self._too_many)
        elif ends + 1 != len(parts):
            self._answer(route, _MALFORMED_REFUSAL)
        elif len(payload) > self._config.max_bytes:
            text = (
                f"the command has {len(payload)} bytes, expected at most {self._config.max_bytes}"
            )
            self._answer(route, refusal(text, Reason.REQUEST))
        else:
            came = now if self._dated is None else self._dated
            self._queue(client, Ask(came, self.stops, is_urgent, name, route, payload))

    def _queue(self, client: Client, ask: Ask) -> None:
        if ask.urgent:
            client.urgent = True
            self._urgent.append(ask)
        elif (
            len(client.waiting) >= bounds.CLIENT_QUEUE_LENGTH
            or self.count >= bounds.TOTAL_QUEUE_LENGTH
        ):
            self.refused += 1
            self._answer(ask.route, _QUEUE_FULL_REFUSAL)
        else:
            if not client.waiting:
                self._turns.append(client)
            client.waiting.append(ask)
            self.count += 1

    def _client(self, identity: bytes, now: float) -> Client:
        client = self._clients.get(identity)
        if client is None:
            client = self._clients[identity] = Client(self._config.per_second, now)
            if len(self._clients) > bounds.CLIENT_COUNT_MAX:
                self._clients.popitem(last=False)
        return client

    def _client_rate(self, identity: bytes, now: float) -> float:
        """Return the allowed request rate per client [1/s], which decreases with many clients."""
        if now > self._active_until:
            self._active_until = now + 1.0
            self._active.clear()
        self._active.add(identity)
        share = max(bounds.TOTAL_RATE / len(self._active), bounds.CLIENT_RATE_MIN)
        return min(self._config.per_second, share)

    def _pass_on(self, ask: Ask) -> None:
        self._under_way[ask.urgent] += 1
        self._send_to_loop(ASK, *ask)

    def reply(self, urgent: bool, route: list[bytes], reply: bytes) -> None:
        """Forward the loop's reply to the client."""
        self._under_way[urgent] -= 1
        if urgent and route[0] in self._clients:
            self._clients[route[0]].urgent = False
        self._answer(route, reply)

    def _answer(self, route: list[bytes], reply: bytes) -> None:
        """Send a reply, or hold it back until all requests that precede a stop have been read."""
        if self.stops == self._fence:
            self._send([*route, reply])
            return
        if not self._held:
            self._held_for = 0.0
        self._held.append([*route, reply])

    def _send(self, message: list[bytes]) -> None:
        with contextlib.suppress(zmq.ZMQError):  # The client may have disconnected.
            self.socket.send_multipart(message, NO_WAIT)
