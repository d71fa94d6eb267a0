"""The address of commands: requests within bounds on their way to the loop, and replies back.

A request is not unpacked here. One that looks like a stop is urgent: it goes to the loop at once,
one of each client at a time. Of all others few are on their way to the loop; the rest waits here,
where clients take turns. A client that sends more than it may a second is refused until it pauses.

Each request is stamped with the time at which it came and the number of stops that are known to
have been carried out before. libzmq's own thread reads ahead of us, so only time can tell: after a
stop, or a gap between polls, requests are stamped as if they had come before, until for a moment
none were waiting and few came. Until then answers are held back, within a bound, so that a client
that acts upon one is heard.
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
from softfinger.daemon.gateway.endpoints import NOW, Admission, Endpoint
from softfinger.daemon.wire.command_server import refusal
from softfinger.daemon.wire.loop_link import ASK, Ask

_STOP = msgpack.packb("command") + msgpack.packb("stop")  # no text can hold this
_FORM = refusal(
    "envelope: expected the command in one frame, alone or behind an empty frame that ends an "
    f"envelope of at most {bounds.PARTS - 2} frames and {bounds.ENVELOPE} bytes",
    Reason.REQUEST,
)
_FULL = refusal("too many commands wait already", Reason.BUSY)


class Client:
    """A connection: its requests that wait, and a token bucket that holds those of one second."""

    __slots__ = ("_behind", "_left", "_then", "urgent", "waiting")

    def __init__(self, per_second: float, now: float) -> None:
        self.waiting: deque[Ask] = deque()
        self.urgent = False  # an urgent request of its has not been answered
        self._behind = False  # it sent too much, and has not paused since
        self._left = per_second
        self._then = now

    def floods(self, per_second: float, now: float) -> bool:
        """Count one more request; True when it is too many, or it has not paused since."""
        passed = now - self._then
        left = min(self._left + passed * per_second, per_second) - 1.0
        self._left = max(left, 0.0)
        self._then = now
        self._behind = left < 0.0 or (self._behind and passed < bounds.REST)
        return self._behind


class CommandEndpoint(Endpoint):
    """The socket by which requests come in and answers go out."""

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
        text = f"too many commands: at most {config.per_second:g} a second"
        self._too_many = refusal(text, Reason.BUSY)
        self._send_to_loop = send_to_loop
        self._clock = clock
        self.refused = 0  # because too many came
        self.stops = 0  # stops before which what is read now cannot have come
        self._fence = 0  # stops so far
        self._looked = clock()  # time of the last poll; nothing came before the socket was bound
        self._dated: float | None = None  # time of the poll before a gap whose requests may be left
        self._left = 0  # requests that may be
        self._since = 0.0  # a stop, a gap or the last look at what came since; since then …
        self._came = 0  # … so many requests came that change something
        self._held: list[list[bytes]] = []  # answers
        self._held_for = 0.0  # s, of which each step counts PURGE at most: a stall is none
        self._clients: OrderedDict[bytes, Client] = OrderedDict()
        self._active: set[bytes] = set()  # who has sent something in this second
        self._active_until = 0.0
        self._turns: deque[Client] = deque()  # those with requests that wait
        self._urgent: deque[Ask] = deque()
        self.count = 0  # requests that wait, but for urgent ones
        self._under_way = [0, 0]  # with the loop; urgent ones
        limit = bounds.FRAMES * config.max_bytes
        super().__init__(admission, zmq.ROUTER, config.commands, "commands.address", config, limit)

    def fence(self, stops: int) -> None:
        """Stamp requests as older than the last stop until what came before it has been read."""
        self._fence = stops
        self._since, self._came = self._clock(), 0

    def read(self) -> None:
        """Take in requests, for as long as others may wait, and give the loop what it may have."""
        began = self._clock()
        if began - self._looked > bounds.GAP:
            if self._dated is None:
                self._dated = self._looked
            self._left = bounds.CLIENTS * bounds.QUEUE
            self._since, self._came = began, 0
        self._held_for += min(began - self._looked, bounds.PURGE)
        self._looked = began
        if self.stops == self._fence or self._held_for > bounds.LONGEST_HELD:
            held, self._held = self._held, []
            for answer in held:
                self._send(answer)
        while (now := self._clock()) < began + bounds.TURN:
            parts = self._parts()
            if not parts:
                self._note_empty(now)
                break
            self._take([part.bytes for part in parts], self._admission.name(parts[-1]), now)
        while self._urgent and self._under_way[True] < bounds.URGENT:
            self._pass_on(self._urgent.popleft())
        while self._turns and self._under_way[False] < bounds.UNDER_WAY:
            client = self._turns.popleft()
            self._pass_on(client.waiting.popleft())
            self.count -= 1
            if client.waiting:
                self._turns.append(client)

    def _note_empty(self, now: float) -> None:
        """Note that nothing waits: perhaps all has been read that came before a stop or a gap.

        libzmq's thread may still hand on a message. So it takes `PURGE` in which few came.
        """
        if now - self._since > bounds.PURGE:
            if self._came <= bounds.ALL_RATE * bounds.PURGE:
                self.stops, self._dated = self._fence, None
            self._since, self._came = now, 0

    def _take(self, parts: list[bytes], name: str, now: float) -> None:
        """One message of a client: it waits for its turn, or is refused."""
        # As with a REP socket, all up to the first empty frame goes back with the reply.
        ends = parts.index(b"", 1) + 1 if b"" in parts[1:-1] else 1
        route, payload = parts[:ends], parts[-1]
        if sum(map(len, route)) > bounds.ENVELOPE or len(parts) > bounds.PARTS:
            ends, route = 0, parts[:1]
        client = self._client(parts[0], now)
        self._came += b"status" not in payload
        self._left -= 1
        if self._left < 0:  # more than can have waited
            self._dated = None
        is_urgent = _STOP in payload and len(payload) <= bounds.URGENT_BYTES and not client.urgent
        if client.floods(self._share(parts[0], now), now) and not is_urgent:
            self.refused += 1
            self._answer(route, self._too_many)
        elif ends + 1 != len(parts):
            self._answer(route, _FORM)
        elif len(payload) > self._config.max_bytes:
            text = f"message of {len(payload)} bytes; at most {self._config.max_bytes}"
            self._answer(route, refusal(text, Reason.REQUEST))
        else:
            came = now if self._dated is None else self._dated
            self._queue(client, Ask(came, self.stops, is_urgent, name, route, payload))

    def _queue(self, client: Client, ask: Ask) -> None:
        if ask.urgent:
            client.urgent = True
            self._urgent.append(ask)
        elif len(client.waiting) >= bounds.WAITING_EACH or self.count >= bounds.WAITING:
            self.refused += 1
            self._answer(ask.route, _FULL)
        else:
            if not client.waiting:
                self._turns.append(client)
            client.waiting.append(ask)
            self.count += 1

    def _client(self, identity: bytes, now: float) -> Client:
        client = self._clients.get(identity)
        if client is None:
            client = self._clients[identity] = Client(self._config.per_second, now)
            if len(self._clients) > bounds.CLIENTS:
                self._clients.popitem(last=False)
        return client

    def _share(self, identity: bytes, now: float) -> float:
        """Return what each client may send in a second: less when many send."""
        if now > self._active_until:
            self._active_until = now + 1.0
            self._active.clear()
        self._active.add(identity)
        share = max(bounds.ALL_RATE / len(self._active), bounds.LEAST_RATE)
        return min(self._config.per_second, share)

    def _pass_on(self, ask: Ask) -> None:
        self._under_way[ask.urgent] += 1
        self._send_to_loop(ASK, *ask)

    def reply(self, urgent: bool, route: list[bytes], reply: bytes) -> None:
        """Take the loop's answer to a request."""
        self._under_way[urgent] -= 1
        if urgent and route[0] in self._clients:
            self._clients[route[0]].urgent = False
        self._answer(route, reply)

    def _answer(self, route: list[bytes], reply: bytes) -> None:
        """Send a reply, once what came before a stop has been read."""
        if self.stops == self._fence:
            self._send([*route, reply])
            return
        if not self._held:
            self._held_for = 0.0
        self._held.append([*route, reply])

    def _send(self, message: list[bytes]) -> None:
        with contextlib.suppress(zmq.ZMQError):  # the client has gone
            self.socket.send_multipart(message, NOW)
