"""Every exception of this project has one root; here are those that cross from room to room.

An exception that only one room knows stands there, derived from the root. This module imports
neither Numba nor ZeroMQ.
"""

from __future__ import annotations

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


class TactileError(SoftfingerError):
    """The sensor can't be used: port missing, busy, silent, or a grid of another size."""


class RecordingError(SoftfingerError):
    """The recording can't be written or read. The message names the file and what is wrong."""


class Refused(SoftfingerError):
    """A command that is not carried out. The message is the reason in the reply to the client."""


class NoStream(SoftfingerError):
    """Nothing came from the stream's address in time. The message names it."""


class NotInTime(SoftfingerError, TimeoutError):
    """A condition did not come about in time. The message gives the last state."""


class HandClosed(SoftfingerError):
    """A `Hand` or a subscription was used after it had been closed."""


class HandFault(SoftfingerError):
    """The hand latched a fault during a wait. The message is its reason."""
