"""The web page of ``softfinger view``: its server on the loopback, and its buttons and sliders.

One thread reads the stream, or plays a recording, and makes a picture for all pages. A page asks
for the next picture when it has drawn the last, so that a slow one skips and costs nothing. Whoever
has the token that the terminal prints gets the commands, with a commander's lease for each page.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import secrets
import socket
import time
import webbrowser
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
import zmq
from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from nicegui import ui
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from softfinger.daemon.client.command_client import NoAnswer, accepted, send
from softfinger.daemon.control.modes import COMMANDS, GRIPPING
from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.warm_up import LANDSCAPE
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.arguments import client_keys, to_stderr
from softfinger.tools.ending import Ending
from softfinger.tools.processes.kernel_build import build_kernels
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.terminal.feed import Commander
from softfinger.tools.viewing.live_stream import LOOPBACK, NICE, ViewError, follow
from softfinger.tools.viewing.pictures import Pictures
from softfinger.tools.viewing.playback import Playback

_HEAD = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
_HOSTS = (LOOPBACK, "localhost")
_PORT = 9090  # where nobody says another
_REFRESH = 0.1  # s between two looks at replies and modes
_STEP = 5.0  # ° of the two buttons beside the angle
_ANGLE = 40.0  # ° that the slider reaches to both sides
_FORCE = 30.0  # N, where the hand's own limit is not known
_say = to_stderr("view")
_SIMPLE = {"arm": "arm", "release": "open", "disarm": "disarm", "tare": "tare", "clear": "clear"}


class SameOrigin:
    """Lets in what names this machine as its host, and pages of this very server.

    A name that an attacker's DNS leads here is another host; a foreign page's requests and
    WebSockets carry its own origin.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = dict(scope.get("headers", ()))
        host = headers.get(b"host", b"").decode("latin-1")
        origin = headers.get(b"origin", b"").decode("latin-1")
        here = host.partition(":")[0] in _HOSTS and origin in ("", f"http://{host}")
        if here or scope["type"] == "lifespan":
            await self.app(scope, receive, send)
        elif scope["type"] == "websocket":
            await WebSocketClose(1008)(scope, receive, send)
        else:
            await PlainTextResponse("only for pages of this machine", 403)(scope, receive, send)


class Newest:
    """The newest scene and picture, for whoever waits. ``watching`` pages do."""

    def __init__(self) -> None:
        self.watching = 0
        self._loop = asyncio.get_running_loop()
        self._pair = b"", b""
        self._come = asyncio.Event()

    def publish(self, scene: bytes, picture: bytes) -> None:
        """From any thread."""
        self._loop.call_soon_threadsafe(self._take, scene, picture)

    def _take(self, scene: bytes, picture: bytes) -> None:
        self._pair = scene, picture
        self._come.set()
        self._come = asyncio.Event()

    async def serve(self, page: WebSocket) -> None:
        """Send a page the next picture each time it asks, and the scene where it is another."""
        await page.accept()
        self.watching += 1
        known = b""
        try:
            while True:
                await page.receive_text()
                await self._come.wait()
                scene, picture = self._pair
                if scene is not known:
                    known = scene
                    await page.send_text(scene.decode())
                await page.send_text(picture.decode())
        except WebSocketDisconnect:
            pass
        finally:
            self.watching -= 1


class CommandBar:
    """One page's buttons and sliders. Its commands are a commander's of its own."""

    def __init__(self, pictures: Pictures, commander: Commander) -> None:
        self._pictures = pictures
        self._commander = commander
        self._buttons: dict[str, list[ui.button]] = {}
        self._shown: Any = None
        with ui.row().classes("items-center"):
            stop = ui.button("STOP", color="red").props("size=lg").classes("stop")
            stop.on("click", js_handler="() => stop()")
            for command, name in _SIMPLE.items():
                self._button(name, command, lambda _, command=command: self._send(command))
        with ui.row().classes("items-center no-wrap slider"):
            self._button("grasp", "grasp", self._grasp)
            self._force = ui.slider(min=0.5, max=_FORCE, step=0.5, value=5.0)
            self._force.on("change", lambda _: self._grasp() if self._gripping else None)
            ui.label().bind_text_from(self._force, "value", lambda force: f"{force:.1f} N")
        with ui.row().classes("items-center no-wrap slider"):
            self._button(f"−{_STEP:g}°", "rotate", lambda _: self._turn(-_STEP))
            self._angle = ui.slider(min=-_ANGLE, max=_ANGLE, step=1.0, value=0.0)
            self._angle.on("change", lambda _: self._rotate())
            self._button(f"+{_STEP:g}°", "rotate", lambda _: self._turn(_STEP))
            ui.label().bind_text_from(self._angle, "value", lambda angle: f"{angle:+.0f}°")
        ui.label().classes("reply")  # the script's, which shows a stop's reply there, too
        ui.timer(_REFRESH, self._refresh)

    def _button(self, name: str, command: str, pressed: Callable[..., object]) -> None:
        button = ui.button(name, on_click=pressed).props("no-caps").classes(command)
        self._buttons.setdefault(command, []).append(button)

    @property
    def _gripping(self) -> bool:
        return self._pictures.feed.mode in GRIPPING

    def _send(self, command: str, label: str = "", **numbers: float) -> None:
        self._commander.send(time.monotonic(), label or command, command, **numbers)

    def _grasp(self) -> None:
        force = float(self._force.value)
        self._send("grasp", f"grasp with {force:.1f} N", force=force)

    def _turn(self, step: float) -> None:
        """Further than the last goal, so that several presses add up."""
        state = self._pictures.feed.state
        goal = state.goal_angle if math.isfinite(state.goal_angle) else state.object.angle
        if math.isfinite(goal):
            self._angle.value = round(math.degrees(goal) + step)
        self._rotate()

    def _rotate(self) -> None:
        angle = float(self._angle.value)
        self._send("rotate", f"rotate to {angle:.0f}°", angle=math.radians(angle))

    def _refresh(self) -> None:
        """Show the newest reply; offer what the mode allows, but for stop, which always is."""
        self._commander.collect(time.monotonic())
        feed, reply = self._pictures.feed, self._commander.reply
        shown = feed.mode, feed.force_limit, reply
        if shown == self._shown:
            return
        self._shown = shown
        if reply is not None:
            words = f"{'✓' if reply.ok else '✗'} {reply.text}"
            ui.run_javascript(f"say({json.dumps(words)})")
        if math.isfinite(feed.force_limit):
            self._force.props(f"max={feed.force_limit:g}")
        for command, buttons in self._buttons.items():
            for button in buttons:
                button.set_enabled(feed.mode in COMMANDS[command][0])


