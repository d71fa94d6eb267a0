"""Reasons why contact estimates are invalid."""

from __future__ import annotations

from enum import IntEnum

__all__ = ["Invalid"]


class Invalid(IntEnum):
    """Reason why an estimate is invalid, or ``NONE`` if it is valid.

    ``text`` is the message for users. If several reasons apply, a fault in the readings takes
    precedence over problems of the fit.
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
    SECOND_CONTACT = 6, "the tip has two contacts"
    NOT_CONVERGED = 7, "the fit does not converge"
    MODEL_MISMATCH = 8, "the frame does not fit the tip's model"
    OUT_OF_RANGE = 9, "deeper or steeper than the contact model covers"
    UNCERTAIN = 10, "too uncertain: press harder, or calibrate"
    # The following reasons are set by the daemon, which tracks estimates over time.
    NO_FRAME = 11, "no frame yet"
    BAD_FRAME = 12, "the board is disconnected, or its frames repeat"
    STALE = 13, "no valid frame for too long"
    CONTRADICTS_JOINTS = 14, "inconsistent with the joints"
    NOT_IN_SCENE = 15, "not in the scene"
    SERVO_NOT_READ = 16, "servo not read"


REASONS = tuple(Invalid)
