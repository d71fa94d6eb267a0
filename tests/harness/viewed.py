"""``softfinger view`` in a process of its own, and its pictures as a page gets them."""

import json
import subprocess
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

from websockets.sync.client import connect

from tests.harness.daemon_process import SOFTFINGER

WAIT = 60.0  # s for one picture


class Viewed:
    """Serving when constructed. ``address`` is the page's, ``commanding`` that with the token.

    ``folder``: where it runs, and records.
    """

    def __init__(self, *words: str, folder: Path | None = None) -> None:
        self.process = subprocess.Popen(
            [*SOFTFINGER, "view", *words, "--no-browser", "--port", "0"],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.address = self.commanding = ""
        for line in self.process.stdout:
            self.commanding = self.commanding or line.split()[1]
            self.address = line.split()[1]
            if line.rstrip().endswith(("to see it", "in one browser")):
                break
        self.host = urlsplit(self.address).netloc

    def end(self) -> str:
        """End it as a signal does, and return what it said."""
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


class Watcher:
    """A page's connection: asks for pictures."""

    def __init__(self, host: str, query: str = "", **more: Any) -> None:
        waits: Any = {"open_timeout": WAIT, "ping_timeout": None}
        url = f"ws://{host}/pictures{query}"
        self._connection = connect(url, proxy=None, max_size=None, **waits, **more)

    def next(self) -> dict[str, Any]:
        """The next picture."""
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
