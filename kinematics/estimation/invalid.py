"""Reasons for which an estimate is not valid, from the cells' readings to the daemon's frames."""

from __future__ import annotations

from enum import IntEnum


class Invalid(IntEnum):
    """Why an estimate is not valid; ``NONE`` for one that is. Its ``text`` is what people read.

    The first that applies, a cause in the readings before what the fit makes of it.
    """

    text: str

    def __new__(cls, value: int, text: str) -> Invalid:
        member = int.__new__(cls, value)
        member._value_ = value
        member.text = text
        return member

    NONE = 0, ""
    NOT_FINITE = 1, "readings are not finite"
    BELOW_ZERO = 2, "cells read below zero: tare"
    ABOVE_ZERO = 3, "all cells read above zero: tare"
    OUTLIERS = 4, "too many outliers"
    SATURATED = 5, "saturated"
    SECOND = 6, "two contacts"
    UNSETTLED = 7, "the fit does not settle"
    MODEL = 8, "not this tip"
    BEYOND = 9, "deeper or steeper than the model holds"
    UNCERTAIN = 10, "too uncertain: press more, or calibrate"
    # Of the daemon, which carries estimates on from frame to frame.
    NO_FRAME = 11, "no frame yet"
    FRAME = 12, "the board is gone, or its frames repeat"
    STALE = 13, "no valid frame for too long"
    JOINTS = 14, "contradicts the joints"
    ABSENT = 15, "not in the scene"
    SERVO = 16, "servo not read"


REASONS = tuple(Invalid)
