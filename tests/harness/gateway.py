"""Run a gateway step by step in the test process."""

from __future__ import annotations

import select
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.server import Server
from softfinger.daemon.wire import loop_link
from softfinger.daemon.wire.command_server import CommandServer, Handler
from softfinger.daemon.wire.publisher import GATEWAY_TOPICS, Publisher
from tests.conftest import until


class Served:
    """A gateway and the loop's end of its link; clients connect to the gateway."""

    def __init__(
        self,
        stream: str = "",
        commands: str = "",
        *,
        queue: int = 2000,
        max_bytes: int = 200,
        per_second: float = 1e6,
        ipc_mode: int = 0o600,
        keys: str = "",
        latest: str = "",
        restarted: bool = False,
        clock: VirtualClock | None = None,
        link: loop_link.Link | None = None,
    ) -> None:
        self.link = link or loop_link.Link()
        ours, theirs = loop_link.pair()
        config = Config(
            *(stream, commands, GATEWAY_TOPICS, queue, max_bytes, per_second, ipc_mode, keys),
            latest=latest,
            restarted=restarted,
            stops=self.link.confirmed,
        )
        try:
            now = loop_link.machine_time if clock is None else clock.now
            self.service = Server(loop_link.Channel(theirs), config, now)
        except BaseException:
            ours.close()
            theirs.close()
            raise
        self.link.offer(loop_link.Channel(ours))
        self.publisher = Publisher(self.link)
        self.server = CommandServer(self.link, clock=now)
        self._clock = clock
        self.settle()
        until(lambda: not commands or restarted or self._is_open())

    def _is_open(self) -> bool:
        """Return True if incoming commands are executed."""
        if self._clock is not None:
            self._clock.sleep_until(self._clock.now() + bounds.REFUSAL_TIME)
        self.settle()
        return self.link.confirmed == self.link.stops

    def settle(self, times: int = 3) -> None:
        """Deliver all messages that are in transit on the link."""
        for _ in range(times):
            self.service.step(0.0)
            self.link.look()
        # The gateway reads a long message in several steps.
        while select.select([self.service.channel], [], [], 0)[0]:
            self.service.step(0.0)

    def has_request(self) -> bool:
        """Authenticate new clients, and return True if libzmq has received a request."""
        self.service._sockets.authenticate(0.0)
        return bool(self.service.commands.socket.poll(0))

    def serve(self, handler: Handler) -> None:
        """Run a gateway step, a loop tick, and another gateway step that sends the replies."""
        self.service.step(0.0)
        self.server.serve(handler)
        self.service.step(0.0)

    def settle_until(self, condition: Callable[[], object]) -> None:
        """Deliver messages until ``condition`` is true."""
        until(lambda: self.settle(1) or condition())

    def serve_until(self, handler: Handler, condition: Callable[[], object]) -> None:
        """Serve commands until ``condition`` is true."""
        until(lambda: self.serve(handler) or condition())

    @contextmanager
    def serving(self, handler: Handler) -> Iterator[None]:
        """Serve commands in a thread."""
        over = threading.Event()

        def serve() -> None:
            while not over.is_set():
                self.service.step(0.001)
                self.server.serve(handler)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def close(self) -> None:
        self.link.close()
        self.service.close()
        self.service.channel.close()

    def __enter__(self) -> Served:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()
