"""Test key files, and the access control that keys provide for the daemon's sockets."""

import errno
import os
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import msgpack
import pytest
import zmq
import zmq.auth

from softfinger import Hand, NoStream
from softfinger.daemon.client.command_client import NoAnswer, send
from softfinger.daemon.errors import KeyFileError
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.endpoints import ClientSockets
from softfinger.daemon.wire.keys import load_client, load_server, make_keys
from tests.conftest import Addresses, until
from tests.harness.gateway import Served


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Create keys for a server and for two clients, ``local`` and ``alice``."""
    make_keys(tmp_path / "keys", ["alice"])
    return tmp_path / "keys"


# --- files ------------------------------------------------------------------------------------


def test_key_files_are_private_and_readable_by_zeromq(folder):
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert len(files) == 8
    for path in files:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600, path
        public, secret = zmq.auth.load_certificate(path)
        assert len(public) == 40
        assert (secret is not None) is path.name.endswith("key_secret")
    assert {stat.S_IMODE(p.stat().st_mode) for p in folder.rglob("*") if p.is_dir()} == {0o700}


def test_the_server_accepts_the_key_that_a_client_shows(folder):
    server = load_server(folder)
    assert load_server(folder / "server") == server
    assert sorted(server.clients.values()) == ["alice", "local"]
    for name in ("alice", "local"):
        client = load_client(folder / name)
        assert server.clients[client.public] == name
        assert client.server == server.public
    assert load_client(folder) == load_client(folder / "local")


def test_adding_a_client_overwrites_no_files(folder):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    make_keys(folder, ["bob"])
    assert load_client(folder / "bob").public in load_server(folder).clients
    for names in (["bob"], ["carol", "alice"], ["server"], ["../x"], [""], ["d", "d"], []):
        with pytest.raises(KeyFileError):
            make_keys(folder, names)
    assert not (folder / "carol").exists()
    assert all(path.read_bytes() == text for path, text in before.items())


@pytest.mark.parametrize("new", [True, False])
def test_a_full_disk_leaves_no_incomplete_keys(tmp_path, monkeypatch, new):
    folder = tmp_path / "keys"
    if not new:
        make_keys(folder, [])
    before = {path for path in folder.rglob("*") if path.is_file()}
    copy = shutil.copyfile

    def copy_all_but_the_last(source: Path, target: Path) -> object:
        if target.parent.name == "bob":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))
        return copy(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copyfile", copy_all_but_the_last)
        with pytest.raises(KeyFileError, match=r"bob/server.key: No space left on device"):
            make_keys(folder, ["alice", "bob"])
    assert {path for path in folder.rglob("*") if path.is_file()} == before
    make_keys(folder, ["alice", "bob"])
    assert sorted(load_server(folder).clients.values()) == ["alice", "bob", "local"]


def test_damaged_missing_and_readable_key_files_are_reported(folder):
    with pytest.raises(KeyFileError, match=r"can't be read: .*softfinger keys"):
        load_server(folder / "nowhere")
    secret = folder / "server" / "server.key_secret"
    secret.chmod(0o640)
    with pytest.raises(
        KeyFileError, match=r"other users can read this file \(0640\); run chmod 600"
    ):
        load_server(folder)
    secret.chmod(0o600)
    for line in (
        'public-key = "short"',
        f'public-key = "{"#" * 40}"',
        "public-key",
        "",
        "\N{BULLET}",
    ):
        (folder / "alice" / "server.key").write_text(line + "\n", encoding="utf-8")
        with pytest.raises(KeyFileError, match="not a key file"):
            load_client(folder / "alice")
    for path in (folder / "server" / "clients").iterdir():
        path.unlink()
    with pytest.raises(KeyFileError, match="does not contain client keys"):
        load_server(folder)


def test_an_unreadable_folder_of_client_keys_is_reported(folder, monkeypatch):
    keys, clients = load_server(folder), folder / "server" / "clients"

    def denied(path: Path) -> NoReturn:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, "exists", denied)
    with pytest.raises(KeyFileError, match=r"clients: can't be read: Permission denied; make it"):
        keys.updated()
    monkeypatch.undo()
    clients.rename(folder / "moved")
    clients.touch(0o600)
    with pytest.raises(KeyFileError, match="clients: can't be read: Not a directory"):
        load_server(folder)


@pytest.mark.parametrize(
    "which",
    ["", "server", "server/clients", "server/clients/alice.key", "server/server.key_secret"],
)
def test_keys_that_others_own_or_may_write_are_refused(folder, which, monkeypatch):
    path = folder / which if which else folder
    mode = stat.S_IMODE(path.stat().st_mode)
    path.chmod(mode | 0o022)
    with pytest.raises(KeyFileError, match=f"{path}: other users can"):
        load_server(folder)
    path.chmod(mode)
    load_server(folder)
    monkeypatch.setattr(os, "geteuid", lambda: 4_242)  # Pretend to be another user.
    if os.getuid() == 0:
        for each in [path, *path.parents]:
            if each.is_relative_to(folder):
                os.chown(each, 4_242, -1)
        os.chown(path, 4_243, -1)
    with pytest.raises(KeyFileError, match="is owned by user"):
        load_server(folder)


def test_client_keys_are_still_revoked_without_free_file_descriptors(folder, monkeypatch):
    def no_descriptor_left(path: Path) -> NoReturn:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE), str(path))

    keys = ClientSockets(Config("", "", [], 100, keys=str(folder)))
    clients = folder / "server" / "clients"
    try:
        monkeypatch.setattr(zmq.auth, "load_certificate", no_descriptor_left)
        with pytest.raises(KeyFileError, match=os.strerror(errno.EMFILE)):
            load_server(folder)
        keys.authenticate(1.0)
        (clients / "alice.key").unlink()
        with pytest.raises(KeyFileError, match="disconnected clients without a key file: alice"):
            keys.authenticate(2.0)
        clients.chmod(0o777)
        with pytest.raises(KeyFileError, match="other users can write to it"):
            keys.authenticate(3.0)
    finally:
        keys.close()


# --- sockets ----------------------------------------------------------------------------------


class Guarded:
    """The sockets of a daemon that requires keys and executes commands on arrival."""

    def __init__(self, addresses: Addresses, folder: Path) -> None:
        self.served = Served(*addresses, keys=str(folder))
        self.heard: list[dict[str, Any]] = []

    def step(self) -> None:
        self.served.publisher.event(0.0, 0.0, "info", "test", "told")
        self.served.serve(self._hear)

    def _hear(self, request: dict[str, Any], _: float) -> dict[str, Any]:
        self.heard.append(request)
        return {}


@pytest.fixture
def guarded(addresses: Addresses, folder: Path) -> Iterator[Guarded]:
    guarded = Guarded(addresses, folder)
    with guarded.served:
        yield guarded


@pytest.fixture
def others() -> Iterator[zmq.Context[Any]]:
    """Return a context for clients, which is separate from the daemon's context, as in practice."""
    others: zmq.Context[Any] = zmq.Context()
    others.linger = 0
    yield others
    others.destroy()


