"""Provide daemon addresses, subscriber sockets and timeouts for all clients."""

from __future__ import annotations

import math
import os
import re
import threading
from collections.abc import Iterator
from socket import getaddrinfo
from typing import Any

import msgpack
import zmq

from softfinger.daemon.errors import SettingsError, WrongThread
from softfinger.daemon.types import COMMAND_ADDRESS, STREAM_ADDRESS

REPLY_TIMEOUT = 5.0  # default timeout for a reply or the first message [s]
SILENCE_TIME = 1.0  # time without a message before a warning is logged [s]

_WAIT_MAX = 1e6  # longest single wait [s]; ZeroMQ accepts less than 2³¹ ms
_QUEUE_LENGTH = 100_000  # maximum number of messages queued for a slow program
# Maximum message size [bytes]. A tactile frame with the largest grid is 131 kB.
_MESSAGE_SIZE_MAX = 4_000_000

# A source address and a semicolon may precede the host.
_TCP = re.compile(r"tcp://(?:.*;)?(.*):([0-9]{1,5})")
_IPC = re.compile(r"ipc://.{1,107}")  # The operating system limits the length of a socket's path.


def both_addresses(named: str = "") -> tuple[str, str]:
    """Parse the stream address and the command address from ``named``.

    The string ``tcp://HOST`` selects the default ports. Otherwise, ``named`` contains both
    addresses, separated by a comma. An empty string selects SOFTFINGER_ADDRESS or, if the variable
    is not set, the default addresses. Raises SettingsError if the string has any other form.
    """
    where = "address"
    if not named:
        where = "SOFTFINGER_ADDRESS"
        named = os.environ.get(where, "").strip() or f"{STREAM_ADDRESS},{COMMAND_ADDRESS}"
    addresses = [part.strip() for part in named.split(",")]
    if is_host(named):
        stream, commands = (
            f"{named}:{usual.rpartition(':')[2]}" for usual in (STREAM_ADDRESS, COMMAND_ADDRESS)
        )
        return stream, commands
    if len(addresses) != 2 or not all("://" in address for address in addresses):
        raise SettingsError(
            f"{where}: found {named!r}, expected tcp://HOST or STREAM,COMMANDS, for example "
            f"{STREAM_ADDRESS},{COMMAND_ADDRESS}"
        )
    return addresses[0], addresses[1]


def is_host(named: str) -> bool:
    """Return True if an address has the form ``tcp://HOST``, without a port."""
    alone = named.startswith("tcp://") and "," not in named
    return alone and ":" not in named[6:].split("]")[-1]


def require_address(address: str) -> None:
    """Raise SettingsError if an address is malformed, or if this machine cannot resolve its host.

    If the host is unknown or the port is too large, ZeroMQ reports no error and keeps trying to
    connect.
    """
    tcp = _TCP.fullmatch(address)
    if not (tcp and 0 < int(tcp[2]) < 65536) and not _IPC.fullmatch(address):
        raise SettingsError(
            f"{address}: malformed address; expected tcp://HOST:PORT with a port from 1 to 65535, "
            "or ipc://PATH with at most 107 characters"
        )
    if tcp is None:
        return
    host = tcp[1].strip("[]")
    try:
        getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or "not a host name"
        raise SettingsError(
            f"{address}: unknown host {host!r} ({why}); expected an IP address or a host name "
            "that this machine can resolve"
        ) from None


class OneThread:
    """Guard that allows only one thread to use the sockets of a `Hand`.

    The first thread that uses the sockets owns them until the thread ends. If two threads use
    one ZeroMQ socket, messages may be lost or the process may abort.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._owner: threading.Thread | None = None

    def claim(self) -> None:
        """Make the current thread the owner. Raises WrongThread if another thread is the owner."""
        thread = threading.current_thread()
        with self._lock:
            if self._owner is None or not self._owner.is_alive():
                self._owner = thread
            owner = self._owner
        if owner is not thread:
            raise WrongThread(
                f"thread {thread.name}: thread {owner.name} already uses the stream of this Hand, "
                "and only one thread can use a stream; create another Hand in "
                "each additional thread"
            )


def subscribe(
    context: zmq.Context[Any], address: str, *topics: bytes, queue: int = _QUEUE_LENGTH
) -> zmq.Socket[Any]:
    """Create a socket that subscribes to ``topics`` and queues up to ``queue`` messages.

    Raises zmq.ZMQError if the address is malformed.
    """
    socket: zmq.Socket[Any] = context.socket(zmq.SUB)
    try:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM, queue)
        socket.setsockopt(zmq.MAXMSGSIZE, _MESSAGE_SIZE_MAX)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
        for topic in topics:
            socket.setsockopt(zmq.SUBSCRIBE, topic)
        socket.setsockopt(zmq.IPV6, int("[" in address))
        socket.connect(address)
    except zmq.ZMQError:
        socket.close()
        raise
    return socket


def drain(socket: zmq.Socket[Any], limit: int) -> Iterator[list[bytes]]:
    """Yield up to ``limit`` queued messages from a socket, without waiting."""
    for _ in range(limit):
        try:
            yield socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return


def unpack(frames: list[bytes]) -> tuple[bytes, dict[str, Any]]:
    """Unpack a stream message into a topic and a dict. Raises ValueError for an invalid message."""
    try:
        topic, packed = frames
        message = msgpack.unpackb(packed)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise ValueError(f"not a stream message: {error}") from None
    if not isinstance(message, dict):
        raise ValueError("not a map")
    return topic, message


def milliseconds(seconds: float) -> int:
    """Convert a waiting time to the argument of `zmq.Socket.poll`.

    A negative time becomes 0, because ZeroMQ would wait forever. A time of more than 10⁶ s is
    shortened.
    """
    return math.ceil(1e3 * min(max(seconds, 0.0), _WAIT_MAX))


def still_waiting(what: str, timeout: float) -> str:
    """Return the text of the warning that is logged while a client waits for data."""
    return f"no {what} yet; waiting up to {round(timeout, 2):g} s"
