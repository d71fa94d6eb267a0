"""Serial ports: which there are, whether they may be opened, who has them, how fast they answer."""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import re
import stat
from pathlib import Path

from serial.tools import list_ports

from softfinger.daemon.diagnosis.result import Result, Status
from softfinger.daemon.servos.port import latency_file

_PROC = Path("/proc")


def serial_ports() -> list[tuple[str, str]]:
    """(path, what it is) of every serial port of this machine, by path."""
    return sorted((port.device, port.description) for port in list_ports.comports())


def note_ports() -> Result:
    """The ports there are, in one line."""
    found = [
        f"{path} ({text})" if text not in ("", "n/a") else path for path, text in serial_ports()
    ]
    return Result("note", "serial ports", ", ".join(found) or "none on this machine")


def check_port(path: str, key: str, mode_of_daemon: str = "") -> Result:
    """Whether a port is there, may be opened, and nobody else has it; it is not kept open.

    ``key`` is the setting that names it, ``mode_of_daemon`` that of the daemon which answers
    commands here, if one does: it may have the port and shall keep it.
    """
    try:
        mode = Path(path).stat()
    except OSError as error:
        dangling = Path(path).is_symlink()
        why = "leads nowhere" if dangling else (error.strerror or "not found").lower()
        fix = f"plug the adapter in, or set {key} to one of the ports there are"
        return Result("FAIL", path, why, fix)
    if not stat.S_ISCHR(mode.st_mode):
        return Result("FAIL", path, "is not a serial port", f"set {key}")
    if not os.access(path, os.R_OK | os.W_OK):
        return Result("FAIL", path, "no permission to open it", _permission(path, mode))
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        if error.errno == errno.EBUSY:
            return _busy(path, mode_of_daemon)
        return Result("FAIL", path, f"can't be opened: {error.strerror}", "plug it in again")
    try:
        if not os.isatty(descriptor):
            return Result("FAIL", path, "is not a serial port", f"set {key}")
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return _busy(path, mode_of_daemon)
    finally:
        os.close(descriptor)
    others = users(path)
    if others:
        return _busy(path, mode_of_daemon)
    return Result("pass", path, "there, may be opened, nobody else has it")


def _permission(path: str, mode: os.stat_result) -> str:
    try:
        group = grp.getgrgid(mode.st_gid)
    except KeyError:
        return f"sudo chmod a+rw {path}"
    user = os.environ.get("USER", "")
    if user in group.gr_mem and mode.st_gid not in os.getgroups():
        return f"log in again: {user} is in {group.gr_name}, this session is not yet"
    return f"sudo usermod -aG {group.gr_name} $USER, then log in again"


def _busy(path: str, mode_of_daemon: str) -> Result:
    others = users(path)
    daemons = [pid for pid, _ in others if _is_daemon(pid)]
    if mode_of_daemon and daemons:
        text = f"the softfinger daemon that runs here has it ({mode_of_daemon}, process "
        return Result("warn", path, f"{text}{daemons[0]})", "end that one to have its port checked")
    names = ", ".join(f"process {pid} ({name})" for pid, name in others) or "another process"
    fix = "kill " + " ".join(str(pid) for pid, _ in others) if others else "end that one"
    return Result("FAIL", path, f"in use by {names}", fix)


def _is_daemon(process: int) -> bool:
    """Whether it was started as ``softfinger run``."""
    try:
        words = (_PROC / str(process) / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return False
    return b"run" in words and any(
        w.endswith((b"softfinger", b"softfinger.tools.cli")) for w in words
    )


def users(path: str) -> list[tuple[int, str]]:
    """(process, its name) of all that have the port open, as far as this user may see.

    Who holds the other end of a pseudo-terminal is no user of it.
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
    """Whether the process has the device open, and does not own it as a pseudo-terminal."""
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
    """The number of the pseudo-terminal whose master this descriptor is, -1 for another thing."""
    if not str(link.readlink()).endswith("ptmx"):
        return -1
    match = re.search(r"^tty-index:\s*(\d+)", (folder / "fdinfo" / link.name).read_text(), re.M)
    return int(match[1]) if match else -1


# --- latency timer ---------------------------------------------------------------------------


def check_latency_timer(path: str, reply_timeout: float, *sysfs: Path) -> Result | None:
    """Judge a USB adapter's latency timer against the time [s] a reply may take; None without one.

    A reply waits in the adapter until the timer is over, so 16 ms hold a read to 60 Hz.
    """
    place = latency_file(path, *sysfs)
    if place is None:
        return None
    subject = f"{path} latency timer"
    try:
        latency = int(place.read_text())
    except (OSError, ValueError) as error:
        return Result("warn", subject, f"can't be read: {error}")
    if latency <= 1:
        return Result("pass", subject, f"{latency} ms")
    status: Status = "FAIL" if latency * 1e-3 >= reply_timeout else "warn"
    fix = f"softfinger doctor --fix, or: echo 1 | sudo tee {place}"
    return Result(status, subject, f"{latency} ms, so every read takes that long", fix)
