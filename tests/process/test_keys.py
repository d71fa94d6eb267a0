"""Keys: the files, and that nobody without one gets anything from the daemon's sockets."""

from __future__ import annotations

import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
import zmq.auth

from daemon.client import Hand
from daemon.commands import CommandServer, NoAnswer, send
from daemon.doorkeeper import Doorkeeper
from daemon.keys import KeyFileError, ServerKeys, load_client, load_server, make_keys
from daemon.sockets import Guard
from daemon.stream import Publisher
from tests.conftest import until
from tests.harness.daemon_process import Running, insist, softfinger, until_it_says


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Keys of a server, of the client local, and of alice."""
    make_keys(tmp_path / "keys", ["alice"])
    return tmp_path / "keys"


# --- files ------------------------------------------------------------------------------------


def test_every_file_is_its_owners_alone_and_zeromq_reads_it(folder: Path) -> None:
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert len(files) == 7
    for path in files:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600, path
        public, secret = zmq.auth.load_certificate(path)
        assert len(public) == 40
        assert (secret is not None) is path.name.endswith("key_secret")
    assert {stat.S_IMODE(p.stat().st_mode) for p in folder.rglob("*") if p.is_dir()} == {0o700}


def test_what_a_client_shows_is_what_the_server_lets_in(folder: Path) -> None:
    server = load_server(folder)
    assert load_server(folder / "server") == server
    assert sorted(server.clients.values()) == ["alice", "local"]
    for name in ("alice", "local"):
        client = load_client(folder / name)
        assert server.clients[client.public] == name
        assert client.server == server.public
    assert load_client(folder) == load_client(folder / "local")


def test_a_client_is_added_and_nothing_is_overwritten(folder: Path) -> None:
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    make_keys(folder, ["bob"])
    assert load_client(folder / "bob").public in load_server(folder).clients
    for names in (["bob"], ["carol", "alice"], ["server"], ["../x"], [""], ["d", "d"], []):
        with pytest.raises(KeyFileError):
            make_keys(folder, names)
    assert not (folder / "carol").exists()
    assert all(path.read_bytes() == text for path, text in before.items())


def test_damaged_missing_and_open_files_are_told(folder: Path) -> None:
    with pytest.raises(KeyFileError, match=r"can't be read: .*softfinger keys"):
        load_server(folder / "nowhere")
    secret = folder / "server" / "server.key_secret"
    secret.chmod(0o640)
    with pytest.raises(KeyFileError, match=r"may be read by others \(0640\): chmod 600"):
        load_server(folder)
    secret.chmod(0o600)
    (folder / "alice" / "server.key").write_text('public-key = "short"\n', encoding="ascii")
    with pytest.raises(KeyFileError, match="no key file"):
        load_client(folder / "alice")
    for path in (folder / "server" / "clients").iterdir():
        path.unlink()
    with pytest.raises(KeyFileError, match="no client's key"):
        load_server(folder)


def test_a_libzmq_without_curve_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zmq, "has", lambda _: False)
    with pytest.raises(KeyFileError, match="built without CURVE"):
        make_keys(tmp_path, [])


# --- sockets ----------------------------------------------------------------------------------


class Guarded:
    """Both of the daemon's sockets, guarded; commands are answered as they come."""

    def __init__(self, context: zmq.Context[Any], addresses: tuple[str, str], folder: Path) -> None:
        keys = load_server(folder)
        self.doorkeeper = Doorkeeper(context, keys.clients)
        self.publisher = Publisher(context, addresses[0], 10, Guard(keys=keys))
        self.server = CommandServer(context, addresses[1], 200, guard=Guard(keys=keys))
        self.heard: list[str] = []

    def step(self) -> None:
        self.publisher.refresh()
        self.publisher.event(0.0, 0.0, "info", "test", "told")
        self.server.serve(self._hear)

    def _hear(self, request: dict[str, Any]) -> dict[str, Any]:
        self.heard.append(request["command"])
        return {}

    def close(self) -> None:
        self.server.close()
        self.publisher.close()
        self.doorkeeper.close()


@pytest.fixture
def guarded(
    context: zmq.Context[Any], addresses: tuple[str, str], folder: Path
) -> Iterator[Guarded]:
    guarded = Guarded(context, addresses, folder)
    yield guarded
    guarded.close()


@pytest.fixture
def others() -> Iterator[zmq.Context[Any]]:
    """Where the clients live: as in life, not in the daemon's context."""
    others: zmq.Context[Any] = zmq.Context()
    yield others
    others.destroy(linger=0)


