"""Run the gateway process. One thread serves the loop and the clients.

The process is started as ``python -m softfinger.daemon.gateway.server FD CONFIG``. FD is the file
descriptor of the link, and CONFIG is a `Config` as JSON. The process prints `READY` once its
sockets are bound, and exits when the loop disconnects. If an error occurs, the process prints the
error and exits.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path

import zmq

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.commands import CommandEndpoint
from softfinger.daemon.gateway.endpoints import ClientSockets, StreamEndpoint
from softfinger.daemon.wire.loop_link import (
    FENCE,
    PUBLISH,
    REPLY,
    REPORT,
    Channel,
    machine_time,
)


class Server:
    """Server for the loop and the clients; call `step` until the loop disconnects."""

    def __init__(
        self, channel: Channel, config: bounds.Config, clock: Callable[[], float] = machine_time
    ) -> None:
        """Bind the addresses in ``config``; ``channel`` is the gateway's end of the link.

        Raises AddressError, or KeyFileError if the keys can't be read.
        """
        self.channel = channel
        self._clock = clock
        self._sockets = ClientSockets(config)
        try:
            self.stream = StreamEndpoint(self._sockets, config)
            self.commands = CommandEndpoint(self._sockets, config, channel, clock)
        except BaseException:
            self.close()
            raise
        self._reported: tuple[int, ...] = ()
        self._take: dict[str, Callable[..., None]] = {
            PUBLISH: self.stream.publish,
            REPLY: self.commands.reply,
            FENCE: self.commands.fence,
        }
        self._poller = zmq.Poller()
        endpoints = self._sockets.handshakes, self.stream.socket, self.commands.socket
        for each in (channel, *endpoints):
            self._poller.register(each, zmq.POLLIN)

    def step(self, seconds: float = bounds.STEP_WAIT_MAX) -> None:
        """Wait up to ``seconds`` for messages from the loop or clients, and handle them.

        Raises KeyFileError if a key was removed or is unusable; all clients must then reconnect.
        """
        self._poller.poll(int(1e3 * seconds))
        now = self._clock()
        self._sockets.authenticate(now)
        for kind, *fields in self.channel.receive():
            self._take[kind](*fields)
        wanted = self.stream.read(now)
        self.commands.read()
        report = wanted, self.commands.refused, self.commands.stops
        if report != self._reported:
            self._reported = report
            self.channel.send(REPORT, *report)
        self.channel.flush()

    def close(self) -> None:
        """Send queued messages for a short time, then disconnect all clients."""
        self._sockets.close()


def main(words: list[str]) -> int:
    """Serve clients until the loop disconnects.

    Returns 1 if the sockets could not be bound or if all clients must reconnect, otherwise 0.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # Stay alive to send the loop's last messages.
    channel = Channel(socket.socket(fileno=int(words[0])))
    _limit_resources()
    try:
        with contextlib.closing(Server(channel, bounds.Config(*json.loads(words[1])))) as server:
            _tell_supervisor(bounds.READY)
            while not channel.over:
                server.step()
                # SIGPROF and SIGALRM have no handlers, so these signals end the process.
                signal.setitimer(signal.ITIMER_PROF, bounds.STEP_CPU_TIME_MAX)
                signal.setitimer(signal.ITIMER_REAL, bounds.STEP_TIME_MAX)
    except SoftfingerError as reason:
        _tell_supervisor(str(reason))
        return 1
    return 0


def _tell_supervisor(text: str) -> None:
    with contextlib.suppress(BrokenPipeError):  # The daemon has exited.
        os.write(sys.stdout.fileno(), f"{text}\n".encode())


def _limit_resources() -> None:
    """Limit memory and file descriptors, raise the OOM score, and drop real-time scheduling."""
    resource.setrlimit(resource.RLIMIT_DATA, (bounds.MEMORY_MAX, bounds.MEMORY_MAX))
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = min(bounds.CLIENT_COUNT_MAX + bounds.DESCRIPTOR_COUNT, most)
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))
    with contextlib.suppress(OSError):  # The OOM score and the scheduling policy are optional.
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
