"""The door before Foxglove's server: who is let in, and who is shown out."""

import socket
import socketserver
import threading
from collections.abc import Iterator

import pytest

from softfinger.tools.viewing.door import CLIENTS, Door

WAIT = 60.0  # s


class Flooding(socketserver.BaseRequestHandler):
    """Answers, and sends without end."""

    def handle(self) -> None:
        self.request.recv(4096)
        self.request.sendall(b"HTTP/1.1 101 Welcome\r\n\r\n")
        try:
            while True:
                self.request.sendall(bytes(65536))
        except OSError:
            pass


@pytest.fixture
def door() -> Iterator[Door]:
    class Server(socketserver.ThreadingTCPServer):
        daemon_threads = True

    with Server(("127.0.0.1", 0), Flooding) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        door = Door(0, ("127.0.0.1", server.server_address[1]))
        yield door
        door.close()
        server.shutdown()


def ask(door: Door, fields: str = "Host: 127.0.0.1:8765\r\n") -> tuple[socket.socket, bytes]:
    """A client, and how its request was answered."""
    client = socket.create_connection(("127.0.0.1", door.port), timeout=WAIT)
    client.sendall(f"GET / HTTP/1.1\r\n{fields}\r\n".encode())
    return client, client.recv(12)


@pytest.mark.parametrize(
    ("fields", "answer"),
    [
        ("Host: 127.0.0.1:1\r\n", 101),
        ("host:localhost\r\nOrigin: https://app.foxglove.dev\r\n", 101),
        ("Host: 127.0.0.1\r\nOrigin: https://evil.example\r\n", 403),
        ("Host: 127.0.0.1\r\nOrigin: null\r\n", 403),
        ("Host: 127.0.0.1\r\nOrigin: https://evil.example\r\nOrigin: file://\r\n", 403),
        ("Host: rebound.example\r\n", 403),
        ("", 403),
    ],
)
def test_only_this_machine_and_foxglove_are_let_in(door, fields, answer):
    client, answered = ask(door, fields)
    with client:
        assert answered == f"HTTP/1.1 {answer}".encode()


def test_a_client_that_reads_nothing_makes_room_for_another(door):
    lazy = [ask(door) for _ in range(CLIENTS)]
    assert {answered for _, answered in lazy} == {b"HTTP/1.1 101"}
    late = b"HTTP/1.1 503"
    client = None
    while late == b"HTTP/1.1 503":
        client, late = ask(door)
        client.close()
    assert late == b"HTTP/1.1 101"
    for each, _ in lazy:
        each.close()


def test_a_request_without_an_end_is_not_waited_for(door):
    with socket.create_connection(("127.0.0.1", door.port), timeout=WAIT) as client:
        client.sendall(b"GET / HTTP/1.1\r\n")
        assert client.recv(100) == b""
