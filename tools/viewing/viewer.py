"""Rerun's viewer as a child process: its window, or its web viewer behind our page.

All its sockets are on the loopback, its memory is bounded, and it ends with this process, whatever
ends that. It reaches no other machine, for fonts, news, examples or usage statistics: the window by
its environment, the web viewer by a policy. A proxy of the viewer's own server adds it, by which
the browser reaches this machine only.
"""

from __future__ import annotations

import contextlib
import ctypes
import http.client
import os
import random
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import IO
from urllib.parse import quote, urlsplit

import rerun_cli

from softfinger.tools.viewing.live_stream import LOOPBACK, ViewError

_FILE = re.compile(r"/([\w-]+(\.[\w-]+)*)?")
_PASSED_ON = ("Content-Type", "Content-Length", "rerun-final-length")
_HOSTS = ("127.0.0.1", "localhost")
_PAGE = 9090  # the page's port where nobody says another
_PORTS = 20_000, 32_768  # of the viewer: below those that a system gives to whoever asks for any


class WebPage:
    """Serves in a thread of its own until closed. ``port`` is the one it got."""

    def __init__(self, port: int | None, source: int, receiver: int) -> None:
        """Serve on ``port`` what the viewer serves on ``source``.

        0 is any free port, None 9090 or, where that is taken, any free one. ``receiver`` is the
        port from which the page gets its data. Raises ViewError when the port is taken.
        """
        handler = type("Handler", (_PageHandler,), {"source": source, "receiver": receiver})
        try:
            self._server = ThreadingHTTPServer((LOOPBACK, _PAGE if port is None else port), handler)
        except (OSError, OverflowError) as error:
            if port is not None:
                raise ViewError(f"port {port} can't be used: {error}") from None
            self._server = ThreadingHTTPServer((LOOPBACK, 0), handler)
        self._server.daemon_threads = True
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Serve no more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5.0)


def policy(receiver: int) -> str:
    """The Content-Security-Policy: scripts of the page itself, data from this machine."""
    data = " ".join(f"http://{host}:{receiver}" for host in _HOSTS)
    return (
        "default-src 'self' data: blob:; "
        "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
        f"style-src 'self' 'unsafe-inline'; connect-src 'self' data: blob: {data}"
    )


class _PageHandler(BaseHTTPRequestHandler):
    source = 0
    receiver = 0
    protocol_version = "HTTP/1.0"  # one answer a connection: its end is the answer's
    timeout = 30.0

    def do_GET(self) -> None:
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        target = urlsplit(self.path)
        if host not in _HOSTS:  # another site's name that points here
            self.send_error(403)
        elif not _FILE.fullmatch(target.path):
            self.send_error(404)
        elif target.path == "/" and not target.query:
            data = quote(f"rerun+http://{host}:{self.receiver}/proxy", safe="")
            self.send_response(302)
            self.send_header("Location", f"/?url={data}&persist=0&notebook=0&hide_welcome_screen")
            self.end_headers()
        else:
            self._forward(target.path)

    def _forward(self, path: str) -> None:
        connection = http.client.HTTPConnection(LOOPBACK, self.source, timeout=self.timeout)
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            self.send_response(answer.status)
            for name in _PASSED_ON:
                value = answer.getheader(name)
                if value is not None:
                    self.send_header(name, value)
            self.send_header("Content-Security-Policy", policy(self.receiver))
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            shutil.copyfileobj(answer, self.wfile, 1 << 20)
        except (OSError, http.client.HTTPException):
            self.close_connection = True  # one of both ends has gone
        finally:
            connection.close()

    def log_message(self, *_: object) -> None:
        """Print nothing."""


_START = 20.0  # s that a viewer may take until it listens
_NOWHERE = f"http://{LOOPBACK}:9"  # no proxy listens there: nothing gets out
_QUIET = {
    **{"CI": "1", "RERUN_APP_ONLY": "true", "RUST_LOG": "error"},
    **dict.fromkeys(("ALL_PROXY", "HTTPS_PROXY", "HTTP_PROXY"), _NOWHERE),
}
_PR_SET_PDEATHSIG = 1  # from <sys/prctl.h>


class Viewer:
    """A running viewer.

    ``url`` is where data is sent, ``receiver`` its port; ``address`` the page's, if any.
    """

    def __init__(self, window: bool, memory: float, port: int | None) -> None:
        """Start it, with ``memory`` [MB] at most; ``port`` is the page's, as for WebPage.

        Raises ViewError when it does not start.
        """
        self.address = ""
        self._page: WebPage | None = None
        if window and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise ViewError("no display for a window here: add --web, or --save FILE.rrd")
        self.receiver, source = _free_port(), _free_port()
        bound = f"{max(memory, 1.0):.0f}MB"
        words = [_program(), "--bind", LOOPBACK, "--port", str(self.receiver)]
        words += ["--server-memory-limit", bound]
        if window:
            words += ["--memory-limit", bound, "--hide-welcome-screen"]
        else:
            words += ["--serve-web", "--web-viewer-port", str(source)]
        self._output: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  closed with the viewer
        self._process = subprocess.Popen(
            words,
            env={**os.environ, **_QUIET},
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=self._output,
            preexec_fn=_end_with_parent,
        )
        self.url = f"rerun+http://{LOOPBACK}:{self.receiver}/proxy"
        try:
            self._until_listening(self.receiver)
            if not window:
                self._until_listening(source)
                self._page = WebPage(port, source, self.receiver)
                self.address = f"http://{LOOPBACK}:{self._page.port}/"
        except BaseException:
            self.close()
            raise

    def running(self) -> bool:
        """False once its window was closed, or it has died."""
        return self._process.poll() is None

    def failure(self) -> str:
        """Its last line when it ended with an error, else an empty text."""
        status = self._process.poll()
        if not status:
            return ""
        self._output.seek(0)
        lines = self._output.read().decode(errors="replace").strip().splitlines()
        return f"the viewer has ended ({status}){': ' + lines[-1] if lines else ''}"

    def close(self) -> None:
        if self._page is not None:
            self._page.close()
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(3.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._process.wait()
        self._output.close()

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


def _free_port() -> int:
    """A port of the loopback where nobody listens, and that nobody is given before it is used."""
    while True:
        port = random.randrange(*_PORTS)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind((LOOPBACK, port))
            return port


def resident() -> float:
    """Memory of this process [MB]; 0 where the system doesn't say."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0.0
    return 1e-6 * pages * resource.getpagesize()


def _program() -> str:
    program = Path(str(rerun_cli.__file__)).parent / "rerun"
    if not program.exists():
        raise ViewError(f"{program}: missing; install rerun-sdk again")
    return str(program)


def _end_with_parent() -> None:
    """In the child: end when the parent does, ignore its terminal's Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
