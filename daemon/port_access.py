"""Why a serial port can't be opened, and how to get it: shared by servos, boards and `doctor`."""

from __future__ import annotations

import os
from pathlib import Path

_NO_USERS = ("root", "wheel")  # groups that nobody should join for the sake of a port


def bring_it(path: str) -> str:
    """Return advice for a port that does not exist: outside /dev it is an emulated hand's."""
    return "plug the adapter in" if path.startswith("/dev/") else "start `softfinger emulate`"


def grant(path: str) -> str:
    """Return the command that gives this user a port: membership of the port's own group."""
    import grp  # not on every system that runs a client

    try:
        status = Path(path).stat()
        group = grp.getgrgid(status.st_gid)
    except (OSError, KeyError):
        return f"sudo chmod a+rw {path}"
    if group.gr_name in _NO_USERS or not status.st_mode & 0o020:
        return f"sudo chmod a+rw {path}, until it is plugged in again; for good, a udev rule"
    user = os.environ.get("USER", "")
    if user in group.gr_mem and status.st_gid not in os.getgroups():
        return f"log in again: {user} is in {group.gr_name}, this session is not yet"
    return f"sudo usermod -aG {group.gr_name} $USER, then log in again"
