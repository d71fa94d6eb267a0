"""The gateway's process: bound first, then serving until the loop hangs up.

``python -m softfinger.daemon.gateway FD CONFIG``: the link's descriptor, and a `Config` as JSON.
"""

from __future__ import annotations

import os
import resource
import signal
import socket
import sys
from pathlib import Path

from softfinger.daemon.errors import AddressError, KeyFileError
from softfinger.daemon.gateway import link
from softfinger.daemon.gateway.config import Config
from softfinger.daemon.gateway.service import StartAnew, open_service

_MEMORY = 128 << 20  # bytes of data, of which Python and libzmq take a third
_DESCRIPTORS = 64  # that are not clients'
_CLIENTS = 1024
# With keys libzmq has the connections, and ends when it is out of memory: there is room for all.
_MOST_WITH_KEYS = 256
_FOR_KEYS = 48 << 20  # bytes for …
_CONNECTION = 100_000  # bytes of each, and for each message that waits for it …
_WAITING = 128  # … two of libzmq's records
_HUNG = 3.0  # s without a step after which the process is ended
_STEPS = 0.5  # s between two words that it lives


def main(words: list[str]) -> int:
    """Serve; 0 when the loop has ended, 1 when the sockets could not be bound.

    `link.ANEW` when all clients are to come in again.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the loop, whose last words it sends
    try:
        return _serve(socket.socket(fileno=int(words[0])), Config.from_json(words[1]))
    except (BrokenPipeError, ConnectionResetError):
        return 0  # the loop ended before all was told


def _serve(end: socket.socket, config: Config) -> int:
    try:
        service = open_service(end, config, _be_bounded(config))
    except (AddressError, KeyFileError) as error:
        end.send(link.FAILED + str(error).encode()[: link.LARGEST // 2])
        return 1
    end.send(link.READY)
    lived = 0.0
    try:
        while not service.over:
            service.step()
            if service.now - lived > _STEPS:
                lived = service.now
                signal.setitimer(signal.ITIMER_REAL, _HUNG)  # SIGALRM is not handled: it ends
    except StartAnew as reason:
        end.send(link.NOTICE + str(reason).encode())
        return link.ANEW
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    service.close()
    return 0


def _be_bounded(config: Config) -> int:
    """Bound memory, be the first to go when the system has none, and be no real-time process.

    Returns how many clients there is room for.
    """
    resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY, _MEMORY))
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    clients = _CLIENTS + _CLIENTS // 4
    if config.keys:
        clients = min(_FOR_KEYS // (_CONNECTION + _WAITING * config.queue), _MOST_WITH_KEYS)
    wanted = clients + _DESCRIPTORS
    if most != resource.RLIM_INFINITY:
        wanted = min(wanted, most)
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))
    try:
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except OSError:
        pass  # not worth doing without the hand
    return (wanted - _DESCRIPTORS) * 4 // 5


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
