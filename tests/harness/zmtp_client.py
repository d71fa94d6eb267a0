"""A client that speaks ZMTP over a plain socket: what it sends has arrived when `send` returns."""

from __future__ import annotations

import contextlib
import socket
import struct
from typing import Any

import msgpack

from softfinger.daemon.gateway.zmtp import GREETING, FrameParser, frame


def ready(kind: bytes) -> bytes:
    body = b"\x05READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
    return bytes((4, len(body))) + body


class RawClient:
    """Connected, and its handshake sent; it waits for nothing."""

    def __init__(self, address: str, kind: bytes, first: bytes | None = None) -> None:
        """``kind`` is its socket's type; ``first`` is sent instead of a good handshake."""
        scheme, _, place = address.partition("://")
        if scheme == "ipc":
            self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            self.socket.connect(place)
        else:
            host, _, port = place.rpartition(":")
            self.socket = socket.create_connection((host, int(port)))
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket.setblocking(False)
        self._parser = FrameParser(1 << 20)
        self.send(GREETING + ready(kind) if first is None else first)

    def send(self, data: bytes) -> None:
        """Bytes, all of them. Raises OSError when it was hung up on, or there is no room."""
        self.socket.settimeout(60.0)
        self.socket.sendall(data)
        self.socket.setblocking(False)

    def ask(self, **request: Any) -> None:
        """One request."""
        self.send(frame(b"", more=True) + frame(msgpack.packb(request)))

    def replies(self) -> list[dict[str, Any]]:
        """The answers that have come."""
        found = []
        with contextlib.suppress(BlockingIOError):
            while data := self.socket.recv(65536):
                for command, more, body in self._parser.feed(data):
                    if not command and not more:
                        found.append(msgpack.unpackb(body))
        return found

    def read(self) -> bytes:
        """The bytes that have come."""
        try:
            return self.socket.recv(65536)
        except BlockingIOError:
            return b""

    def hung_up(self) -> bool:
        """Whether the other side has ended the connection."""
        try:
            while self.socket.recv(65536):
                pass
        except BlockingIOError:
            return False
        except ConnectionError:
            pass
        return True

    def close(self) -> None:
        self.socket.close()
