"""The gateway's process: bound first, then serving until the loop hangs up.

``python -m softfinger.daemon.gateway FD CONFIG``: the link's descriptor, and a `Config` as JSON.
"""

from __future__ import annotations

import os
import resource
import signal
import socket
import sys
import time
from pathlib import Path

from softfinger.daemon.errors import AddressError, KeyFileError
from softfinger.daemon.gateway import bounds
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.endpoints import StartAnew
from softfinger.daemon.gateway.server import Server
from softfinger.daemon.wire import loop_link

_STEPS = 0.5  # s between two words that it lives
_TURN = 5e-4  # s that the authenticator waits for the interpreter while requests flood


def main(words: list[str]) -> int:
    """Serve; 0 when the loop has ended, 1 when the sockets could not be bound.

    `loop_link.ANEW` when all clients are to come in again.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the loop, whose last words it sends
    try:
        return _serve(socket.socket(fileno=int(words[0])), Config.from_json(words[1]))
    except (BrokenPipeError, ConnectionResetError):
        return 0  # the loop ended before all was sent


def _serve(end: socket.socket, config: Config) -> int:
    try:
        _be_bounded()
        server = Server(end, config, longest_pause=bounds.PAUSE)
    except (AddressError, KeyFileError) as error:
        end.send(loop_link.FAILED + str(error).encode()[: loop_link.LARGEST // 2])
        return 1
    sys.setswitchinterval(_TURN)
    end.send(loop_link.READY)
    lived = 0.0
    try:
        while not server.over:
            server.step()
            now = time.monotonic()
            if now - lived > _STEPS:
                lived = now
                # Neither SIGPROF nor SIGALRM is handled: each ends it.
                signal.setitimer(signal.ITIMER_PROF, bounds.STALLED)
                signal.setitimer(signal.ITIMER_REAL, bounds.BLOCKED)
    except StartAnew as reason:
        end.send(loop_link.NOTICE + str(reason).encode())
        return loop_link.ANEW
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    server.close()
    return 0


def _be_bounded() -> None:
    """Bound memory, be the first to go when the system has none, and be no real-time process."""
    resource.setrlimit(resource.RLIMIT_DATA, (bounds.MEMORY, bounds.MEMORY))
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = bounds.CLIENTS + bounds.DESCRIPTORS
    if most != resource.RLIM_INFINITY:
        wanted = min(wanted, most)
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))
    try:
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except OSError:
        pass  # not worth doing without the hand


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
