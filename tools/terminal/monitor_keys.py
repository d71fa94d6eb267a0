"""The keys of the monitor's page as commands."""

from __future__ import annotations

import math

from softfinger.tools.terminal.feed import Commander, Feed

STEP_ANGLE = math.radians(5.0)  # of the arrow keys
_STEPS = ((1.0, 0.1), (5.0, 0.5), (math.inf, 1.0))  # N: up to this force, in steps of that
_BETWEEN = 1.0  # s between two presses that add up
_SIMPLE = {"a": "arm", "r": "release", " ": "stop", "c": "clear", "d": "disarm"}
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
        elif key in "+=-_":
            self._change_force(1.0 if key in "+=" else -1.0, now)
        elif key == "g":
            self._grasp(now)
        elif key in _SIMPLE:
            self._target = None
            self._commander.send(now, _SIMPLE[key], _SIMPLE[key])

    def force(self, now: float) -> float:
        """Force of the next grasp [N]; in a grip, its requested force; NaN: not known."""
        feed = self._feed
        if not self._gripping or self._adding(now):
            return feed.force_default if math.isnan(self._chosen) else self._chosen
        # A grip's goal may be older than this page.
        known = (feed.asked, feed.state.goal_force, self._chosen)
        return next((force for force in known if not math.isnan(force)), math.nan)

    @property
    def _gripping(self) -> bool:
        return self._feed.mode in _GRIPPING

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
        reply, pose = self._commander.reply, self._feed.state.object
        refused = reply is not None and not reply.ok
        if self._target is None or refused or self._feed.mode not in ("rotating", "holding"):
            self._target = pose.angle if pose.valid and math.isfinite(pose.angle) else None
            if self._target is None:
                self._commander.refuse(now, "rotate: the object's angle is not known")
                return
        self._target += step
        label = f"rotate to {math.degrees(self._target):.1f}°"
        self._commander.send(now, label, "rotate", angle=self._target)
