"""Check that serial ports and sockets are available and not in use."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import stat
from pathlib import Path

import zmq
from serial.tools import list_ports

from softfinger.daemon.client.command_client import NoAnswer, send
from softfinger.daemon.errors import AddressError, KeyFileError
from softfinger.daemon.gateway.endpoints import bind
from softfinger.daemon.own_files import IN_USE, runtime_fault, runtime_folder
from softfinger.daemon.port_access import grant, port_group_remedy
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.wire.keys import load_client

_PROC = Path("/proc")


def serial_ports() -> list[tuple[str, str]]:
    """Return (path, description) for each of this machine's serial ports, sorted by path."""
    return sorted((port.device, port.description) for port in list_ports.comports())


def note_ports() -> Finding:
    """Return one finding that lists the existing ports."""
    found = [
        f"{path} ({text})" if text not in ("", "n/a") else path for path, text in serial_ports()
    ]
    return Finding("note", "serial ports", ", ".join(found) or "none found")


def check_runtime_folder() -> Finding:
    """Check that only this user may write to the runtime folder."""
    if fault := runtime_fault():
        return Finding("warn", "runtime folder", fault)
    return Finding("pass", "runtime folder", str(runtime_folder()))


def check_port(path: str, key: str, mode_of_daemon: str = "") -> Finding:
    """Check that a port exists, can be opened, and is not in use by another process.

    The port is closed afterwards. ``key`` is the setting that specifies the port.
    ``mode_of_daemon`` is the mode of the running daemon, or empty if no daemon is running.
    """
    try:
        mode = Path(path).stat()
    except OSError as error:
        dangling = Path(path).is_symlink()
        why = (
            "the link's target does not exist"
            if dangling
            else (error.strerror or "not found").lower()
        )
        fix = f"{port_group_remedy(path)}, or set {key} to an available port"
        return Finding("FAIL", path, why, fix)
    if not stat.S_ISCHR(mode.st_mode):
        return Finding("FAIL", path, "is not a serial port", f"set {key}")
    if not os.access(path, os.R_OK | os.W_OK):
        return Finding("FAIL", path, "no permission to open the port", grant(path))
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        if error.errno == errno.EBUSY:
            return _busy(path, mode_of_daemon)
        return Finding("FAIL", path, f"can't be opened: {error.strerror}", "plug it in again")
    try:
        if not os.isatty(descriptor):
            return Finding("FAIL", path, "is not a serial port", f"set {key}")
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return _busy(path, mode_of_daemon)
    finally:
        os.close(descriptor)
    if users(path):
        return _busy(path, mode_of_daemon)
    return Finding("pass", path, "can be opened and is not in use")


def _busy(path: str, mode_of_daemon: str) -> Finding:
    others = users(path)
    daemons = [pid for pid, _ in others if _is_daemon(pid)]
    if mode_of_daemon and daemons:
        text = (
            f"in use by the softfinger daemon running on this machine ({mode_of_daemon}, process "
        )
        return Finding("warn", path, f"{text}{daemons[0]})", "stop the daemon to check this port")
    names = ", ".join(f"process {pid} ({name})" for pid, name in others) or "another process"
    fix = "kill " + " ".join(str(pid) for pid, _ in others) if others else "end it"
    return Finding("FAIL", path, f"in use by {names}", fix)


def _is_daemon(process: int) -> bool:
    """Return True if the process was started as ``softfinger run``."""
    try:
        words = (_PROC / str(process) / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return False
    return b"run" in words and any(
        w.endswith((b"softfinger", b"softfinger.tools.cli")) for w in words
    )


def users(path: str) -> list[tuple[int, str]]:
    """Return (process ID, process name) for each visible process that has the port open.

    The list excludes the process that owns the other end of a pseudo-terminal.
    """
    try:
        device = Path(path).stat().st_rdev
    except OSError:
        return []
    found = []
    for folder in _PROC.iterdir():
        if not folder.name.isdigit() or int(folder.name) == os.getpid():
            continue
        try:
            uses = _uses(folder, device)
            name = (folder / "comm").read_text().strip()
        except OSError:
            continue
        if uses:
            found.append((int(folder.name), name))
    return sorted(found)


def _uses(folder: Path, device: int) -> bool:
    """Return True if the process has the device open but does not own the pseudo-terminal."""
    opened = False
    for link in (folder / "fd").iterdir():
        try:
            mode = link.stat()
        except OSError:
            continue
        if not stat.S_ISCHR(mode.st_mode):
            continue
        if mode.st_rdev == device:
            opened = True
        elif _pseudo_terminal(folder, link) == os.minor(device):
            return False
    return opened


def _pseudo_terminal(folder: Path, link: Path) -> int:
    """Return the terminal number of a pseudo-terminal master, or -1 for any other descriptor."""
    if not str(link.readlink()).endswith("ptmx"):
        return -1
    match = re.search(r"^tty-index:\s*(\d+)", (folder / "fdinfo" / link.name).read_text(), re.M)
    return int(match[1]) if match else -1


_TIMEOUT = 0.5  # timeout for a daemon's reply [s]


def check_addresses(settings: Settings) -> list[Finding]:
    """Check that all addresses can be bound; report whether a daemon uses an occupied address."""
    return [_check(settings, key, address) for key, address in settings.addresses().items()]


def _check(settings: Settings, key: str, address: str) -> Finding:
    subject, trouble = f"socket {address}", why_not_free(address)
    if not trouble:
        return Finding("pass", subject, "free")
    if trouble != IN_USE:
        return Finding("FAIL", subject, trouble, f"set {key}")
    if mode := daemon_mode(settings.commands.address, settings.access.keys):
        text = (
            f"a softfinger daemon is already running on this machine ({mode}), so a second daemon "
            "will not start"
        )
        return Finding("warn", subject, text, "stop this daemon before you start another")
    text = "in use by another program, which is not a softfinger daemon"
    return Finding("FAIL", subject, text, f"end that program, or set {key} to another address")


def daemon_mode(address: str, keys: str = "") -> str:
    """Return the mode of the daemon at ``address``, or an empty string if there is no reply.

    If the daemon requires keys, ``keys`` is the folder created by `softfinger keys`.
    """
    try:
        own = load_client(Path(keys)) if keys else None
        reply = send(address, {"command": "status"}, _TIMEOUT, own)
    except (NoAnswer, KeyFileError, OSError):
        return ""
    return str(reply.get("mode", "running")) if reply.get("ok") else "starting"


def why_not_free(address: str) -> str:
    """Try to bind ``address``; return the error, or an empty string on success."""
    with zmq.Context() as context, context.socket(zmq.REP) as trial:
        try:
            path = bind(trial, address, 0o600)
        except AddressError as error:
            return str(error).removeprefix(f"{address} ")
    if path:
        Path(path).unlink(missing_ok=True)
    return ""
