"""Reasons why contact estimates are invalid."""

from __future__ import annotations

from enum import IntEnum

__all__ = ["Invalid"]


class Invalid(IntEnum):
    """Reason why an estimate is invalid, or ``NONE`` if it is valid.

    ``text`` is the message for users. A fault in the readings takes precedence over a problem of
    the fit.
    """

    text: str

    def __new__(cls, value: int, text: str) -> Invalid:
        member = int.__new__(cls, value)
        member._value_ = value
        member.text = text
        return member

    NONE = 0, ""
    NOT_FINITE = 1, "readings are not finite"
    BELOW_ZERO = 2, "the cells read below zero: tare the sensor"
    ABOVE_ZERO = 3, "all cells read above zero: tare the sensor"
    OUTLIERS = 4, "too many outliers"
    SATURATED = 5, "saturated"
    SECOND_CONTACT = 6, "the frame shows two contacts on the tip"
    NOT_CONVERGED = 7, "the fit did not converge"
    MODEL_MISMATCH = 8, "the frame does not match the tip's contact model"
    OUT_OF_RANGE = 9, "depth or tilt is outside the range of the contact model"
    UNCERTAIN = 10, "the estimate is too uncertain: use more force, or calibrate the sensor"
    # Only the daemon sets the following reasons, because only the daemon tracks sensors over time.
    NO_FRAME = 11, "no frame has arrived yet"
    BAD_FRAME = 12, "the board is disconnected, or its frames repeat"
    STALE = 13, "no valid frame has arrived for too long"
    CONTRADICTS_JOINTS = 14, "the frames are inconsistent with the joints"
    NOT_IN_SCENE = 15, "the finger is not in the scene"
    SERVO_NOT_READ = 16, "the servo could not be read"


REASONS = tuple(Invalid)
