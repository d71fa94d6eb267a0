"""The daemon's sockets: free, or who answers there."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
from pathlib import Path

from softfinger.daemon.client.command_client import NoAnswer, send
from softfinger.daemon.diagnosis.result import Result
from softfinger.daemon.errors import KeyFileError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire.keys import load_client

_PATIENCE = 0.5  # s for a daemon to answer


def check_addresses(settings: Settings) -> list[Result]:
    """Whether the stream's and the commands' address can be bound, and who has them if not."""
    return [_check(settings, "stream"), _check(settings, "commands")]


def _check(settings: Settings, section: str) -> Result:
    address, key = getattr(settings, section).address, f"{section}.address"
    subject, trouble = f"socket {address}", why_not_free(address)
    if not trouble:
        return Result("pass", subject, "free")
    if trouble != "in use":
        return Result("FAIL", subject, trouble, f"set {key}")
    if mode := daemon_mode(settings.commands.address, settings.access.keys):
        text = f"a softfinger daemon runs here already ({mode}); a second one will not start"
        return Result("warn", subject, text, "end that one before you start another")
    text = "in use by something that is not a softfinger daemon"
    return Result("FAIL", subject, text, f"end it, or set {key} to another address")


def daemon_mode(address: str, keys: str = "") -> str:
    """The mode of the daemon that answers commands at ``address``; empty when none does.

    ``keys`` is the folder of `softfinger keys`, where the daemon wants some.
    """
    try:
        own = load_client(Path(keys)) if keys else None
        reply = send(address, {"command": "status"}, _PATIENCE, own)
    except (NoAnswer, KeyFileError, OSError):
        return ""
    return str(reply.get("mode", "running")) if reply.get("ok") else "starting"


def why_not_free(address: str) -> str:
    """Empty when the daemon could bind ``address`` (tcp or ipc); else ``in use`` or what is wrong.

    It is bound for an instant, or its lock is tried, and nothing is left behind.
    """
    kind, _, place = address.partition("://")
    if kind == "tcp":
        return _tcp(place)
    if kind == "ipc":
        return _ipc(place)
    return f"{kind} is no kind of address: expected tcp or ipc"


def _tcp(place: str) -> str:
    host, _, port = place.rpartition(":")
    host = host.strip("[]")
    if not port.isdigit() or not 0 < int(port) < 65536:
        return "has no port number"
    if host == "*":
        host = "0.0.0.0"
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((host, int(port)))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return "in use"
            return f"can't be bound: {error.strerror or error}"
    return ""


def _ipc(place: str) -> str:
    path = Path(place)
    if not os.access(path.parent, os.W_OK):
        return f"can't be bound: {path.parent} is not there or may not be written"
    try:
        lock = os.open(f"{place}.lock", os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return ""
    except OSError as error:
        return f"can't be bound: {error.strerror}"
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return "in use"
    finally:
        os.close(lock)
    return ""
