"""The web page of ``softfinger view``: its server on the loopback, with pictures and commands.

One thread serves. The main thread reads the stream, or plays a recording, and makes a picture for
all pages. A page asks for the next one when it has drawn the last, so that a slow one skips and
costs nothing. Whoever has the token that the terminal prints may command, each page as a client.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import os
import re
import secrets
import socket
import threading
import time
import webbrowser
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from softfinger.daemon.client.command_client import NoAnswer, send
from softfinger.daemon.loop.warm_up import LANDSCAPE
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.keys import ClientKeys
from softfinger.tools.arguments import client_keys, to_stderr
from softfinger.tools.ending import Ending
from softfinger.tools.processes.compile import build_kernels
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.terminal.feed import judge, number
from softfinger.tools.viewing.live_stream import LOOPBACK, NICE, TOPICS, ViewError, follow
from softfinger.tools.viewing.pictures import SECONDS, Pictures

_PAGE = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
_HOSTS = (LOOPBACK, "localhost")
_PORT = 9090  # where nobody says another
_STALE = 3.0  # s from a picture to a command that is for it; also to the command's answer
_say = to_stderr("view")


class SameOrigin:
    """Lets in what names this machine as its host, and pages of this very server.

    A name that an attacker's DNS leads here is another host; a foreign page's requests and
    WebSockets carry its own origin.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin", "")
        here = host.partition(":")[0] in _HOSTS and origin in ("", f"http://{host}")
        refused = PlainTextResponse("only for pages of this machine", 403)
        await (self._app if here else refused)(scope, receive, send)


class Newest:
    """The next scene and picture, for the pages that are ``waiting`` for them in ``loop``."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.waiting: list[asyncio.Future[tuple[str, str]]] = []
        self._loop = loop

    def publish(self, scene: bytes, picture: bytes) -> None:
        """Give both to the pages, from another thread."""
        self._loop.call_soon_threadsafe(self._give, (scene.decode(), picture.decode()))

    def _give(self, pair: tuple[str, str]) -> None:
        for each in self.waiting:
            if not each.done():  # the page has gone
                each.set_result(pair)
        self.waiting = []

    async def serve(self, playback: Playback | None, page: WebSocket) -> None:
        """Send a page the next picture each time it asks, and the scene where it is another."""
        await page.accept()
        known = ""
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                wish = await page.receive_text()
                if playback is not None:
                    playback.ask(wish)
                self.waiting.append(self._loop.create_future())
                scene, picture = await self.waiting[-1]
                if scene != known:
                    await page.send_text(scene)
                known = scene
                await page.send_text(picture)


class Playback:
    """A recording's place, and that it is ``playing``. ``run`` is for its own thread."""

    def __init__(self, recording: Recording, pictures: Pictures, period: float) -> None:
        self._recording = recording
        self._pictures = pictures
        self._period = period  # s between two pictures
        self._target: float | None = None  # where to go, from another thread
        self.playing = True
        self.position = 0.0  # s from the first message on
        self.duration = recording.duration

    def seek(self, position: float) -> None:
        """Go to ``position`` [s], from any thread."""
        self._target = min(max(position, 0.0), self.duration)

    def ask(self, wish: str) -> None:
        """Carry out a page's wish: ``play``, ``pause`` or a position; others are ignored."""
        with contextlib.suppress(ValueError):
            if wish in ("play", "pause"):
                self.playing = wish == "play"
            elif math.isfinite(place := float(wish)):
                self.seek(place)

    def run(self, ending: Ending) -> None:
        """Play until the end is asked for."""
        if self._recording.count(schema.SETTINGS):  # which may come once, at the beginning
            self._pictures.take(*next(self._recording.messages([schema.SETTINGS])))
        while not ending.over:
            if self._target is None and not self.playing:
                self._stand(ending)
            else:  # without a place, again from the beginning
                target, self._target = self._target or 0.0, None
                self._play_from(target, ending)

    def _play_from(self, target: float, ending: Ending) -> None:
        """Take the seconds before ``target`` at once, for the plots, then go on in time."""
        self._pictures.clear()
        self.position = target
        for topic, message in self._recording.messages(TOPICS, target - SECONDS):
            at = min(number(message, "timestamp") - self._recording.start, self.duration)
            while at > self.position and self._pictures.newest.get(schema.STATE):
                self._stand(ending)
                if self._target is not None or ending.over:
                    return
            self._pictures.take(topic, message)
        self.position = max(self.position, target)
        self.playing = False

    def _stand(self, ending: Ending) -> None:
        """Show this place for one picture; the next is later where it plays."""
        begun = time.monotonic()
        self._pictures.draw((self.position, self.duration, self.playing))
        ending.wait(self._period)
        if self.playing:
            self.position = min(self.position + time.monotonic() - begun, self.duration)


