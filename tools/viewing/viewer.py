"""Rerun's viewer as a child process: its window, or its web viewer behind a page of ours.

All its sockets are on the loopback, its memory is bounded, and it ends with this process, whatever
ends this one. It reaches no other machine, for news, examples or its makers' usage statistics: the
window by its environment, the web viewer by what the page is allowed to (`viewing.page`).
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import IO

from softfinger.tools.viewing.errors import NoRerun, ViewError
from softfinger.tools.viewing.page import Page, viewer_address

LOOPBACK = "127.0.0.1"
_START = 20.0  # s that a viewer may take until it listens
_NOWHERE = f"http://{LOOPBACK}:9"  # a proxy that is none: what would go out ends here
_QUIET = {
    **{"CI": "1", "RERUN_APP_ONLY": "true", "RUST_LOG": "error"},
    **dict.fromkeys(("ALL_PROXY", "HTTPS_PROXY", "HTTP_PROXY"), _NOWHERE),
}
_PR_SET_PDEATHSIG = 1  # from <sys/prctl.h>


class Viewer:
    """A running viewer, to be closed or used as a context.

    ``url`` is where data goes to, ``receiver`` its port, ``address`` where a browser looks.
    """

    def __init__(self, window: bool, memory: float, port: int = 0) -> None:
        """Start it, with ``memory`` [MB] at most; ``port`` is the page's, 0 takes a free one.

        Raises ViewError when it does not come up.
        """
        self.page: Page | None = None
        if window and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise ViewError("no display for a window here: add --web, or --save FILE.rrd")
        self.receiver, hidden = free_port(), free_port()
        bound = f"{max(memory, 1.0):.0f}MB"
        words = [str(_program()), "--bind", LOOPBACK, "--port", str(self.receiver)]
        words += ["--server-memory-limit", bound]
        if window:
            words += ["--memory-limit", bound, "--hide-welcome-screen"]
        else:
            words += ["--serve-web", "--web-viewer-port", str(hidden)]
        self._said: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  closed with the viewer
        self._process = subprocess.Popen(
            words,
            env={**os.environ, **_QUIET},
            stdin=subprocess.DEVNULL,
            stdout=self._said,
            stderr=self._said,
            preexec_fn=_end_with_parent,
        )
        self.url = f"rerun+http://{LOOPBACK}:{self.receiver}/proxy"
        try:
            self._until_listening(self.receiver)
            if not window:
                self._until_listening(hidden)
                self.page = Page(port, hidden, self.receiver)
        except BaseException:
            self.close()
            raise

    @property
    def address(self) -> str:
        """Where a browser finds it; empty for a window."""
        return "" if self.page is None else viewer_address(self.page.port)

    def running(self) -> bool:
        """False once its window was closed, or it has died."""
        return self._process.poll() is None

    def failure(self) -> str:
        """What it said when it ended by itself, empty when that was in order."""
        status = self._process.poll()
        if not status:
            return ""
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        return f"the viewer has ended ({status}){': ' + lines[-1] if lines else ''}"

    def close(self) -> None:
        """End it."""
        if self.page is not None:
            self.page.close()
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(3.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._process.wait()
        self._said.close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _until_listening(self, port: int) -> None:
        deadline = time.monotonic() + _START
        while True:
            try:
                socket.create_connection((LOOPBACK, port), 1.0).close()
                return
            except OSError:
                if not self.running():
                    raise ViewError(self.failure() or "the viewer has ended at once") from None
                if time.monotonic() > deadline:
                    raise ViewError(f"the viewer does not listen after {_START:g} s") from None
                time.sleep(0.02)


def free_port() -> int:
    """A port of the loopback that nobody listens at."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port: int = probe.getsockname()[1]
    return port


def is_free(port: int) -> bool:
    """Nobody listens at this port of the loopback."""
    with socket.socket() as probe:
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return False
    return True


def resident() -> float:
    """Memory of this process [MB]; 0 where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0.0
    return 1e-6 * pages * resource.getpagesize()


def _program() -> Path:
    try:
        import rerun_cli
    except ImportError:
        raise NoRerun from None
    program = Path(str(rerun_cli.__file__)).parent / "rerun"
    if not program.exists():
        raise ViewError(f"{program}: not there; install rerun-sdk again")
    return program


def _end_with_parent() -> None:
    """In the child: end when the parent does, be deaf to its terminal's Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