class PlayBar:
    """One page's slider over the recording, which all pages see at the same place."""

    def __init__(self, playback: Playback) -> None:
        end = playback.duration
        with ui.row().classes("items-center no-wrap slider"):
            ui.switch("play").bind_value(playback, "playing").classes("play")
            slider = ui.slider(min=0.0, max=end, step=0.01, value=playback.position)
            slider.on("update:model-value", lambda e: playback.seek(e.args), throttle=0.1)
            place = ui.label().classes("place")

        def refresh() -> None:
            slider.value = playback.position
            place.text = f"{playback.position:.1f} of {end:.1f} s"

        ui.timer(_REFRESH, refresh)


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
    with listen(arguments.port) as listener:
        pictures = asyncio.run(_serve(arguments, ending, recording, listener))
    _say(f"{pictures.shown} states seen, {pictures.unreadable} messages could not be read")
    if pictures.shown == 0:
        where = arguments.address if recording is None else arguments.file
        raise ViewError(f"{where}: nothing came that can be shown")


async def _serve(
    arguments: argparse.Namespace,
    ending: Ending,
    recording: Recording | None,
    listener: socket.socket,
) -> Pictures:
    newest = Newest()
    pictures = Pictures(newest.publish, lambda: newest.watching > 0, _say, live=recording is None)
    keys = client_keys(arguments.keys)
    context: zmq.Context[Any] = zmq.Context()
    if keys is not None:
        keys.guard(context)
    token = playback = None
    if recording is None:
        token = secrets.token_urlsafe(16)
        source = partial(follow, arguments, keys, pictures, ending, _say)
    else:
        playback = Playback(recording, pictures, 1.0 / arguments.rate)
        source = partial(playback.run, ending)

    def may_command(given: str) -> bool:
        return token is not None and secrets.compare_digest(given.encode(), token.encode())

    def stop(token: str = "") -> PlainTextResponse:
        if not may_command(token):
            return PlainTextResponse("✗ stop: needs the token that the terminal prints", 403)
        try:
            accepted(send(arguments.commands, {"command": "stop"}, keys=keys))
        except (NoAnswer, Refused) as error:
            return PlainTextResponse(f"✗ stop: {error}", 502)
        return PlainTextResponse("✓ stop: ok")

    def page(token: str = "") -> None:
        ui.add_head_html(_HEAD)
        ui.html('<div id="board"></div>', sanitize=False)
        with ui.footer():
            if playback is not None:
                PlayBar(playback)
            elif may_command(token):
                name = f"page {secrets.token_hex(2)}"
                CommandBar(pictures, Commander(context, arguments.commands, name))
            else:
                ui.label("Watching. To command, open the address that the terminal prints.")

    server = uvicorn.Server(
        uvicorn.Config(
            SameOrigin(_site(page, stop, newest)),
            log_level="error",
            access_log=False,
            proxy_headers=False,
            timeout_graceful_shutdown=1,
        )
    )
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    while not (server.started or serving.done()):
        await asyncio.sleep(0.01)
    address = f"http://{LOOPBACK}:{listener.getsockname()[1]}/"
    if token is not None:
        print(f"view: {address}?token={token} to see and command the hand", flush=True)
    print(f"view: {address} to see it", flush=True)
    if not arguments.no_browser:
        # Without the token: other users of this machine may read a browser's command line.
        webbrowser.open(address)
    ending.begin()
    reading = asyncio.create_task(asyncio.to_thread(source))
    await asyncio.wait({serving, reading}, return_when=asyncio.FIRST_COMPLETED)
    server.should_exit = True
    ending.end()
    await serving
    context.destroy(linger=0)
    await reading  # and raise what ended it
    return pictures


def _site(
    page: Callable[..., None], stop: Callable[..., PlainTextResponse], newest: Newest
) -> FastAPI:
    """The page at /, its pictures at /pictures, and NiceGUI's own files; nothing else.

    A stop is a request of its own: a page that slept has lost its connection, and doesn't know yet.
    """
    site = FastAPI(openapi_url=None)
    site.post("/stop", response_class=PlainTextResponse)(stop)
    site.add_api_websocket_route("/pictures", newest.serve)
    ui.page("/", title="softfinger", dark=True)(page)
    ui.run_with(
        site,
        show_welcome_message=False,
        tailwind=False,
        message_history_length=0,  # a page that was away is opened anew
    )
    return site
