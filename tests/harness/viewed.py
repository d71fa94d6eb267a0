"""Run ``softfinger view`` as a process and receive its pictures as a browser page does."""

import json
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

from websockets.sync.client import connect

from tests.harness.daemon_process import started

WAIT = 60.0  # timeout for one picture [s]


class Viewed:
    """A ``softfinger view`` process; the constructor returns once the process is serving.

    ``address`` is the page's address, ``commanding`` is the same address with the token, and
    ``query`` is the part with the token.
    ``folder`` is the working directory, where recordings are also stored.
    """

    def __init__(self, *words: str, folder: Path | None = None) -> None:
        self.process = started("view", *words, "--no-browser", "--port", "0", cwd=folder)
        self.address = self.commanding = ""
        for line in self.process.stdout:
            self.commanding = self.commanding or line.split()[1]
            self.address = line.split()[1]
            if line.rstrip().endswith(("to view the hand", "in one browser")):
                break
        self.host = urlsplit(self.address).netloc
        self.query = self.commanding.removeprefix(self.address)

    def end(self) -> str:
        """Stop the process with a signal and return its output."""
        self.process.terminate()
        said = self.process.communicate(timeout=300)[1]
        assert self.process.returncode == 0, said
        return said

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.returncode is None:
            self.process.kill()
            self.process.communicate()


def upgrade_request(host: str, path: str) -> bytes:
    """Return the HTTP request that opens a WebSocket connection."""
    return (
        f"GET {path} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
    ).encode()


def masked(text: str) -> bytes:
    """Return a client's WebSocket text frame with a zero mask."""
    data = text.encode()
    assert len(data) < 126
    return bytes([0x81, 0x80 | len(data), 0, 0, 0, 0]) + data


class Watcher:
    """WebSocket connection that requests pictures as a page does."""

    def __init__(self, host: str, query: str = "", **more: Any) -> None:
        waits: Any = {"open_timeout": WAIT, "ping_timeout": None}
        url = f"ws://{host}/pictures{query}"
        self._connection = connect(url, proxy=None, max_size=None, **waits, **more)

    def next(self) -> dict[str, Any]:
        """Return the next picture."""
        self.socket.send("")
        while True:
            message: dict[str, Any] = json.loads(self.socket.recv(timeout=WAIT))
            if "palette" not in message:
                return message
            self.scene = message

    def __enter__(self) -> Self:
        self.socket = self._connection.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()
