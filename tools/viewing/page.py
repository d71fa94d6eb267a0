"""The web viewer's page on the loopback: a proxy of the viewer's own server.

The viewer's page asks other machines for fonts, news and usage statistics. The proxy adds a policy
by which the browser reaches this machine only.
"""

from __future__ import annotations

import http.client
import re
import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import quote, urlsplit

from softfinger.daemon.errors import SoftfingerError

LOOPBACK = "127.0.0.1"
_FILE = re.compile(r"/([\w-]+(\.[\w-]+)*)?")
_PASSED_ON = ("Content-Type", "Content-Length", "rerun-final-length")
_HOSTS = ("127.0.0.1", "localhost")


class ViewError(SoftfingerError):
    """Nothing can be shown. The message says why, and what to do."""


class WebPage:
    """Serves in a thread of its own until closed. ``port`` is the one it got."""

    def __init__(self, port: int, source: int, receiver: int) -> None:
        """Serve on ``port`` (0: a free one) what the viewer serves on ``source``.

        ``receiver`` is the port from which the page gets its data. Raises ViewError when the port
        is taken.
        """
        handler = type("Handler", (_PageHandler,), {"source": source, "receiver": receiver})
        try:
            self._server = ThreadingHTTPServer((LOOPBACK, port), handler)
        except (OSError, OverflowError) as error:
            raise ViewError(f"port {port} can't be used: {error}") from None
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
