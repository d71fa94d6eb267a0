"""Notifications to systemd (sd_notify): ready, alive, stopping; nothing without it.

Each is one datagram. The loop calls `Service.alive` at every tick, which sends a few times within
the watchdog's time and is a comparison otherwise.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

_SHARE = 0.25  # of the watchdog's time between two signs of life
_NEVER = float("inf")


class Service:
    """The other end is the socket in ``NOTIFY_SOCKET``. Nothing here waits, and nothing raises."""

    def __init__(self, address: str, watchdog: float = 0.0) -> None:
        """``watchdog`` [s] is the time without a sign of life after which systemd acts; 0: none."""
        # A name that begins with @ is abstract: its first byte is zero.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._every = watchdog * _SHARE if watchdog > 0.0 else _NEVER
        self._due = -_NEVER
        self._ready = False
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)

    @classmethod
    def of_environment(cls, environment: Mapping[str, str] = os.environ) -> Service | None:
        """The service that this process is, None when it is none."""
        address = environment.get("NOTIFY_SOCKET", "")
        if address[:1] not in ("/", "@") or len(address) < 2:
            return None
        wanted = environment.get("WATCHDOG_USEC", "")
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog = int(wanted) * 1e-6 if mine and wanted.isdecimal() else 0.0
        return cls(address, watchdog)

    def alive(self, t: float) -> None:
        """A sign of life at time ``t`` [s], sent when one is due; the first one says ready."""
        if t < self._due:
            return
        self._due = t + self._every
        message = b"WATCHDOG=1" if self._ready else b"READY=1\nWATCHDOG=1"
        self._ready = True
        self._send(message)

    def stopping(self) -> None:
        """The end has begun."""
        self._send(b"STOPPING=1")

    def close(self) -> None:
        self._socket.close()

    def _send(self, message: bytes) -> None:
        try:
            self._socket.sendto(message, self._address)
        except OSError:
            pass  # nobody listens, or not now
