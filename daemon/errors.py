"""Define the exceptions that several packages use.

All exceptions are derived from `SoftfingerError`. An exception used by a single package is defined
in that package and has the same base class. This module does not import Numba or ZeroMQ.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from enum import StrEnum

from softfinger import SoftfingerError as SoftfingerError

_SIMILAR = 0.75  # minimum similarity of a suggested word; allows about one wrong letter in four


def nearest(word: str, known: Iterable[str]) -> str:
    """Return a hint that suggests the most similar known word, or "" if no word is similar."""
    found = difflib.get_close_matches(word[:80], list(known), n=1, cutoff=_SIMILAR)
    return f"; nearest: {found[0]}" if found else ""


class SettingsError(SoftfingerError):
    """Unusable settings.

    For each error, the message states the file, the key, the found value and the expected value.
    """


class PluginError(SoftfingerError):
    """Unusable plugin. The message names the backend, its package and the reason."""


class AddressError(SoftfingerError):
    """Failure to bind a socket, because its address is in use or not available."""


class KeyFileError(SoftfingerError):
    """Failure to create or read keys. The message names the file and the remedy."""


class ServoError(SoftfingerError):
    """Unusable servos: the port is missing or busy, or a servo is absent or misconfigured.

    The message lists each problem with its remedy on a separate line.
    """


class ServosSilent(ServoError):
    """Some servos have not replied, and there is no other problem.

    The servos may still be starting.
    """


class TactileError(SoftfingerError):
    """Unusable tactile sensor: the port is missing, busy or silent, or the grid size is wrong."""


class RecordingError(SoftfingerError):
    """Failure to write or read a recording. The message names the file and the problem."""


class Reason(StrEnum):
    """Machine-readable reason for a refusal, sent in the ``reason`` field of the reply."""

    LATE = "late"
    STOPPED = "stopped"
    SUPERSEDED = "superseded"
    BUSY = "busy"
    LEASE = "lease"
    MODE = "mode"
    BOUNDS = "bounds"
    SCENE = "scene"
    STATE = "state"
    REQUEST = "request"

    @property
    def meaning(self) -> str:
        """Explanation of the reason, shown in the documentation."""
        return _MEANINGS[self]


_MEANINGS = {
    Reason.LATE: (
        "The command was too old when it was processed, or a servo's reply was late. The "
        "command had no effect. Send it again if it is still needed."
    ),
    Reason.STOPPED: (
        "The command was received before the last `stop`, or too soon after it. Programs must "
        "not repeat it automatically."
    ),
    Reason.SUPERSEDED: "A newer `hold` from the same connection replaced this `hold`, or another "
    "command was carried out before this command was repeated.",
    Reason.BUSY: (
        "Too many commands are waiting, or this client exceeds the command rate. Send fewer "
        "commands."
    ),
    Reason.LEASE: "Another client has the lease (`commands.lease`).",
    Reason.MODE: "The hand does not accept this command in its current mode.",
    Reason.BOUNDS: "A number is out of range.",
    Reason.SCENE: "The command requires a sensor, servos or a task that the profile lacks.",
    Reason.STATE: (
        "The current state prevents the command: a limit is exceeded, a tip is in contact, a "
        "tare is in progress, or the servos do not reply."
    ),
    Reason.REQUEST: "The request is malformed: unknown command, or a missing or unknown parameter.",
}


class Refused(SoftfingerError):
    """Rejected command. The reply to the client contains this exception's message."""

    def __init__(self, text: str, reason: Reason | str = Reason.STATE) -> None:
        """``reason`` is a `Reason`, or another string if the client and daemon versions differ."""
        super().__init__(text)
        self.reason = reason


class NoStream(SoftfingerError):
    """A wait for a stream message timed out. The error text names the address."""


class NotInTime(SoftfingerError, TimeoutError):
    """A wait for a condition timed out. The error text contains the last state."""


class HandClosed(SoftfingerError):
    """Use of a `Hand` or a subscription after it was closed."""


class WrongThread(SoftfingerError):
    """Use of a `Hand`'s stream in a second thread. The message names both threads."""


class HandFault(SoftfingerError):
    """The hand latched a fault while a client was waiting. The error text describes the fault."""
