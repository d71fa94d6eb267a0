"""Admission of clients: pyzmq's authenticator, by the folder of keys where there is one.

Without keys it lets in everybody, but libzmq then hangs up on all who don't greet it as ZMTP 3
does: web pages among them, whose POST older versions take for messages.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import zmq
import zmq.utils.z85
from zmq.auth.thread import ThreadAuthenticator

from softfinger.daemon.errors import KeyFileError, NoDescriptor, SoftfingerError
from softfinger.daemon.gateway import bounds
from softfinger.daemon.wire.keys import ServerKeys, load_server

_DOMAIN = "softfinger"


class StartAnew(SoftfingerError):
    """All connections are to end, and clients to come in again. The message says why."""


class Admission(ThreadAuthenticator):
    """Asked by libzmq about each client. Knows the keys as the folder has them now."""

    def __init__(self, context: zmq.Context[Any], folder: Path | None) -> None:
        """``folder`` is of `softfinger keys`, None to let everybody in. Raises KeyFileError."""
        super().__init__(context)
        self._folder = folder
        self._keys: ServerKeys | None = None if folder is None else load_server(folder)
        self._look_at = 0.0
        self.start()
        if folder is not None:
            self.configure_curve_callback(_DOMAIN, self)

    def guard(self, socket: zmq.Socket[Any]) -> None:
        """Before bind: only whom this lets in."""
        if self._keys is not None:
            self._keys.guard(socket)
        # Without an authenticator nobody is let in, rather than everybody.
        socket.setsockopt(zmq.ZAP_DOMAIN, _DOMAIN.encode())
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        socket.setsockopt(zmq.HANDSHAKE_IVL, int(1e3 * bounds.HANDSHAKE))

    def callback(self, domain: str, key: bytes) -> bool:
        """Return whether a client with this key is let in; asked by the authenticator."""
        return self._keys is not None and domain == _DOMAIN and key in self._keys.clients

    def curve_user_id(self, client_public_key: bytes) -> str:
        """Return the key's name."""
        assert self._keys is not None
        return self._keys.clients.get(zmq.utils.z85.encode(client_public_key), "")

    def name(self, part: zmq.Frame) -> str:
        """Return who sent this, by the key; empty without keys."""
        return "" if self._keys is None else str(part.get("User-Id"))

    def look(self, now: float) -> None:
        """Let in who was added to the folder. Raises StartAnew when somebody was taken away."""
        if now < self._look_at:
            return
        self._look_at = now + bounds.KEYS_CHECKED
        if not self.is_alive():
            raise StartAnew("the authenticator has ended")
        if self._folder is None or self._keys is None:
            return
        try:
            try:
                found = load_server(self._folder)
            except NoDescriptor:  # strangers hold them all: nobody is let in who was not before
                found = self._keys.left(self._folder)
        except KeyFileError as error:
            raise StartAnew(str(error)) from None
        gone = [name for key, name in self._keys.clients.items() if key not in found.clients]
        if gone or found.secret != self._keys.secret:
            raise StartAnew(f"access.keys: shut out: {', '.join(gone) or 'all clients'}")
        self._keys = found
