"""Control a headless Chromium through DevTools: open pages and evaluate scripts.

The browser stores all data in a test folder and sends only the requests that the page makes.
"""

import json
import os
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from websockets.sync.client import connect

from tests.conftest import until

WAIT = 60.0  # timeout for one reply [s]
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--disable-gpu",  # Test machines have no graphics card.
    "--remote-debugging-port=0",
)


def browser_path() -> str | None:
    """Return the path of the installed browser, or None."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


class Browser:
    """A browser with one page; ``requests`` contains the addresses that the page requested."""

    def __init__(self, path: str, folder: Path) -> None:
        words = [*_FLAGS, f"--user-data-dir={folder}"]
        quiet: Any = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        self.process = subprocess.Popen(
            [path, *words, "about:blank"], start_new_session=True, **quiet
        )
        told = folder / "DevToolsActivePort"  # The browser writes the file once its port is open.
        until(lambda: told.exists() and "/" in told.read_text())
        pages: list[dict[str, Any]] = []

        def listed() -> bool:
            with urlopen(f"http://127.0.0.1:{told.read_text().split()[0]}/json") as answer:
                pages[:] = [each for each in json.load(answer) if each["type"] == "page"]
            return bool(pages)

        until(listed)  # The browser opens its port before its first page.
        waits: Any = {"open_timeout": WAIT, "ping_interval": None}
        url = pages[0]["webSocketDebuggerUrl"]
        self._socket = connect(url, proxy=None, max_size=None, **waits).__enter__()
        self._number = 0
        self.requests: list[str] = []
        for domain in ("Page", "Network"):
            self.ask(f"{domain}.enable")
        self.resize(1400, 900)

    def open(self, url: str) -> None:
        """Open a page."""
        self.ask("Page.navigate", url=url)

    def resize(self, width: int, height: int, ratio: int = 1) -> None:
        """Set the page size; ``ratio`` is the number of device pixels per CSS pixel."""
        size = {"width": width, "height": height, "deviceScaleFactor": ratio, "mobile": ratio > 1}
        self.ask("Emulation.setDeviceMetricsOverride", **size)

    def evaluate(self, script: str) -> Any:
        """Evaluate a JavaScript expression in the page and return its value.

        Returns None if the page is reloaded before the browser has evaluated the expression.
        """
        try:
            answer = self.ask("Runtime.evaluate", expression=script, returnByValue=True)
        except RuntimeError as error:
            if "Inspected target navigated" in str(error):
                return None
            raise
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{script}: {answer['result'].get('description')}")
        return answer["result"].get("value")

    def prefer(self, colours: str) -> None:
        """Emulate a system preference for ``dark`` or ``light`` colours."""
        feature = {"name": "prefers-color-scheme", "value": colours}
        self.ask("Emulation.setEmulatedMedia", features=[feature])

    def ask(self, method: str, **parameters: Any) -> Any:
        """Send one command and wait for its reply; raise RuntimeError if the reply is an error."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=WAIT))
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            if answer.get("method") == "Network.requestWillBeSent":
                self.requests.append(answer["params"]["request"]["url"])

    def close(self) -> None:
        """Stop the browser and its child processes."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self._socket.close()
