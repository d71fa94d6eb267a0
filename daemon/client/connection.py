"""Shared by all clients: the daemon's addresses, the subscriber's socket, time-outs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import msgpack
import zmq

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.types import COMMAND_ADDRESS, STREAM_ADDRESS

PATIENCE = 5.0  # s that an answer or a first message is waited for by default
SILENCE = 1.0  # s without one after which a warning says what is waited for

_QUEUE = 100_000  # messages kept for a program that is slow for a while
_MESSAGE_LIMIT = 4_000_000  # bytes; the largest grid is 131 kB


def default_addresses() -> tuple[str, str]:
    """Return where stream and commands are, by SOFTFINGER_ADDRESS or on this machine.

    Raises SettingsError as :func:`both_addresses`.
    """
    named = os.environ.get("SOFTFINGER_ADDRESS", "").strip()
    if not named:
        return STREAM_ADDRESS, COMMAND_ADDRESS
    return both_addresses(named, "SOFTFINGER_ADDRESS")


def both_addresses(named: str, where: str) -> tuple[str, str]:
    """Return the stream's and the commands' address that one text names.

    It is ``tcp://HOST``, with the usual ports, or both addresses with a comma between them.
    Raises SettingsError, with ``where`` it stands, when it is neither.
    """
    addresses = [part.strip() for part in named.split(",")]
    if is_host(named):
        stream, commands = (
            f"{named}:{usual.rpartition(':')[2]}" for usual in (STREAM_ADDRESS, COMMAND_ADDRESS)
        )
        return stream, commands
    if len(addresses) != 2 or not all("://" in address for address in addresses):
        raise SettingsError(
            f"{where}: found {named!r}, expected tcp://HOST, or STREAM,COMMANDS as in "
            f"{STREAM_ADDRESS},{COMMAND_ADDRESS}"
        )
    return addresses[0], addresses[1]


def is_host(named: str) -> bool:
    """Return whether an address is ``tcp://HOST``, without a port."""
    alone = named.startswith("tcp://") and "," not in named
    return alone and ":" not in named[6:].split("]")[-1]


def subscribe(
    context: zmq.Context[Any], address: str, *topics: bytes, queue: int = _QUEUE
) -> zmq.Socket[Any]:
    """Return a socket subscribed to topics; ``queue`` messages wait in it for a slow program.

    Raises zmq.ZMQError when the address can't be read.
    """
    socket: zmq.Socket[Any] = context.socket(zmq.SUB)
    try:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM, queue)
        socket.setsockopt(zmq.MAXMSGSIZE, _MESSAGE_LIMIT)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
        for topic in topics:
            socket.setsockopt(zmq.SUBSCRIBE, topic)
        socket.connect(address)
    except zmq.ZMQError:
        socket.close()
        raise
    return socket


def drain(socket: zmq.Socket[Any], limit: int) -> Iterator[list[bytes]]:
    """Yield the messages that wait in a socket, at most ``limit``; never wait for one."""
    for _ in range(limit):
        try:
            yield socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return


def unpack(frames: list[bytes]) -> tuple[bytes, dict[str, Any]]:
    """Topic and map of a message. Raises ValueError when it is none."""
    try:
        topic, packed = frames
        message = msgpack.unpackb(packed)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise ValueError(f"not a message of the stream: {error}") from None
    if not isinstance(message, dict):
        raise ValueError("not a map")
    return topic, message


def still_waiting(what: str, timeout: float) -> str:
    """Return the warning about something that has not come yet."""
    return f"no {what} yet, waiting up to {round(timeout, 2):g} s"
