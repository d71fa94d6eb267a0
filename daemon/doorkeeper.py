"""Who is let in: answers libzmq's question about each client (ZAP, RFC 27).

With keys, libzmq itself turns away whoever speaks no CURVE or does not know the daemon's key; only
one who does is asked about here. Without keys everybody of this machine is let in who shakes hands:
to ask at all keeps out ZMTP/1.0, which has no handshake, and whose frames a web page can imitate by
a POST. The thread sleeps otherwise.
"""

from __future__ import annotations

import threading
from collections.abc import Collection
from typing import Any

import zmq
import zmq.utils.z85

from daemon.keys import DOMAIN

_ADDRESS = "inproc://zeromq.zap.01"  # where libzmq asks, in each context
_VERSION = b"1.0"
_END = b"end"
_FRAMES = 6  # version, request, domain, address, identity, mechanism; and a key with CURVE


class Doorkeeper:
    """Lets in the clients whose public keys (Z85) it is given. Be there before any bind.

    With None for keys, every client without one.
    """

    def __init__(self, context: zmq.Context[Any], clients: Collection[bytes] | None) -> None:
        self._context = context
        self._clients = None if clients is None else {zmq.utils.z85.decode(k) for k in clients}
        self._socket: zmq.Socket[Any] = context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(_ADDRESS)
        self._thread = threading.Thread(target=self._serve, name="doorkeeper", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            frames = self._socket.recv_multipart()
            if frames == [_END]:
                self._socket.send(_END)
                break
            self._socket.send_multipart(self._answer(frames))
        self._socket.close()

    def _answer(self, frames: list[bytes]) -> list[bytes]:
        request = frames[1] if len(frames) > 1 else b""
        known = len(frames) >= _FRAMES and frames[0] == _VERSION and frames[2] == DOMAIN
        if self._clients is None:
            known = known and frames[5] == b"NULL"
        else:
            known = known and frames[5:6] == [b"CURVE"] and frames[-1] in self._clients
        status = [b"200", b"OK", b"client"] if known else [b"400", b"no key of a client", b""]
        return [_VERSION, request, *status, b""]

    def close(self) -> None:
        """End the thread; from then on nobody is let in."""
        with self._context.socket(zmq.REQ) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(_ADDRESS)
            socket.send(_END)
            socket.poll(1000)
        self._thread.join(1.0)
