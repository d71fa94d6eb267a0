"""A headless Chromium that a test drives through its DevTools pipe: open a page, take its picture.

Everything it keeps is in a folder of the test's; it has no network beyond what the page asks for.
"""

from __future__ import annotations

import base64
import io
import json
import os
import select
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    "--disable-gpu",  # a test machine has no graphics card
    "--remote-debugging-pipe",
)


def browser_path() -> str | None:
    """The browser on this machine, None when there is none."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page of one browser. ``requests`` are the addresses that the page asked for.

    The pipe's messages are JSON with a NUL byte after each: the browser reads them from its file
    descriptor 3 and writes to 4.
    """

    def __init__(self, path: str, folder: Path, width: int = 1600, height: int = 1000) -> None:
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        # A shell gives the browser's end of each pipe the number it looks for.
        shell = f'exec "$0" "$@" 3<&{to_read} 4>&{to_write}'
        words = [*_FLAGS, f"--user-data-dir={folder}", f"--window-size={width},{height}"]
        self._log = (folder.parent / "browser.log").open("wb")
        self.process = subprocess.Popen(
            ["/bin/bash", "-c", shell, path, *words, "about:blank"],
            pass_fds=(to_read, to_write),
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            start_new_session=True,
        )
        os.close(to_read)
        os.close(to_write)
        self._buffer = b""
        self._number = 0
        self._session = ""
        self.requests: list[str] = []
        self.blocked: list[str] = []
        targets = self.ask("Target.getTargets")["targetInfos"]
        page = next(each["targetId"] for each in targets if each["type"] == "page")
        answer = self.ask("Target.attachToTarget", targetId=page, flatten=True)
        self._session = answer["sessionId"]
        for domain in ("Page", "Network"):
            self.ask(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.ask("Emulation.setDeviceMetricsOverride", **size)

    def open(self, url: str) -> None:
        """Go to a page."""
        self.ask("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        """The value of a JavaScript expression in the page."""
        answer = self.ask("Runtime.evaluate", expression=script, returnByValue=True)
        return answer["result"].get("value")

    def picture(self, patience: float = 60.0) -> NDArray[np.uint8]:
        """What the page looks like, [height, width, 3]. A page that is just opening has no look."""
        from PIL import Image

        deadline = time.monotonic() + patience
        while True:
            try:
                data = self.ask("Page.captureScreenshot", format="png")["data"]
                break
            except RuntimeError:
                if time.monotonic() > deadline:
                    raise
                select.select([], [], [], 0.1)
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def ask(self, method: str, timeout: float = 60.0, **parameters: Any) -> Any:
        """Send one command and wait for its answer. Raises RuntimeError when it is an error."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + timeout
        while True:
            answer = self._next(deadline)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self._note(answer)

    def _note(self, event: dict[str, Any]) -> None:
        parameters = event.get("params", {})
        if event.get("method") == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif event.get("method") == "Network.loadingFailed" and "blockedReason" in parameters:
            self.blocked.append(parameters["blockedReason"])

    def _next(self, deadline: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            left = deadline - time.monotonic()
            if left <= 0.0 or not select.select([self._read], [], [], left)[0]:
                raise TimeoutError("no answer from the browser")
            piece = os.read(self._read, 1 << 20)
            if not piece:
                raise RuntimeError("the browser has ended")
            self._buffer += piece
        message, _, self._buffer = self._buffer.partition(b"\0")
        answer: dict[str, Any] = json.loads(message)
        return answer

    def close(self) -> None:
        """End the browser and the processes it started."""
        os.close(self._write)
        try:
            self.process.wait(300.0)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        os.close(self._read)
        self._log.close()