def ask(
    context: zmq.Context[Any], addresses: tuple[str, str], keys: Any
) -> tuple[zmq.Socket[Any], zmq.Socket[Any]]:
    """A subscriber and a command on its way."""
    subscriber, commander = context.socket(zmq.SUB), context.socket(zmq.DEALER)
    for socket, address in zip((subscriber, commander), addresses, strict=True):
        socket.setsockopt(zmq.LINGER, 0)
        if keys is not None:
            keys.guard(socket)
        if socket is subscriber:
            socket.subscribe(b"")
        socket.connect(address)
    commander.send(msgpack.packb({"command": "arm"}))
    return subscriber, commander


def test_a_client_with_its_key_subscribes_and_commands(
    guarded: Guarded, others: zmq.Context[Any], addresses: tuple[str, str], folder: Path
) -> None:
    subscriber, commander = ask(others, addresses, load_client(folder / "alice"))

    def both() -> bool:
        guarded.step()
        return bool(subscriber.poll(0) and commander.poll(0))

    until(both)
    assert guarded.heard == ["arm"]


def stranger(folder: Path, kind: str) -> Any:
    own = load_client(folder / "alice")
    public, secret = zmq.curve_keypair()
    if kind == "no key":
        return None
    if kind == "another server's":
        return type(own)(public, own.public, own.secret)
    return type(own)(own.server, public, secret)


@pytest.mark.parametrize("kind", ["no key", "unknown key", "another server's"])
def test_whoever_has_no_key_gets_nothing(
    guarded: Guarded,
    others: zmq.Context[Any],
    addresses: tuple[str, str],
    folder: Path,
    kind: str,
) -> None:
    theirs = ask(others, addresses, stranger(folder, kind))
    ours = ask(others, addresses, load_client(folder / "alice"))
    seen = 0
    while seen < 200:  # ours was served two hundred times, and the stranger never
        guarded.step()
        if ours[0].poll(2):
            ours[0].recv_multipart()
            seen += 1
    until(lambda: guarded.step() or ours[1].poll(0))
    assert not theirs[0].poll(0)
    assert not theirs[1].poll(0)
    assert guarded.heard == ["arm"]


def test_without_a_doorkeeper_nobody_is_let_in(
    context: zmq.Context[Any],
    others: zmq.Context[Any],
    addresses: tuple[str, str],
    folder: Path,
) -> None:
    keys: ServerKeys = load_server(folder)
    server = CommandServer(context, addresses[1], 200, guard=Guard(keys=keys))
    socket = others.socket(zmq.DEALER)
    socket.setsockopt(zmq.LINGER, 0)
    load_client(folder).guard(socket)
    monitor = socket.get_monitor_socket()
    socket.connect(addresses[1])
    socket.send(msgpack.packb({"command": "arm"}))
    from zmq.utils.monitor import parse_monitor_message

    events = []
    while zmq.EVENT_DISCONNECTED not in events and zmq.EVENT_HANDSHAKE_FAILED_AUTH not in events:
        assert monitor.poll(10_000)
        events.append(parse_monitor_message(monitor.recv_multipart())["event"])
        assert events[-1] != zmq.EVENT_HANDSHAKE_SUCCEEDED
    assert not server.serve(lambda _: {})
    socket.disable_monitor()
    server.close()


# --- the daemon -------------------------------------------------------------------------------


def test_a_running_daemon_with_keys(
    start: Callable[..., Running],
    profile: Callable[..., Path],
    addresses: tuple[str, str],
    folder: Path,
) -> None:
    """Tools with the key work, tools without get no answer; the monitor beside it is let in."""
    path = profile(f'access.keys = "{folder}"\n')
    running = start("--config", str(path))
    words = ("status", "--address", addresses[1], "--keys", str(folder), "--timeout", "60")
    told = softfinger("send", *words)
    assert told.returncode == 0, told.stderr
    with pytest.raises(NoAnswer):
        send(addresses[1], {"command": "stop"}, timeout=0.3)
    with Hand(*addresses, keys=folder / "alice", timeout=60.0) as hand:
        assert hand.state().mode == "disarmed"
        insist(hand.arm)
        assert hand.wait_for(lambda state: state.torque, 60.0).mode == "armed"
    where = ("--state", addresses[0], "--commands", addresses[1])
    until_it_says(("monitor", "--plain", "--keys", folder / "alice", *where), "armed")
    assert running.end() == 0


def test_the_command_makes_keys_and_refuses_to_make_them_again(tmp_path: Path) -> None:
    words = ("keys", str(tmp_path / "keys"), "alice")
    first, again = softfinger(*words), softfinger(*words)
    assert first.returncode == 0
    assert first.stdout.split() == [
        str(tmp_path / "keys" / name) for name in ("server", "local", "alice")
    ]
    assert again.returncode == 1
    assert "client alice is there already" in again.stderr
