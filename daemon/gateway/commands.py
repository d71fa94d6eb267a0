"""Forward requests to the loop, within the limits in `bounds`, and forward replies to clients.

The gateway does not unpack requests. Requests that look like a stop are urgent and bypass the
queues. A client may have only one urgent request at a time. Other requests are forwarded to the
loop a few at a time. Further requests wait in queues, and the clients are served in turn. If a
client exceeds its rate limit, its requests are refused until its rate has dropped.

Each request is stamped with its arrival time and the number of preceding stops. The libzmq thread
reads ahead, so the gateway can't determine whether a request arrived before or after a stop. After
a stop or a long gap between two polls, the gateway therefore stamps new requests as older than the
stop or the gap. Normal stamping resumes once the socket is empty and few requests arrive. After a
restart of the gateway, clients deliver the requests that they have queued. The gateway therefore
stamps all requests as old until the clients have had time to reconnect. Replies are also delayed
for a limited time. Otherwise, a client could respond to a reply with a new request
that the gateway would refuse.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections import deque
from collections.abc import Callable

import zmq

from softfinger.daemon.errors import Reason
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.endpoints import NO_WAIT, ClientSockets, read_parts
from softfinger.daemon.wire.command_server import refusal
from softfinger.daemon.wire.loop_link import ASK, Ask, Channel

# A packed stop command, with both formats of short strings. Other packed strings cannot contain
# these byte sequences.
_PACKED_STOP = re.compile(rb"(\xa7|\xd9\x07)command(\xa4|\xd9\x04)stop")
_MALFORMED_REFUSAL = refusal(
    "envelope: expected one frame that contains the command, optionally after an envelope that "
    f"ends with an empty frame and has at most {bounds.PART_COUNT_MAX - 2} frames and "
    f"{bounds.ENVELOPE_SIZE_MAX} bytes",
    Reason.REQUEST,
)
_QUEUE_FULL_REFUSAL = refusal("too many commands are waiting", Reason.BUSY)


class Client:
    """Client connection, with its queued requests and a token-bucket rate limiter."""

    def __init__(self) -> None:
        self.waiting: deque[Ask] = deque()
        self.urgent = False  # True while an urgent request awaits its reply
        self._floods = False  # True from a request above the rate limit until the rate has dropped
        self._tokens = math.inf
        self.last = -math.inf  # time of the last request

    def floods(self, per_second: float, now: float) -> bool:
        """Count one request; return True if the client must send fewer requests."""
        tokens = min(self._tokens + (now - self.last) * per_second, per_second)
        self._floods = tokens < max(1.0, self._floods * bounds.RECOVERY_TIME * per_second)
        self._tokens, self.last = max(tokens - 1.0, 0.0), now
        return self._floods


class CommandEndpoint:
    """Socket that receives requests and sends replies."""

    def __init__(
        self,
        sockets: ClientSockets,
        config: bounds.Config,
        channel: Channel,
        clock: Callable[[], float],
    ) -> None:
        """Bind the socket. Raises AddressError."""
        self.socket = sockets.open(zmq.ROUTER, config.commands, "commands.address")
        self._sockets = sockets
        self._config = config
        text = f"too many commands: expected at most {config.per_second:g} per second"
        self._too_many = refusal(text, Reason.BUSY)
        self._channel = channel
        self._clock = clock
        self.refused = 0  # number of requests that were refused because of rate or queue limits
        self.stops = config.stops  # stop count stamped on new requests
        self._fence = config.stops  # current stop count
        self._last_poll = clock()
        # Time of the last poll before a gap between polls. The time is infinite once all requests
        # from the gap have been read.
        self._dated = math.inf
        self._unread_max = 0  # upper bound on the number of unread requests from the gap
        self._since = 0.0  # time of the last stop, gap or check for older requests
        if config.restarted:
            self._since = self._last_poll + bounds.RECONNECT_TIME
            self._date(self._last_poll - 2.0 * bounds.RECONNECT_TIME)
        self._tokens = bounds.TOTAL_RATE  # token bucket for the requests of all clients
        self._counted = self._last_poll  # time of the last request
        self._arrived = 0  # number of requests since `_since`, excluding status requests
        self._replies: deque[list[bytes]] = deque()  # replies that have not been sent yet
        # Current delay of the replies [s]. One step adds at most REFUSAL_TIME, so a stall of the
        # process has little effect.
        self._held_for = 0.0
        # Clients that sent a request in the last second, ordered by the time of their last request.
        self._clients: dict[bytes, Client] = {}
        self._turns: deque[Client] = deque()  # clients with queued requests
        self._urgent: deque[Ask] = deque()
        self.count = 0  # number of queued requests, excluding urgent requests
        self._under_way = [0, 0]  # number of normal and of urgent requests that await a reply

    def fence(self, stops: int) -> None:
        """Stamp requests as older than the last stop until all earlier requests are read.

        Meanwhile, replies are delayed by at most `bounds.ANSWER_DELAY_MAX`, unless the loop ends.
        """
        if self.stops == self._fence:
            self._held_for = 0.0
        self._fence = stops
        self._since, self._arrived = max(self._since, self._clock()), 0

    def _date(self, t: float) -> None:
        """Stamp requests with time t until all requests that may be older have been read."""
        self._dated = min(self._dated, t)
        self._unread_max = bounds.CLIENT_COUNT_MAX * bounds.SOCKET_QUEUE_LENGTH

    def read(self) -> None:
        """Read requests for up to `bounds.TURN_TIME`, then forward requests and send replies."""
        began = self._clock()
        gap, self._last_poll = began - self._last_poll, began
        if gap > bounds.POLL_GAP_MAX:
            self._date(began - gap)
            self._since, self._arrived = max(self._since, began), 0
        self._held_for += min(gap, bounds.REFUSAL_TIME)
        while (now := self._clock()) < began + bounds.TURN_TIME:
            parts = read_parts(self.socket)
            if parts:
                self._take([part.bytes for part in parts], self._sockets.name(parts[-1]), now)
                continue
            # The socket is empty, but the libzmq thread may still deliver older requests. All older
            # requests count as read only after a period with few new requests.
            if now - self._since > bounds.REFUSAL_TIME:
                if self._arrived <= bounds.TOTAL_RATE * bounds.REFUSAL_TIME:
                    self.stops, self._dated = self._fence, math.inf
                self._since, self._arrived = now, 0
            break
        while self._urgent and self._under_way[True] < bounds.URGENT_UNANSWERED_MAX:
            self._forward(self._urgent.popleft())
        while self._turns and self._under_way[False] < bounds.UNANSWERED_MAX:
            client = self._turns.popleft()
            self._forward(client.waiting.popleft())
            self.count -= 1
            if client.waiting:
                self._turns.append(client)
        is_held = self.stops != self._fence and self._held_for <= bounds.ANSWER_DELAY_MAX
        if not is_held or self._channel.over:
            while self._replies:
                self._send(self._replies.popleft())

    def _take(self, parts: list[bytes], name: str, now: float) -> None:
        """Queue or refuse one client message."""
        # Like a REP socket, prefix the reply with the request's frames up to the first empty frame.
        ends = parts.index(b"", 1) + 1 if b"" in parts[1:-1] else 1
        route, payload = parts[:ends], parts[-1]
        if sum(map(len, route)) > bounds.ENVELOPE_SIZE_MAX or len(parts) > bounds.PART_COUNT_MAX:
            ends, route = 0, parts[:1]
        self._arrived += b"status" not in payload
        self._unread_max -= 1
        if self._unread_max < 0:  # All requests that arrived in the gap have been read.
            self._dated = math.inf
        client = self._clients.pop(parts[0], None) or Client()
        while self._clients and self._clients[oldest := next(iter(self._clients))].last < now - 1.0:
            del self._clients[oldest]
        self._clients[parts[0]] = client
        # The clients share the total rate only if they exceed it together.
        tokens = self._tokens + (now - self._counted) * bounds.TOTAL_RATE
        self._tokens, self._counted = max(min(tokens, bounds.TOTAL_RATE) - 1.0, 0.0), now
        share = math.inf
        if not self._tokens:
            share = max(bounds.TOTAL_RATE / len(self._clients), bounds.CLIENT_RATE_MIN)
        is_flood = client.floods(min(self._config.per_second, share), now)
        is_stop = len(payload) <= bounds.URGENT_SIZE_MAX and _PACKED_STOP.search(payload)
        urgent = bool(is_stop) and not client.urgent
        ask = Ask(min(now, self._dated), self.stops, urgent, name, route, payload)
        error = b""
        if is_flood and not urgent:
            error = self._too_many
            self.refused += 1
        elif ends + 1 != len(parts):
            error = _MALFORMED_REFUSAL
        elif len(payload) > self._config.max_bytes:
            text = (
                f"the command has {len(payload)} bytes, expected at most {self._config.max_bytes}"
            )
            error = refusal(text, Reason.REQUEST)
        elif urgent:
            client.urgent = True
            self._urgent.append(ask)
        elif (
            len(client.waiting) >= bounds.CLIENT_QUEUE_LENGTH
            or self.count >= bounds.TOTAL_QUEUE_LENGTH
        ):
            error = _QUEUE_FULL_REFUSAL
            self.refused += 1
        else:
            if not client.waiting:
                self._turns.append(client)
            client.waiting.append(ask)
            self.count += 1
        if error:
            self._replies.append([*route, error])

    def _forward(self, ask: Ask) -> None:
        self._under_way[ask.urgent] += 1
        self._channel.send(ASK, *ask)

    def reply(self, urgent: bool, route: list[bytes], reply: bytes) -> None:
        """Forward the loop's reply to the client."""
        self._under_way[urgent] -= 1
        if urgent and route[0] in self._clients:
            self._clients[route[0]].urgent = False
        self._replies.append([*route, reply])

    def _send(self, message: list[bytes]) -> None:
        with contextlib.suppress(zmq.ZMQError):  # The client may have disconnected.
            self.socket.send_multipart(message, NO_WAIT)
