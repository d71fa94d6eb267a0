"""The web page of ``softfinger view``: its server on the loopback, with pictures and commands.

One thread serves. The main thread reads the stream, or plays a recording, and makes a picture for
all pages. A page asks for the next one when it has drawn the last, so that a slow one skips and
costs nothing. Whoever has the token that the terminal prints may command, each page as a client.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import re
import secrets
import socket
import threading
import time
import webbrowser
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection, serve
from websockets.http11 import Request, Response

from softfinger.daemon.client.command_client import NoAnswer, send
from softfinger.daemon.loop.warm_up import LANDSCAPE
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.arguments import client_keys, to_stderr
from softfinger.tools.ending import Ending
from softfinger.tools.processes.compile import build_kernels
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.terminal.feed import MEANINGS, judge
from softfinger.tools.viewing.foxglove_server import LAYOUT, ORIGINS, PROTOCOLS, Foxglove
from softfinger.tools.viewing.pictures import Pictures
from softfinger.tools.viewing.sources import Playback, ViewError, follow

_HELP = "".join(f"<dt><b>{words}</b><dd>{meaning}" for words, meaning in MEANINGS)
_PAGE = Path(__file__).with_name("page.html").read_text("utf-8").replace("MEANINGS", _HELP)
_LOOPBACK = "127.0.0.1"
_PORT = 9090  # where nobody says another
_NICE = 5  # everything real-time goes first
_AT_ONCE = 40  # commands that wait for their answers, of all pages
_PATIENCE = 5.0  # s for a request's head, of a busy browser, too
_BUFFER = 256 << 10  # bytes that wait for a page or a client of Foxglove
_LARGEST = 65536  # bytes of what a page or a client of Foxglove sends
_say = to_stderr("view")


class Site:
    """The page, the pictures and commands of all pages, and what Foxglove connects to.

    Lets in what names this machine as its host, and pages of this very server: a name that an
    attacker's DNS leads here is another host; a foreign page's requests carry its own origin.
    Pages with the ``token`` may command, by ``send``; None: they play a recording, by ``wish``.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        token: str | None,
        send: Callable[[dict[str, Any], float], dict[str, Any]],
        foxglove: Foxglove | None,
        stale: float,
    ) -> None:
        """``stale`` [s] after its picture a command is dropped."""
        self._loop = loop
        self._token = token
        self._send = send
        self._stale = stale
        self._ended = asyncio.Event()
        self.waiting: list[asyncio.Future[tuple[str, str]]] = []  # pages, for the next picture
        self.wish: Callable[[str], None] = lambda _: None  # what pages ask with each picture
        self._routes: dict[str, Callable[[ServerConnection], Awaitable[None]]] = {
            "/pictures": self._show,
            "/command": self._command,
        }
        if foxglove is not None:
            self._routes["/"] = foxglove.serve

    def publish(self, scene: str, picture: str) -> None:
        """Give both to the pages that wait, from another thread."""
        self._loop.call_soon_threadsafe(self._give, (scene, picture))

    def end(self) -> None:
        """End `run`, from another thread."""
        self._loop.call_soon_threadsafe(self._ended.set)

    async def run(self, listener: socket.socket) -> None:
        """Serve on ``listener`` until the end."""
        quiet = logging.getLogger("softfinger.view")
        quiet.disabled = True  # what strangers do wrong is nobody's business here
        await serve(
            self._serve,
            sock=listener,
            process_request=self._admit,
            subprotocols=PROTOCOLS,
            select_subprotocol=lambda _, offered: next(
                (each for each in offered if each in PROTOCOLS), None
            ),
            compression=None,  # nothing is gained on this machine
            open_timeout=_PATIENCE,
            max_size=_LARGEST,
            logger=quiet,
        )
        await self._ended.wait()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for each in others:
            each.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the page, or why not; None lets a WebSocket in."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        path, upgrade = urlsplit(request.path).path, "Upgrade" in request.headers
        known = [[], *([f"http://{host}"] for host in hosts)]
        if upgrade and path == "/":
            known += [[origin] for origin in ORIGINS]
        here = [host.partition(":")[0] in (_LOOPBACK, "localhost") for host in hosts]
        if here != [True] or origins not in known:
            return connection.respond(403, "only for pages of this machine")
        if upgrade and path in self._routes:
            return None
        if upgrade or path != "/":
            return connection.respond(404, "nothing here")
        watched = "command" if self._allows(request) else "watch"
        shown = "play" if self._token is None else watched
        others = rf'<section class="(?!{shown}).*?</section>'
        response = connection.respond(200, re.sub(others, "", _PAGE, flags=re.S))
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = "text/html; charset=utf-8"
        return response

    def _allows(self, request: Request) -> bool:
        """Return whether it has the token."""
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        token = self._token
        return token is not None and secrets.compare_digest(given.encode(), token.encode())

    async def _serve(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        await self._routes[urlsplit(connection.request.path).path](connection)

    def _give(self, pair: tuple[str, str]) -> None:
        for each in self.waiting:
            if not each.done():
                each.set_result(pair)
        self.waiting = []

    async def _show(self, page: ServerConnection) -> None:
        """Send a page the next picture each time it asks, and the scene where it is another."""
        known = ""
        async for wish in page:
            self.wish(str(wish))
            self.waiting.append(self._loop.create_future())
            scene, picture = await self.waiting[-1]
            if scene != known:
                await page.send(scene)
            known = scene
            await page.send(picture)

    async def _command(self, page: ServerConnection) -> None:
        """Carry out what a page with the token asks of the daemon, once, and tell it the answer."""
        assert page.request is not None
        allowed = self._allows(page.request)
        async for text in page:
            answer = "✗ needs the token that the terminal prints"
            if allowed:
                answer = await self._loop.run_in_executor(None, self._answer, text)
            await page.send(answer)

    def _answer(self, text: str | bytes) -> str:
        """Carry out the daemon's request ``text``, which it checks; what is said of it.

        All but a stop is dropped when its picture (``seen``, monotonic s) is long past.
        """
        try:
            asked = json.loads(text)
            name = str(asked["command"])
            age = time.monotonic() - float(asked.pop("seen", "nan"))
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            return f"✗ no command: {error!r}"
        if name != "stop" and not age < self._stale:
            return f"✗ {name}: dropped, the page is {age:.0f} s behind"
        try:
            remaining = self._stale if name == "stop" else self._stale - age
            reply = judge(time.monotonic(), name, self._send(asked, remaining))
        except NoAnswer as error:
            return f"✗ {name}: {error}"
        return f"{'✓' if reply.ok else '✗'} {reply.text}"


def listen(port: int | None) -> socket.socket:
    """A socket on ``port``; None: 9090 or, where that is taken, any. Raises ViewError."""
    try:
        listener = socket.create_server((_LOOPBACK, _PORT if port is None else port))
    except OSError as error:
        if port is not None:
            raise ViewError(f"port {port} can't be used: {error.strerror}") from None
        return listen(0)
    # What waits in the system's buffer is what a client takes without reading.
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
    return listener


def show(arguments: argparse.Namespace, ending: Ending) -> None:
    """Serve the page until the end. Raises SoftfingerError when nothing can be shown."""
    os.nice(_NICE)
    recording = None if arguments.file is None else Recording(arguments.file, _say)
    build_kernels(Settings(), lambda _level, _kind, text: _say(text), LANDSCAPE)
    keys = client_keys(arguments.keys)
    loop = asyncio.new_event_loop()
    loop.set_default_executor(ThreadPoolExecutor(_AT_ONCE))
    foxglove = Foxglove(loop) if arguments.foxglove is not None else None
    live = recording is None
    token = secrets.token_urlsafe(16) if live else None
    hand_on = partial(send, arguments.commands, keys=keys)
    site = Site(loop, token, hand_on, foxglove, arguments.timeout)
    pictures = Pictures(
        site.publish, lambda: bool(site.waiting), _say, live=live, foxglove=foxglove
    )
    source = partial(follow, arguments, keys, pictures, ending, _say)
    if recording is not None:
        playback = Playback(recording, pictures, 1.0 / arguments.rate)
        site.wish, source = playback.ask, partial(playback.run, ending)

    def run(listener: socket.socket) -> None:
        try:
            loop.run_until_complete(site.run(listener))
        finally:
            ending.end()

    with listen(arguments.port if foxglove is None else arguments.foxglove) as listener:
        serving = threading.Thread(target=run, args=(listener,))
        serving.start()
        host = f"{_LOOPBACK}:{listener.getsockname()[1]}"
        try:
            if foxglove is not None:
                print(f"view: ws://{host} for Foxglove; layout: {LAYOUT}")
            if token is not None:
                print(f"view: http://{host}/?token={token} to see and command the hand")
            print(f"view: http://{host}/ to see it", flush=True)
            if foxglove is None and not arguments.no_browser:
                # Without the token: other users of this machine may read a browser's command line.
                webbrowser.open(f"http://{host}/")
            ending.begin()
            source()
        finally:
            site.end()
            serving.join()
    _say(f"{pictures.seen} states seen, {pictures.unreadable} messages could not be read")
    if pictures.seen == 0:
        raise ViewError(f"{arguments.file or arguments.address}: nothing came that can be shown")
