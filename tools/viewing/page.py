"""Serve the ``softfinger view`` page and its pictures, and carry out the page's commands.

A single thread serves the pages. The main thread reads the stream or plays a recording, and creates
each picture once for all pages. After drawing a picture, a page requests the next one. A slow page
therefore skips pictures and does not delay other pages. ``softfinger view`` prints a token in the
terminal. Pages with this token may send commands, and each page is a separate client.
"""

from __future__ import annotations

import argparse
import asyncio
import errno
import json
import logging
import math
import os
import secrets
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import msgpack
from websockets.asyncio.server import ServerConnection, serve
from websockets.http11 import Request, Response

from softfinger.daemon.client.command_client import NoAnswer, send
from softfinger.daemon.loop.warm_up import LANDSCAPE
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.arguments import client_keys, to_stderr
from softfinger.tools.processes.compile import build_kernels
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.stop_condition import StopCondition
from softfinger.tools.terminal.stream_state import judge
from softfinger.tools.viewing.document import document, save
from softfinger.tools.viewing.foxglove_server import LAYOUT, ORIGINS, PROTOCOLS, Foxglove
from softfinger.tools.viewing.pictures import Pictures, Row
from softfinger.tools.viewing.sources import Playback, ViewError, follow

if TYPE_CHECKING:
    from softfinger.tools.processes.child_processes import RecorderProcess

