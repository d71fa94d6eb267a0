"""One command to a daemon from outside, and its answer."""

from __future__ import annotations

import logging
import math
from typing import Any

import msgpack
import zmq

from softfinger.daemon.client.patience import PATIENCE, SILENCE, answer_to, still_waiting
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.wire.keys import ClientKeys
from softfinger.daemon.wire.local_stop import stop_locally

_log = logging.getLogger(__name__)

LOCALLY = 0.5  # s for a daemon to answer past all other clients


class NoAnswer(SoftfingerError):
    """The daemon did not answer in time."""


def send(
    address: str, request: dict[str, Any], timeout: float = PATIENCE, keys: ClientKeys | None = None
) -> dict[str, Any]:
    """Send one command and return the reply. Raises NoAnswer after ``timeout`` s.

    A warning is logged when that takes long, which without handlers goes to standard error.
    A ``stop`` to a daemon of this user on this machine goes past all other clients.
    """
    if request.get("command") == "stop":
        stopped = stop_locally(address, min(timeout, LOCALLY))
        if stopped is not None:
            return stopped
    context: zmq.Context[Any] = zmq.Context()
    socket = context.socket(zmq.REQ)
    socket.setsockopt(zmq.LINGER, 0)
    try:
        if keys is not None:
            keys.guard(socket)
        try:
            socket.connect(address)
        except zmq.ZMQError as error:
            raise NoAnswer(f"{address}: {error}") from None
        socket.send(msgpack.packb(request))
        silence = min(SILENCE, timeout)
        answered = socket.poll(math.ceil(silence * 1e3))
        if not answered and silence < timeout:
            _log.warning(still_waiting(answer_to(request, address), timeout))
            answered = socket.poll(math.ceil((timeout - silence) * 1e3))
        if not answered:
            hint = " (with access.keys it needs keys: --keys, keys=)" if keys is None else ""
            raise NoAnswer(
                f"no {answer_to(request, address)} within {timeout:g} s; is softfinger running, "
                f"or still starting?{hint}"
            )
        reply = msgpack.unpackb(socket.recv(), raw=False)
    finally:
        socket.close()
        context.term()
    if not isinstance(reply, dict):
        raise NoAnswer(f"{address} answered something that is not a reply")
    return reply
