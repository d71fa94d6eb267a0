"""What a web page of another origin has a real browser send: the daemon hears none of it.

A page may POST bytes of its choice to any port of this machine. libzmq takes them for ZMTP/1.0, as
a bare socket of its own shows here, which hears the same page's commands and subscriptions.
"""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import zmq

from softfinger.daemon.client.command_client import send
from softfinger.daemon.wire.keys import load_client, make_keys
from softfinger.daemon.wire.loop_link import Topics
from tests.conftest import own_addresses, until
from tests.harness.gateway import Served
from tests.harness.headless_browser import Browser, browser_path
from tests.process.test_strangers import old_command, old_frame, place

pytestmark = pytest.mark.skipif(browser_path() is None, reason="no Chromium on this machine")

COMMAND = old_command("arm")[2:]  # a browser's first frame, its own, is taken for the identity
SUBSCRIPTION = old_frame(b"\x01hand/")
TRIED = 6 * 3 + 3  # at an address

# Each body is sent in every way in which a page may send it without being asked to prove itself.
PAGE = b"""<!doctype html><title>a page</title><body><script>
const over = [];
let tried = 0;
function attack(address, bodies) {
  const url = () => `http://${address}/${tried++}`;  // libzmq knows a peer by its first line
  const end = () => over.push(address);
  const post = body => fetch(url(), {method: "POST", mode: "no-cors", body}).finally(end);
  for (const text of bodies) {
    const body = Uint8Array.from(atob(text), each => each.charCodeAt(0));
    post(body);
    post(new Blob([body], {type: "text/plain"}));
    const file = new File([body], "f"), data = new FormData(), files = new DataTransfer();
    data.append("f", file);
    post(data);
    const request = new XMLHttpRequest();
    request.onloadend = end;
    request.open("POST", url());
    request.send(body);
    if (navigator.sendBeacon(url(), body)) end();
    const name = `frame ${tried}`;
    document.body.insertAdjacentHTML("beforeend", `<iframe name="${name}"></iframe>
      <form target="${name}" action="${url()}" method=post enctype="multipart/form-data">
      <input type=file name=f></form>`);
    files.items.add(file);
    document.body.lastChild.firstElementChild.files = files.files;
    document.body.lastChild.submit();
    document.getElementsByName(name)[0].onload = end;
  }
  fetch(url(), {mode: "no-cors"}).finally(end);
  new WebSocket(url().replace("http", "ws")).onclose = end;
  const events = new EventSource(url());
  events.onerror = () => { events.close(); end(); };
}
</script>"""


class Page(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(PAGE)

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture(scope="module")
def browsing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Browser, str]]:
    """A browser, and where it finds the page."""
    server = ThreadingHTTPServer(place(own_addresses()[0]), Page)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    path = browser_path()
    assert path is not None
    shown = Browser(path, tmp_path_factory.mktemp("web") / "browser")
    try:
        yield shown, "http://{}:{}/".format(*server.server_address)
    finally:
        shown.close()
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def browser(browsing: tuple[Browser, str]) -> Browser:
    """The browser, which has just opened the page."""
    shown, page = browsing
    shown.open("about:blank")
    until(lambda: shown.evaluate("typeof attack") == "undefined")
    shown.open(page)
    until(lambda: shown.evaluate("typeof attack") == "function")
    return shown


def attack(browser: Browser, address: str, frames: bytes) -> None:
    """Have the page send ``frames``.

    Wherever the head of the request ends for a reader of ZMTP/1.0, one of three runs of twos, each
    a frame of three bytes, leads it to them.
    """
    bodies = [base64.b64encode(b"\x02" * (300 + k) + frames).decode() for k in range(3)]
    browser.evaluate(f"attack({address.removeprefix('tcp://')!r}, {json.dumps(bodies)})")


def test_libzmq_takes_what_a_page_sends_for_commands_and_subscriptions(
    browser: Browser, addresses: tuple[str, str], context: zmq.Context[zmq.Socket[bytes]]
) -> None:
    for address, kind, frames, wanted in (
        (addresses[0], zmq.XPUB, SUBSCRIPTION, SUBSCRIPTION[2:]),
        (addresses[1], zmq.ROUTER, COMMAND, COMMAND[4:]),
    ):
        bare = context.socket(kind)
        bare.bind(address)
        attack(browser, address, frames)
        until(comes(bare, wanted))


def comes(bare: zmq.Socket[bytes], wanted: bytes) -> Callable[[], bool]:
    return lambda: bool(bare.poll(0)) and bare.recv_multipart()[-1] == wanted


@pytest.mark.parametrize("guarded", [False, True], ids=["without keys", "with keys"])
def test_a_web_page_is_not_heard(
    browser: Browser,
    addresses: tuple[str, str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    guarded: bool,
) -> None:
    heard: list[Any] = []
    monkeypatch.setattr(Topics, "matching", lambda _, *prefixes: heard.extend(prefixes) or 0)
    folder = tmp_path / "keys"
    if guarded:
        make_keys(folder, ["alice"])
    keys = load_client(folder / "alice") if guarded else None

    def note(request: dict[str, Any]) -> dict[str, Any]:
        heard.append(request["command"])
        return {}

    with Served(*addresses, keys=str(folder) if guarded else "") as served, served.serving(note):
        for address, frames in zip(addresses, (SUBSCRIPTION, COMMAND), strict=True):
            attack(browser, address, frames)
        until(lambda: browser.evaluate("over.length") == 2 * TRIED)
        # A client still is.
        assert send(addresses[1], {"command": "status"}, timeout=60.0, keys=keys)["ok"]
    assert heard == ["status"]