_LOOPBACK = "127.0.0.1"
_PORT = 9090  # default port
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")  # environment variables that name a display
_WAITING_COUNT_MAX = 40  # maximum total number of commands awaiting a reply
_REQUEST_TIMEOUT = 5.0  # timeout for a request's header [s], long enough for a busy browser
_NAME_LENGTH_MAX = 40  # maximum displayed length of a command name [characters]
_NO_COMMAND = (ValueError, TypeError, LookupError, AttributeError, OverflowError, RecursionError)
_BUFFER_SIZE = 256 << 10  # maximum amount of data queued for a page or a Foxglove client [bytes]
_MESSAGE_SIZE_MAX = 65536  # maximum size of a message from a page or a Foxglove client [bytes]
_HEADERS = {
    "Cache-Control": "no-store",  # The page may contain a token, which changes at each start.
    "Content-Security-Policy": "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_say = to_stderr("view")


# Scene, picture, and the plot rows that belong to the picture.
_Published = tuple[str, str, list[Row]]


class Site:
    """Serve the page, carry out commands, and stream to Foxglove clients.

    Each request must name this server as its host; this rule blocks DNS rebinding. A browser's
    request must also have the origin of this server's pages; this rule blocks other sites. Pages
    with the ``token`` may send commands through ``send``. All pages may control a recording's
    playback through ``wish``. If other machines can reach the server, the token is required even
    for watching. A browser then exchanges a one-time code for the token.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        token: str,
        send: Callable[[dict[str, Any], float], dict[str, Any]] | None,
        foxglove: Foxglove | None,
        stale: float,
        public: str,
    ) -> None:
        """Create a server; `run` serves the pages.

        A command is dropped if the user's picture is older than ``stale`` [s]. If other machines
        can reach the page, ``public`` is its address, which is printed with each one-time code.
        """
        self._loop = loop
        self._token = token
        self._code = ""  # one-time code for one browser
        self._public = public
        self._send = send
        self._stale = stale
        self._ended = asyncio.Event()
        self._hosts: set[str] = set()  # valid host names of this server
        self._at_once = asyncio.Semaphore(_WAITING_COUNT_MAX)
        # Pages that are waiting for the next picture.
        self.waiting: list[asyncio.Future[_Published]] = []
        self.record: Callable[[], str] = lambda: ""  # function that starts or ends a recording
        # Function that receives a page's request for a picture.
        self.wish: Callable[[str], None] = lambda _: None
        self._routes: dict[str, Callable[[ServerConnection], Awaitable[None]]] = {
            "/pictures": self._show,
            "/command": self._command,
        }
        if foxglove is not None:
            self._routes["/"] = foxglove.serve

    def publish(self, scene: str, picture: str, rows: list[Row]) -> None:
        """Send a picture to the waiting pages. Called from another thread."""
        self._loop.call_soon_threadsafe(self._give, (scene, picture, rows))

    def announce(self) -> None:
        """Print the page's address with a new one-time code."""
        self._code = secrets.token_urlsafe(8)
        where = f"http://{self._public}/?code={self._code}"
        print(f"view: {where} to view the hand in one browser", flush=True)

    def end(self) -> None:
        """End `run`. Called from another thread."""
        self._loop.call_soon_threadsafe(self._ended.set)

    async def run(self, listener: socket.socket) -> None:
        """Serve requests on ``listener`` until `end` is called."""
        quiet = logging.getLogger("softfinger.view")
        quiet.disabled = True  # Do not log invalid requests from other programs.
        self._hosts = {
            f"{name}:{listener.getsockname()[1]}" for name in (_LOOPBACK, "localhost", "[::1]")
        }
        server = await serve(
            self._serve,
            sock=listener,
            process_request=self._admit,
            process_response=_add_headers,
            subprotocols=PROTOCOLS,
            select_subprotocol=lambda _, offered: next(
                (each for each in offered if each in PROTOCOLS), None
            ),
            compression=None,  # Compression has no benefit on a local connection.
            open_timeout=_REQUEST_TIMEOUT,
            max_size=_MESSAGE_SIZE_MAX,
            logger=quiet,
        )
        await self._ended.wait()
        # A client that does not read would never close its connection.
        for connection in server.connections:
            connection.transport.abort()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for each in others:
            each.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the HTTP response (page or refusal), or None to accept a WebSocket connection."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        path, upgrade = urlsplit(request.path).path, "Upgrade" in request.headers
        known = [[], *([f"http://{host}"] for host in hosts)]
        if upgrade and path == "/":
            known += [[origin] for origin in ORIGINS]
        here = len(hosts) == 1 and hosts[0] in self._hosts
        # If codes are used, each request contains a secret, so any host name is accepted.
        if self._public:
            here = True
            if not self._allows(request):
                return self._exchange(connection, request)
        if not here or origins not in known:
            return connection.respond(403, "only pages served from this machine may connect")
        if upgrade and path in self._routes:
            return None
        if upgrade or path != "/":
            return connection.respond(404, "not found")
        watched = "command" if self._allows(request) else "watch"
        shown = "play" if self._send is None else watched
        response = connection.respond(200, document(shown))
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = "text/html; charset=utf-8"
        return response

    def _exchange(self, connection: ServerConnection, request: Request) -> Response:
        """Redirect a browser that sends the one-time code to the page's address with the token."""
        if not self._code or not _has(request, "code", self._code):
            said = (
                "Open this page with the newest address printed by softfinger view; each "
                "address works only once"
            )
            return connection.respond(403, said)
        self.announce()
        response = connection.respond(303, "")
        response.headers["Location"] = f"/?token={self._token}"
        return response

    def _allows(self, request: Request) -> bool:
        """Return True if the request contains the token."""
        return _has(request, "token", self._token)

    async def _serve(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        await self._routes[urlsplit(connection.request.path).path](connection)

    def _give(self, published: _Published) -> None:
        for each in self.waiting:
            if not each.done():
                each.set_result(published)
        self.waiting = []

    async def _show(self, page: ServerConnection) -> None:
        """Send the next picture and the new plot rows each time a page requests a picture.

        A new scene is sent before the picture.
        """
        known, next_row = "", 0
        async for wish in page:
            self.wish(str(wish))
            self.waiting.append(self._loop.create_future())
            scene, picture, rows = await self.waiting[-1]
            if scene != known:
                await page.send(scene)
            known = scene
            fresh = [row.text for row in rows if row.number >= next_row]
            next_row = rows[-1].number + 1 if rows else next_row
            await page.send(f'{picture[:-1]},"rows":[{",".join(fresh)}]}}')

    async def _command(self, page: ServerConnection) -> None:
        """Execute commands from a page that has the token, and send the replies."""
        assert page.request is not None
        allowed = self._send is not None and self._allows(page.request)
        async for text in page:
            answer = "✗ commands require the token printed in the terminal"
            if allowed:
                async with self._at_once:
                    answer = await self._in_thread(text)
            await page.send(answer)

    def _in_thread(self, text: str | bytes) -> asyncio.Future[str]:
        """Run `_answer` in a thread that ends with the process; return a future for the reply."""
        future: asyncio.Future[str] = self._loop.create_future()

        def give(answer: str) -> None:
            if not future.done():  # The page may have disconnected.
                future.set_result(answer)

        def work() -> None:
            self._loop.call_soon_threadsafe(give, self._answer(text))

        threading.Thread(target=work, daemon=True).start()
        return future

    def _answer(self, text: str | bytes) -> str:
        """Send the request ``text`` to the daemon; return a line that describes the result.

        Commands other than stop are dropped if the user's picture is too old. The field ``seen`` is
        the picture's monotonic time [s].
        """
        try:
            asked = json.loads(text)
            name = str(asked["command"])[:_NAME_LENGTH_MAX]
            age = time.monotonic() - float(asked.pop("seen", "nan"))
            # The call fails for values that msgpack cannot represent, such as deeply nested maps
            # and very large integers.
            msgpack.packb(asked)
        except _NO_COMMAND:
            return '✗ invalid command: expected a JSON object with "command", not nested deeply'
        if name == "record":
            return self.record()
        if name != "stop" and math.isnan(age):
            return f'✗ {name}: expected "seen", the time of the displayed picture'
        if name != "stop" and not age < self._stale:
            return f"✗ {name}: discarded because the page is {age:.0f} s behind"
        try:
            remaining = self._stale if name == "stop" else self._stale - age
            assert self._send is not None
            reply = judge(time.monotonic(), name, self._send(asked, remaining))
        except NoAnswer as error:
            return f"✗ {name}: {error}"
        return f"{'✓' if reply.ok else '✗'} {reply.text}"


def _add_headers(_: ServerConnection, __: Request, response: Response) -> None:
    response.headers.update(_HEADERS)


def _has(request: Request, name: str, secret: str) -> bool:
    """Return True if ``secret`` is the value of ``name`` in the request's query."""
    given = parse_qs(urlsplit(request.path).query).get(name, [""])[0]
    return secrets.compare_digest(given.encode(), secret.encode())


class PageRecorder:
    """Run one `softfinger record` process at a time, in the current folder.

    ``show`` receives a map with the running recording's ``file`` and its start time ``since`` (Unix
    time [s]). If the recording failed, the map contains the reason as ``failed``. If no recording
    is running, the map is empty.
    """

    def __init__(self, address: str, keys: str, show: Callable[[dict[str, Any]], None]) -> None:
        self._address = address
        self._keys = keys
        self._show = show
        self._lock = threading.Lock()
        self._process: RecorderProcess | None = None

    def toggle(self) -> str:
        """Start a recording, or end the running one; return a line that describes the result."""
        try:
            from softfinger.tools.processes.child_processes import RecorderError, RecorderProcess
        except ImportError:  # This system has no termios.
            return "✗ record: available only on Linux and macOS; use softfinger record instead"
        with self._lock:
            if (process := self._process) is not None:
                return f"✓ {self._end(process)}"
            path = Path(time.strftime("softfinger-%Y%m%d-%H%M%S.mcap")).absolute()
            words = [str(path), "--address", self._address]
            try:
                self._process = RecorderProcess(words, path.exists, self._failed, self._keys)
            except RecorderError as error:
                return f"✗ record: {error}"
            self._show({"file": path.name, "since": time.time()})
            return f"✓ recording to {path}"

    def close(self) -> None:
        """End the running recording, if any."""
        with self._lock:
            if (process := self._process) is not None:
                self._end(process)

    def _end(self, process: RecorderProcess) -> str:
        said = process.close()
        self._process = None
        self._show({})
        return said

    def _failed(self, why: str) -> None:
        self._process = None
        self._show({"failed": why})


def listen(host: str, port: int | None) -> socket.socket:
    """Open a listening socket; the default port is 9090, or a free port if 9090 is taken.

    Raises ViewError.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, _PORT if port is None else port), family=family)
    except OSError as error:
        if port is not None or error.errno != errno.EADDRINUSE:
            at = f"--host {host}" if port is None else f"port {port} of {host}"
            raise ViewError(f"{at} can't be used: {error.strerror}") from None
        return listen(host, 0)
    # Use a small buffer, because buffered data count as sent before the client has read them.
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_SIZE)
    return listener


def show(arguments: argparse.Namespace, ending: StopCondition) -> None:
    """Serve the page until a stop is requested. Raises SoftfingerError if nothing can be shown."""
    recording = None if arguments.file is None else Recording(arguments.file, _say)
    build_kernels(Settings(), lambda _level, _kind, text: _say(text), LANDSCAPE)
    if recording is not None and arguments.save is not None:
        save(arguments.save, recording, 1.0 / arguments.rate, _say)
        return
    keys = client_keys(arguments.keys)
    loop = asyncio.new_event_loop()
    foxglove = Foxglove(loop) if arguments.foxglove is not None else None
    live, away = recording is None, arguments.host not in (_LOOPBACK, "localhost", "::1")
    token = secrets.token_urlsafe(16)
    hand_on = partial(send, arguments.commands, keys=keys) if live else None
    port = arguments.port if foxglove is None else arguments.foxglove
    with listen(arguments.host, port) as listener:
        address = _address(listener)
        site = Site(loop, token, hand_on, foxglove, arguments.timeout, address if away else "")
        period = 1.0 / arguments.rate
        pictures = Pictures(
            site.publish,
            lambda: bool(site.waiting),
            _say,
            live=live,
            period=period,
            foxglove=foxglove,
        )
        recorder = PageRecorder(
            arguments.address, str(arguments.keys or ""), partial(setattr, pictures, "recording")
        )
        site.record = recorder.toggle
        source = partial(follow, arguments, keys, pictures, ending, _say)
        if recording is not None:
            playback = Playback(recording, pictures, period)
            site.wish, source = playback.ask, partial(playback.run, ending)

        def run() -> None:
            try:
                loop.run_until_complete(site.run(listener))
            finally:
                ending.end()

        serving = threading.Thread(target=run)
        serving.start()
        try:
            if foxglove is not None:
                secret = f"/?token={token}" if away else ""
                print(f"view: ws://{address}{secret} for Foxglove; layout: {LAYOUT}")
            if live and not away:
                print(f"view: http://{address}/?token={token} to view and command the hand")
            if away:
                site.announce()
            else:
                print(f"view: http://{address}/ to view the hand", flush=True)
            # On a Linux machine without a display, a text browser would block this thread.
            display = sys.platform != "linux" or any(map(os.environ.get, _DISPLAYS))
            if foxglove is None and not away and display and not arguments.no_browser:
                # Omit the token, because other users may be able to see the browser's command line.
                webbrowser.open(f"http://{address}/")
            ending.begin()
            source()
        finally:
            recorder.close()
            site.end()
            serving.join()
    _say(f"{pictures.seen} states received, {pictures.unreadable} messages could not be read")
    if pictures.seen == 0:
        raise ViewError(f"{arguments.file or arguments.address}: received no hand/state")


def _address(listener: socket.socket) -> str:
    """Return host and port for a browser; the host is the machine's name for a wildcard address."""
    host, port = listener.getsockname()[:2]
    if host in ("0.0.0.0", "::"):
        host = socket.gethostname()
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
