"""Test that clients with the old protocol ZMTP/1.0 can neither send commands nor receive messages.

A web page can make a browser POST arbitrary bytes to any port of this machine. The posted bytes can
form ZMTP/1.0 frames. ZMTP/1.0 has no handshake that would distinguish a browser from a client.
"""

import contextlib
import socket
from collections.abc import Callable

import msgpack
import pytest
import zmq

from softfinger import Hand
from tests.conftest import until
from tests.harness.daemon_process import ask


def old_frame(body: bytes, more: bool = False) -> bytes:
    """Return a ZMTP/1.0 frame, which consists of its length, flags and body."""
    return bytes([len(body) + 1, more]) + body


def old_command(name: str) -> bytes:
    """Return an identity and a command as a ZMTP/1.0 REQ socket sends them."""
    payload = msgpack.packb({"command": name})
    return old_frame(b"") + old_frame(b"", more=True) + old_frame(payload)


def posted(frames: bytes, address: str) -> bytes:
    """Return an HTTP request whose header is a valid ZeroMQ frame and whose body is ``frames``."""
    for padding in range(256):
        head = (
            f"POST /{'x' * padding} HTTP/1.1\r\nHost: {address.removeprefix('tcp://')}\r\n"
            f"Content-Type: text/plain\r\nContent-Length: {len(frames)}\r\n\r\n"
        ).encode()
        at = 0
        while at < len(head):
            at += 1 + head[at]
        if at == len(head):
            return head + frames
    raise AssertionError("no padding ends the head with a frame")


def place(address: str) -> tuple[str, int]:
    """Return host and port."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    return host, int(port)


def said_to(request: bytes, address: str, wait: Callable[[], object]) -> bytes:
    """Send ``request``, call ``wait``, and return the bytes that the daemon sends in reply."""
    with socket.create_connection(place(address), timeout=60.0) as raw:
        raw.sendall(request)
        wait()
        answer = b""
        with contextlib.suppress(OSError):  # The daemon may have closed the connection.
            raw.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionError):
            while part := raw.recv(4096):
                answer += part
    return answer


@pytest.mark.parametrize("wrap", [lambda frames, _: frames, posted], ids=["ZMTP/1.0", "HTTP POST"])
def test_libzmq_itself_accepts_the_bytes_as_commands(addresses, context, wrap):
    bare = context.socket(zmq.ROUTER)
    bare.bind(addresses[1])
    request = wrap(old_command("arm") + old_command("arm")[2:], addresses[1])
    with socket.create_connection(place(addresses[1]), timeout=60.0) as raw:
        raw.sendall(request)
        wanted = msgpack.packb({"command": "arm"})
        until(lambda: bool(bare.poll(0)) and bare.recv_multipart()[-1] == wanted)


@pytest.mark.parametrize("wrap", [lambda frames, _: frames, posted], ids=["ZMTP/1.0", "HTTP POST"])
def test_a_web_page_can_neither_send_nor_receive(daemon, wrap):
    request = wrap(old_command("arm") + old_command("arm")[2:], daemon.commands)
    with Hand(*daemon.addresses, timeout=60.0) as hand:
        answer = said_to(
            request, daemon.commands, lambda: [ask(daemon.commands, "status") for _ in range(20)]
        )
        assert b"ok" not in answer
        assert hand.state().mode == "disarmed"
        hand.arm()  # The daemon continues to serve other clients.
        assert hand.wait_for(lambda state: state.torque, 60.0).mode == "armed"
        hand.stop()
        request = wrap(old_frame(b"") + old_frame(b"\x01hand/"), daemon.addresses[0])
        assert b"hand/" not in said_to(request, daemon.addresses[0], lambda: hand.collect(0.5))
