"""Open serial ports, and suggest remedies for ports that cannot be opened."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import serial

_SYSTEM_GROUPS = ("root", "wheel")  # groups that a user should not join merely to open a port


def open_port(path: str, baud: int, key: str, kind: type[Exception]) -> serial.Serial:
    """Open a port exclusively, in raw mode with 8 data bits and no parity. Reads never wait.

    ``key`` is the setting that specifies the port. Raises ``kind`` with the reason and a fix.
    """
    import termios  # missing on Windows, where only simulated devices are supported

    import serial

    try:
        return serial.Serial(path, baud, timeout=0, exclusive=True)
    except (OSError, ValueError, termios.error) as error:
        code = getattr(error, "errno", None)
        if code == errno.ENOENT or not Path(path).exists():
            why = (
                f"port not found: {port_group_remedy(path)}, or set {key}; `softfinger doctor` "
                "lists the available ports"
            )
        elif code in (errno.EACCES, errno.EPERM):
            why = f"no permission to open the port: {grant(path)}"
        elif code in (errno.EAGAIN, errno.EBUSY) or "lock" in str(error).lower():
            why = "the port is in use by another program: end that program first"
        else:
            why = f"can't be opened as a serial port: {error}"
    raise kind(f"{path}: {why}")


def port_group_remedy(path: str) -> str:
    """Suggest how to provide a missing port. A port outside /dev belongs to an emulated hand."""
    return "connect the adapter" if path.startswith("/dev/") else "start `softfinger emulate`"


def serial_group() -> str:
    """Return the group that owns serial ports: ``dialout``, or ``uucp`` if only ``uucp`` exists."""
    import grp  # Some client systems lack `grp`.

    groups = {each.gr_name for each in grp.getgrall()}
    return "uucp" if "uucp" in groups and "dialout" not in groups else "dialout"


def grant(path: str) -> str:
    """Return the command that gives this user access to the port."""
    import grp  # Some client systems lack `grp`.

    try:
        status = Path(path).stat()
        group = grp.getgrgid(status.st_gid)
    except (OSError, KeyError):
        return f"sudo chmod a+rw {path}"
    if group.gr_name in _SYSTEM_GROUPS or not status.st_mode & 0o020:
        return f"sudo chmod a+rw {path} as a temporary fix; for a permanent fix, add a udev rule"
    user = os.environ.get("USER", "")
    if user in group.gr_mem and status.st_gid not in os.getgroups():
        return f"log in again: {user} was added to {group.gr_name} after this login"
    return f"sudo usermod -aG {group.gr_name} $USER, then log in again"
