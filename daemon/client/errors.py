"""What can go wrong between a program and the hand, apart from a refused command."""

from __future__ import annotations


class NoStream(Exception):
    """Nothing came from the stream's address in time. The message names it."""


class NotInTime(TimeoutError):
    """What was waited for did not come about in time. The message tells the last state."""


class HandFault(Exception):
    """The hand latched a fault while something was waited for. The message is its reason."""