class PageCommands:
    """Hands on, once, what pages with the ``token`` ask of the daemon. None: nobody may."""

    def __init__(self, address: str, keys: ClientKeys | None, token: str | None) -> None:
        self._address = address
        self._keys = keys
        self._token = token

    def allows(self, request: Request) -> bool:
        """Return whether it has the token."""
        given = request.query_params.get("token", "").encode()
        return self._token is not None and secrets.compare_digest(given, self._token.encode())

    async def carry_out(self, request: Request) -> PlainTextResponse:
        """Carry out a stop, or the body, unless its picture (``seen``, monotonic s) is long past.

        The body is the daemon's request, which the daemon checks.
        """
        if not self.allows(request):
            return PlainTextResponse("✗ needs the token that the terminal prints", 403)
        asked: dict[str, Any] = {"command": "stop"}
        if request.url.path != "/stop":
            try:
                asked = await request.json()
                age = time.monotonic() - float(asked.pop("seen"))
                name = asked["command"]
            except (ValueError, TypeError, LookupError, AttributeError) as error:
                return PlainTextResponse(f"✗ no command: {error!r}", 400)
            if not age < _STALE:
                return PlainTextResponse(f"✗ {name}: dropped, the page is {age:.0f} s behind", 409)
        try:
            record = await run_in_threadpool(send, self._address, asked, _STALE, self._keys)
        except NoAnswer as error:
            return PlainTextResponse(f"✗ {asked['command']}: {error}", 504)
        reply = judge(time.monotonic(), str(asked["command"]), record)
        sign, status = ("✓", 200) if reply.ok else ("✗", 409)
        return PlainTextResponse(f"{sign} {reply.text}", status)


def listen(port: int | None) -> socket.socket:
    """A socket on ``port``; None: 9090 or, where that is taken, any. Raises ViewError."""
    try:
        return socket.create_server((LOOPBACK, _PORT if port is None else port))
    except OSError as error:
        if port is not None:
            raise ViewError(f"port {port} can't be used: {error.strerror}") from None
        return socket.create_server((LOOPBACK, 0))


def show(arguments: argparse.Namespace, ending: Ending) -> None:
    """Serve the page until the end. Raises SoftfingerError when nothing can be shown."""
    os.nice(NICE)
    recording = None if arguments.file is None else Recording(arguments.file, _say)
    build_kernels(Settings(), lambda _level, _kind, text: _say(text), LANDSCAPE)
    keys = client_keys(arguments.keys)
    loop = asyncio.new_event_loop()
    newest = Newest(loop)
    pictures = Pictures(newest.publish, lambda: bool(newest.waiting), _say, live=recording is None)
    token = playback = None
    if recording is None:
        token, role = secrets.token_urlsafe(16), "command"
        source = partial(follow, arguments, keys, pictures, ending, _say)
    else:
        role = "play"
        playback = Playback(recording, pictures, 1.0 / arguments.rate)
        source = partial(playback.run, ending)
    commands = PageCommands(arguments.commands, keys, token)

    def page(request: Request) -> HTMLResponse:
        shown = role if token is None or commands.allows(request) else "watch"
        others = rf'<section class="(?!{shown}).*?</section>'
        return HTMLResponse(re.sub(others, "", _PAGE, flags=re.S))

    posts = [
        Route(f"/{path}", commands.carry_out, methods=["POST"]) for path in ("stop", "command")
    ]
    pages = WebSocketRoute("/pictures", partial(newest.serve, playback))
    site = Starlette(routes=[Route("/", page), *posts, pages])
    config = uvicorn.Config(
        SameOrigin(site),
        lifespan="off",
        log_level="error",
        access_log=False,
        proxy_headers=False,
        ws_per_message_deflate=False,  # nothing is gained on this machine
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)

    def serve() -> None:
        try:
            loop.run_until_complete(server.serve([listener]))
        finally:
            ending.end()

    with listen(arguments.port) as listener:
        serving = threading.Thread(target=serve)
        serving.start()
        address = f"http://{LOOPBACK}:{listener.getsockname()[1]}/"
        try:
            if token is not None:
                print(f"view: {address}?token={token} to see and command the hand", flush=True)
            print(f"view: {address} to see it", flush=True)
            if not arguments.no_browser:
                # Without the token: other users of this machine may read a browser's command line.
                webbrowser.open(address)
            ending.begin()
            source()
        finally:
            server.should_exit = True
            serving.join()
    _say(f"{pictures.states} states seen, {pictures.unreadable} messages could not be read")
    if pictures.states == 0:
        where = arguments.address if recording is None else arguments.file
        raise ViewError(f"{where}: nothing came that can be shown")
