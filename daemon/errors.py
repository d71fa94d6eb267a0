"""Every exception of this project has one root; here are those that cross from room to room.

An exception that only one room knows stands there, derived from the root. This module imports
neither Numba nor ZeroMQ.
"""

from __future__ import annotations

from enum import StrEnum

from softfinger import SoftfingerError as SoftfingerError


class SettingsError(SoftfingerError):
    """The settings can't be used. The message lists every error: file, key, found, expected."""


class PluginError(SoftfingerError):
    """A backend of an installed package can't be used. The message names both and the reason."""


class AddressError(SoftfingerError):
    """A socket can't be bound: the address is in use or can't be had."""


class KeyFileError(SoftfingerError):
    """Keys can't be made or read. The message says which file, and what mends it."""


class NoDescriptor(KeyFileError):
    """Keys can't be read since no more files can be opened, which says nothing of the keys."""


class ServoError(SoftfingerError):
    """The servos can't be used: port missing or busy, a servo absent or set up wrongly.

    The message lists everything that was found wrong, one line each, with what mends it.
    """


class ServosSilent(ServoError):
    """Servos did not answer, and nothing else was found wrong: they may still be starting."""


class TactileError(SoftfingerError):
    """The sensor can't be used: port missing, busy, silent, or a grid of another size."""


class RecordingError(SoftfingerError):
    """The recording can't be written or read. The message names the file and what is wrong."""


class Reason(StrEnum):
    """Why a command was not carried out, for programs: ``reason`` in the reply."""

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
        """Describe the reason in a sentence, for the documentation."""
        return _MEANINGS[self]


_MEANINGS = {
    Reason.LATE: "The command was too old when its turn came, or a servo's reply was late. "
    "It has no effect. Send it again if you still want it.",
    Reason.STOPPED: "The command was sent before the last `stop`, or too soon after it to tell. "
    "Do not repeat it automatically.",
    Reason.SUPERSEDED: "A newer `hold` of the same connection replaced this one, or another "
    "command was carried out before this one was repeated.",
    Reason.BUSY: "Too many commands are waiting, or this client sends too many. Send fewer.",
    Reason.LEASE: "Another client commands the hand (`commands.lease`).",
    Reason.MODE: "The hand does not accept this command in its present mode.",
    Reason.BOUNDS: "A number is outside the range that the hand accepts.",
    Reason.SCENE: "The profile lacks something that the command needs: a sensor, servos, a task.",
    Reason.STATE: "The present state prevents the command: a broken limit, a touched tip, a tare "
    "in progress, servos that cannot be reached.",
    Reason.REQUEST: "The request is malformed: unknown command, or a missing or unknown parameter.",
}


class Refused(SoftfingerError):
    """A command that was not carried out. The message goes into the reply to the client."""

    def __init__(self, text: str, reason: Reason | str = Reason.STATE) -> None:
        """``reason`` is one of `Reason`, or what a daemon of another version sent."""
        super().__init__(text)
        self.reason = reason


class NoStream(SoftfingerError):
    """Nothing came from the stream's address in time. The message names it."""


class NotInTime(SoftfingerError, TimeoutError):
    """A condition did not come about in time. The message gives the last state."""


class HandClosed(SoftfingerError):
    """A `Hand` or a subscription was used after it had been closed."""


class HandFault(SoftfingerError):
    """The hand latched a fault during a wait. The message is its reason."""