def ask(
    context: zmq.Context[Any], addresses: Addresses, keys: Any
) -> tuple[zmq.Socket[Any], zmq.Socket[Any]]:
    """Return a subscriber, and a socket that has sent a command in another client's name."""
    subscriber, commander = context.socket(zmq.SUB), context.socket(zmq.DEALER)
    for socket, address in zip((subscriber, commander), addresses, strict=True):
        if keys is not None:
            keys.guard(socket)
        if socket is subscriber:
            socket.subscribe(b"")
        socket.connect(address)
    # The daemon ignores the client name in the request.
    commander.send(msgpack.packb({"command": "arm", "client": "local"}))
    return subscriber, commander


def stranger(folder: Path, kind: str) -> Any:
    own = load_client(folder / "alice")
    public, secret = zmq.curve_keypair()
    if kind == "no key":
        return None
    if kind == "another server's":
        return type(own)(public, own.public, own.secret)
    return type(own)(own.server, public, secret)


@pytest.mark.parametrize("kind", ["no key", "unknown key", "another server's"])
def test_the_key_identifies_a_client_and_clients_without_a_key_get_nothing(
    guarded, others, addresses, folder, kind
):
    theirs = ask(others, addresses, stranger(folder, kind))
    ours = ask(others, addresses, load_client(folder / "alice"))

    def received() -> bool:
        guarded.step()
        return bool(ours[0].poll(2)) and bool(ours[0].recv_multipart())

    for _ in range(200):  # Only the client with a key receives messages.
        until(received)
    until(lambda: guarded.step() or ours[1].poll(0))
    assert not theirs[0].poll(0)
    assert not theirs[1].poll(0)
    assert guarded.heard == [{"command": "arm", "client": "alice"}]


def test_a_small_command_size_limit_does_not_prevent_the_handshake(addresses, folder, others):
    with Served(*addresses, keys=str(folder), max_bytes=64) as served:
        _, commander = ask(others, addresses, load_client(folder))
        served.serve_until(lambda *_: {}, lambda: commander.poll(0))
        assert msgpack.unpackb(commander.recv())["ok"]


def test_a_stop_is_answered_while_others_stop_continuously(guarded, others, addresses, folder):
    stopper = others.socket(zmq.REQ)
    load_client(folder / "alice").guard(stopper)
    stopper.connect(addresses[1])
    stopper.send(msgpack.packb({"command": "stop"}))

    def answered() -> int:
        guarded.served.link.fence()  # The real loop sends a fence after every stop.
        guarded.step()
        return stopper.poll(0)

    until(answered)
    assert msgpack.unpackb(stopper.recv())["ok"]


# --- the daemon -------------------------------------------------------------------------------


def test_clients_are_removed_and_added_while_the_daemon_runs(profile, addresses, folder, start):
    running = start(
        "--config", str(profile(f'access.keys = "{folder}"\nsafety.overruns_fault = 100000\n'))
    )
    with Hand(*addresses, keys=folder / "alice", timeout=60.0) as alice:
        assert alice.state().mode == "disarmed"
        (folder / "server" / "clients" / "alice.key").unlink()

        def shut_out() -> bool:
            try:
                alice.state(timeout=0.5)
            except NoStream:
                return True
            return False

        until(shut_out)
        with (
            Hand(*addresses, keys=folder, timeout=60.0) as local,
            local.events(timeout=60.0) as told,
        ):
            assert any(
                "disconnected clients without a key file: alice" in event.text for event in told
            )
        with pytest.raises(NoAnswer):
            send(addresses[1], {"command": "arm"}, 0.5, load_client(folder / "alice"))
    make_keys(folder, ["bob"])

    def bob_is_let_in() -> bool:
        try:
            return bool(send(addresses[1], {"command": "status"}, 1.0, load_client(folder / "bob")))
        except NoAnswer:
            return False

    until(bob_is_let_in)  # The daemon checks for new keys periodically.
    with Hand(*addresses, keys=folder, timeout=60.0) as local:
        assert local.state().mode == "disarmed"
    assert running.end() == 0


def test_the_command_creates_keys_only_once(tmp_path, inline):
    words = ("keys", tmp_path / "keys", "alice")
    first, again = inline(*words), inline(*words)
    assert first.returncode == 0
    assert first.stdout.split() == [
        str(tmp_path / "keys" / name) for name in ("server", "local", "alice")
    ]
    assert again.returncode == 1
    assert "client alice already exists" in again.stderr
