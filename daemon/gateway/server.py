"""Run the gateway process, in which one thread serves the loop and the clients.

The process is started as ``python -m softfinger.daemon.gateway.server FD CONFIG``, with the link's
file descriptor and a `Config` as JSON. The process first binds its sockets, and exits when the loop
disconnects.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq

from softfinger.daemon.errors import AddressError, KeyFileError
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.commands import CommandEndpoint
from softfinger.daemon.gateway.endpoints import (
    NO_WAIT,
    Admission,
    Endpoint,
    RestartNeeded,
    StreamEndpoint,
)
from softfinger.daemon.wire import loop_link
from softfinger.daemon.wire.loop_link import Channel

_TIMER_INTERVAL = 0.5  # interval between resets of the timers that end a stalled process [s]
_LATEST_TOPIC = 0  # index of the topic that is also published in single frames
# Longest time for which the authenticator thread waits for the interpreter lock during a flood [s].
_AUTHENTICATOR_WAIT = 5e-4


class Server:
    """Serve clients until the loop disconnects; call `step` repeatedly."""

    def __init__(
        self,
        channel: Channel,
        config: Config,
        clock: Callable[[], float] = loop_link.machine_time,
    ) -> None:
        """Bind the addresses in ``config``; ``channel`` is the gateway's end of the link.

        Raises
        ------
        AddressError
            If an address can't be bound.
        KeyFileError
            If the keys can't be read.
        """
        self.channel = channel
        self._clock = clock
        self._reported: tuple[int, int, int] | None = None  # most recent report to the loop
        self._context: zmq.Context[Any] = zmq.Context()
        self._admission = Admission(self._context, Path(config.keys) if config.keys else None)
        self.stream: StreamEndpoint | None = None
        self._latest: Endpoint | None = None
        self.commands: CommandEndpoint | None = None
        self._poller = zmq.Poller()
        self._poller.register(channel, zmq.POLLIN)
        try:
            if config.stream:
                self.stream = StreamEndpoint(self._admission, config)
                self._poller.register(self.stream.socket, zmq.POLLIN)
            if config.latest:
                place = config.latest, "stream.latest"
                self._latest = Endpoint(
                    self._admission, zmq.PUB, *place, config, bounds.SUBSCRIPTION_SIZE_MAX
                )
            if config.commands:
                self.commands = CommandEndpoint(self._admission, config, channel.send, clock)
                self._poller.register(self.commands.socket, zmq.POLLIN)
        except BaseException:
            self.close()
            raise

    def step(self, seconds: float = bounds.STEP_WAIT_MAX) -> None:
        """Wait up to ``seconds`` for messages from the loop or clients, and handle them."""
        self._poller.poll(int(1e3 * seconds))
        now = self._clock()
        self._admission.look(now)
        for kind, *fields in self.channel.receive():
            if kind == loop_link.PUBLISH and self.stream is not None:
                self.stream.publish(*fields)
                if self._latest is not None and fields[0] == _LATEST_TOPIC:
                    self._latest.socket.send(fields[2], NO_WAIT)
            elif kind == loop_link.REPLY and self.commands is not None:
                self.commands.reply(*fields)
            elif kind == loop_link.FENCE and self.commands is not None:
                self.commands.fence(*fields)
        wanted = refused = stops = 0
        if self.stream is not None:
            self.stream.read(now)
            wanted = self.stream.wanted | (self._latest is not None) << _LATEST_TOPIC
        if self.commands is not None:
            self.commands.read()
            refused, stops = self.commands.refused, self.commands.stops
        if (wanted, refused, stops) != self._reported:
            self._reported = wanted, refused, stops
            self.channel.send(loop_link.REPORT, *self._reported)
        self.channel.flush()

    def close(self) -> None:
        """Send queued messages for up to `bounds.LINGER_TIME`, then disconnect all clients."""
        for endpoint in (self.stream, self._latest, self.commands):
            if endpoint is not None:
                endpoint.close()
        self._admission.stop()
        self._context.term()


def main(words: list[str]) -> int:
    """Serve clients until the loop ends, and return the exit status.

    Returns
    -------
    int
        0 if the loop has ended, 1 if the sockets could not be bound, `loop_link.RESTART_STATUS` if
        all clients must reconnect.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # The loop's last messages must still be sent.
    channel = Channel(socket.socket(fileno=int(words[0])))
    try:
        _be_bounded()
        server = Server(channel, Config(*json.loads(words[1])))
    except (AddressError, KeyFileError) as error:
        channel.send(loop_link.FAILED, str(error))
        return 1
    sys.setswitchinterval(_AUTHENTICATOR_WAIT)
    channel.send(loop_link.READY)
    lived = 0.0
    try:
        while not channel.over:
            server.step()
            now = time.monotonic()
            if now - lived > _TIMER_INTERVAL:
                lived = now
                # SIGPROF and SIGALRM have no handlers, so these signals end the process.
                signal.setitimer(signal.ITIMER_PROF, bounds.STEP_CPU_TIME_MAX)
                signal.setitimer(signal.ITIMER_REAL, bounds.STEP_TIME_MAX)
    except RestartNeeded as reason:
        channel.send(loop_link.NOTICE, str(reason))
        return loop_link.RESTART_STATUS
    server.close()
    return 0


def _be_bounded() -> None:
    """Limit memory and file descriptors, raise the OOM score, and drop real-time scheduling."""
    resource.setrlimit(resource.RLIMIT_DATA, (bounds.MEMORY_MAX, bounds.MEMORY_MAX))
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = bounds.CLIENT_COUNT_MAX + bounds.DESCRIPTOR_COUNT
    if most != resource.RLIM_INFINITY:
        wanted = min(wanted, most)
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))
    try:
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except OSError:
        pass  # The daemon also works without these two measures.


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
