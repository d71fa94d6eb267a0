"""What the daemon does by itself after start: a script of commands, each waiting for its mode.

A task speaks through the same commands as a client; it can do nothing that a client can't.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from typing import Any

from daemon.modes import Mode
from daemon.records import State
from daemon.settings import Task as TaskSettings

Step = tuple[dict[str, Any], Mode, float]  # command, mode that ends the step, rest after it [s]

_PATIENCE = 10.0  # s for a step


class TaskOver(Exception):
    """The task can't go on. The message says why."""


class Task:
    """Issues one command after another, each when the hand has come to where the last one led."""

    def __init__(self, steps: Iterator[Step]) -> None:
        self._steps = steps
        self._mode = Mode.DISARMED  # what the present step waits for
        self._rest = 0.5
        self._left = self._rest
        self._waited = 0.0

    @staticmethod
    def named(settings: TaskSettings) -> Task | None:
        """The settings' task, or None."""
        return Task(demo(settings.force, settings.angle)) if settings.name == "demo" else None

    def next(self, state: State, dt: float) -> dict[str, Any] | None:
        """The command that is due at this tick, if any.

        Raises TaskOver after a fault, when the hand was disarmed, or when a step did not come to
        its end: then a person is at work, and the hand must not start by itself again.
        """
        if state.mode != self._mode:
            if state.mode in (Mode.FAULT, Mode.DISARMED):
                raise TaskOver(f"the hand is in {state.mode}")
            self._left = self._rest
            self._waited += dt
            if self._waited > _PATIENCE:
                raise TaskOver(f"still {state.mode} after {_PATIENCE:g} s")
            return None
        self._left -= dt
        if self._left > 0.0:
            return None
        request, self._mode, self._rest = next(self._steps)
        self._left, self._waited = self._rest, 0.0
        return request


def demo(force: float, angle: float) -> Iterator[Step]:
    """Grasp, turn to both sides, and release, for ever. ``force`` [N], ``angle`` [rad]."""
    yield {"command": "arm"}, Mode.ARMED, 0.5
    yield from cycle(
        [
            ({"command": "grasp", "force": force}, Mode.HOLDING, 1.0),
            ({"command": "rotate", "angle": angle}, Mode.HOLDING, 0.8),
            ({"command": "rotate", "angle": -angle}, Mode.HOLDING, 0.8),
            ({"command": "rotate", "angle": 0.0}, Mode.HOLDING, 0.8),
            ({"command": "release"}, Mode.ARMED, 1.0),
        ]
    )
