"""The keys of the monitor's page: their commands, and the line that names them."""

from __future__ import annotations

import math

from rich.segment import Segment
from rich.style import Style

from softfinger.tools.terminal.feed import Feed, field, number, text
from softfinger.tools.terminal.feed_sockets import Commander
from softfinger.tools.terminal.typeset import DIM, Line, length

KEY = Style(bold=True, color="#56b4e9")
STEP_ANGLE = math.radians(5.0)  # of the arrow keys
_STEPS = ((1.0, 0.1), (5.0, 0.5), (math.inf, 1.0))  # N: up to this force, in steps of that
_BETWEEN = 1.0  # s between two presses that add up
_SIMPLE = {
    "a": ("arm", "arm"),
    "r": ("release", "release"),
    "o": ("release", "release"),
    " ": ("stop", "stop"),
    "c": ("clear", "clear"),
    "d": ("disarm", "disarm"),
}
_GRIPPING = ("grasping", "holding", "rotating")


class HandKeys:
    """Turns keys into commands."""

    def __init__(self, feed: Feed, commander: Commander) -> None:
        self._feed = feed
        self._commander = commander
        self._target: float | None = None  # object angle [rad]
        self._chosen = math.nan  # grasp force [N]
        self._pressed = -math.inf  # time of its last change here

    def press(self, key: str, now: float) -> None:
        """Send the key's command; other keys do nothing."""
        if key in ("left", "right"):
            self._rotate(STEP_ANGLE if key == "right" else -STEP_ANGLE, now)
        elif key in "+=":
            self._change_force(1.0, now)
        elif key in "-_":
            self._change_force(-1.0, now)
        elif key == "g":
            self._grasp(now)
        elif key in _SIMPLE:
            label, command = _SIMPLE[key]
            self._target = None
            self._commander.send(now, label, command)

    def force(self, now: float) -> float:
        """Force of the next grasp [N]; in a grip, its requested force; NaN: not known."""
        feed = self._feed
        if not self._gripping or self._adding(now):
            return feed.force_default if math.isnan(self._chosen) else self._chosen
        if not math.isnan(feed.asked):
            return feed.asked
        goal = number(feed.state, "goal_force")  # of a grip older than this page
        return self._chosen if math.isnan(goal) else goal

    @property
    def _gripping(self) -> bool:
        return text(self._feed.state, "mode") in _GRIPPING

    def _adding(self, now: float) -> bool:
        """A key was pressed just now: its force counts before the daemon publishes it."""
        reply = self._commander.reply
        refused = reply is not None and not reply.ok and reply.at >= self._pressed
        return now - self._pressed < _BETWEEN and not refused

    def _change_force(self, way: float, now: float) -> None:
        """Up or down to the next step; a grip follows at once."""
        present = self.force(now)
        if not math.isfinite(present):
            self._commander.refuse(now, "grasp: the hand's settings are not known yet")
            return
        step = next(step for most, step in _STEPS if present + 0.01 * way <= most)
        wanted = round(step * (round(present / step) + way), 3)
        # The daemon checks it.
        self._chosen = min(max(wanted, step), self._feed.force_most)
        self._pressed = now
        if self._gripping:
            self._grasp(now)

    def _grasp(self, now: float) -> None:
        self._target = None
        if math.isnan(self._chosen):
            self._commander.send(now, "grasp", "grasp")
        else:
            label = f"grasp with {self._chosen:.3g} N"
            self._commander.send(now, label, "grasp", force=self._chosen)

    def _rotate(self, step: float, now: float) -> None:
        """Several presses add up: they count from the last target, not from the present angle."""
        state, reply = self._feed.state, self._commander.reply
        refused = reply is not None and not reply.ok
        turning = text(state, "mode") in ("rotating", "holding")
        if self._target is None or refused or not turning:
            known = field(state, "object", "valid") is not False
            angle = number(state, "object", "angle") if known else math.nan
            if not math.isfinite(angle):
                self._target = None
                self._commander.refuse(now, "rotate: the object's angle is not known")
                return
            self._target = angle
        self._target += step
        label = f"rotate to {math.degrees(self._target):.1f}°"
        self._commander.send(now, label, "rotate", angle=self._target)


def key_line(width: int, force: float, fault: bool) -> Line:
    """The keys by name; in a narrow terminal without those that are useless at present."""
    pressed = f"{force:.3g} N" if math.isfinite(force) else "N"
    entries = [
        ("a", "arm"),
        ("g", "grasp"),
        ("+-", pressed),
        ("←→", "turn 5°"),
        ("r", "release"),
        ("space", "stop"),
        ("c", "clear"),
        ("d", "disarm"),
        ("q", "quit"),
    ]
    for spare in ("+-", "←→") if fault else ("c", "d"):
        if length(_named(entries)) - 2 <= width:
            break
        entries = [entry for entry in entries if entry[0] != spare]
    return _named(entries)


def _named(entries: list[tuple[str, str]]) -> Line:
    line = [Segment(" ")]
    for key, what in entries:
        line += [Segment(key, KEY), Segment(f" {what}  ", DIM)]
    return line
