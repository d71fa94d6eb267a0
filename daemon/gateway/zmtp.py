"""ZMTP 3.0 with the mechanism NULL: the bytes of a connection, and nothing that reads or sends.

For clients without keys, on sockets of our own, since libzmq can bound neither a message's parts
nor a client's subscriptions, and can't say what arrived before a stop. A peer of ZMTP 1.0 or 2.0,
or of no ZMTP at all, as a browser is, breaks the protocol with its first bytes. Source:
https://rfc.zeromq.org/spec/23/
"""

from __future__ import annotations

from softfinger.daemon.errors import SoftfingerError

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)

_MORE, _LONG, _COMMAND = 1, 2, 4
_HEAD = 2  # bytes of a short frame's head
_LONG_HEAD = 9


class Broken(SoftfingerError):
    """The peer does not keep to the protocol, or to our bounds: it is disconnected."""


def frame(body: bytes, more: bool = False) -> bytes:
    """One part of a message on the wire."""
    return _head(len(body), _MORE if more else 0) + body


def ready(kind: bytes) -> bytes:
    """The command that ends the handshake; ``kind`` is our socket's type."""
    body = b"\x05READY" + _property(b"Socket-Type", kind) + _property(b"Identity", b"")
    return _head(len(body), _COMMAND) + body


def pong(ping: bytes) -> bytes:
    """The answer to the body of a PING."""
    body = b"\x04PONG" + ping[7:23]  # behind the name and the time to live
    return _head(len(body), _COMMAND) + body


def _head(size: int, flags: int) -> bytes:
    if size < 256:
        return bytes((flags, size))
    return bytes((flags | _LONG,)) + size.to_bytes(8, "big")


def _property(name: bytes, value: bytes) -> bytes:
    return bytes((len(name),)) + name + len(value).to_bytes(4, "big") + value


def socket_type(command: bytes) -> bytes:
    """The peer's socket type, from the body of its READY. Raises Broken."""
    if not command.startswith(b"\x05READY"):
        raise Broken("no READY")
    at = 6
    while at < len(command):
        name_end = at + 1 + command[at]
        name = command[at + 1 : name_end]
        at = name_end + 4 + int.from_bytes(command[name_end : name_end + 4], "big")
        if name.lower() == b"socket-type":
            return command[name_end + 4 : at]
    raise Broken("no socket type")


class FrameParser:
    """Takes a connection's bytes, gives its frames. Holds no more than one frame and one read."""

    def __init__(self, limit: int) -> None:
        """``limit`` bounds a frame [bytes]."""
        self._limit = limit
        self._buffer = bytearray()
        self._greeted = False

    @property
    def empty(self) -> bool:
        """No frame has begun."""
        return not self._buffer

    def feed(self, data: bytes) -> list[tuple[bool, bool, bytes]]:
        """The frames that are complete now: is a command, more parts follow, body. Raises Broken.

        What is no ZMTP breaks with its first byte, before anything of it is kept.
        """
        buffer = self._buffer
        buffer += data
        if not self._greeted and not self._greet():
            return []
        frames = []
        at, end = 0, len(buffer)
        while end - at >= _HEAD:
            flags = buffer[at]
            if flags & ~(_MORE | _LONG | _COMMAND):
                raise Broken("no frame")
            body = at + _HEAD
            size = buffer[at + 1]
            if flags & _LONG:
                body = at + _LONG_HEAD
                if body > end:
                    break
                size = int.from_bytes(buffer[at + 1 : body], "big")
            if size > self._limit:
                raise Broken(f"a frame of {size} bytes")
            if body + size > end:
                break
            at = body + size
            frames.append((bool(flags & _COMMAND), bool(flags & _MORE), bytes(buffer[body:at])))
        del buffer[:at]
        return frames

    def _greet(self) -> bool:
        """Check as much of the greeting as has come; True when it is whole."""
        buffer = self._buffer
        if (buffer and buffer[0] != 0xFF) or (len(buffer) > 9 and buffer[9] != 0x7F):
            raise Broken("no ZMTP")
        if len(buffer) > 10 and buffer[10] < 3:
            raise Broken(f"ZMTP {buffer[10]}")
        if len(buffer) < len(GREETING):
            return False
        if buffer[12:32].rstrip(b"\0") != b"NULL":
            raise Broken("another mechanism")
        del buffer[: len(GREETING)]
        self._greeted = True
        return True
