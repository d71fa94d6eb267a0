"""Tasks: scripts of commands that the daemon gives itself after start.

They are a client's commands; a task can do nothing that a client can't.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import chain, cycle
from typing import Any

from softfinger.daemon.control.modes import Mode
from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import State

Step = tuple[dict[str, Any], Mode, float]  # command, mode that ends the step, rest after it [s]

_PATIENCE = 10.0  # s for a step
_PAUSE = 2.0  # s in which a person can read what went wrong


class TaskOver(SoftfingerError):
    """The task can't go on. The message says why."""


class Task:
    """Gives one command after another, each when the hand is in the mode that the last one led to.

    ``lasting``: it begins again after a fault. That is for simulated hands alone: metal must not
    start by itself when something was wrong.
    """

    def __init__(self, settings: Settings) -> None:
        self._script = partial(demo, settings.task.force, settings.task.angle)
        self.lasting = settings.simulated
        self._steps = self._script()
        self._mode: str = Mode.DISARMED  # what the present step waits for
        self._rest = 0.5
        self._left = self._rest
        self._waited = 0.0

    @staticmethod
    def named(settings: Settings) -> Task | None:
        """Return the settings' task, or None."""
        return None if settings.task.name == "none" else Task(settings)

    def next(self, state: State, dt: float) -> dict[str, Any] | None:
        """Return the command that is due at this tick, if any.

        Raises TaskOver after a fault, when the hand was disarmed, or when a step did not come to
        its end.
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

    def begin_again(self, state: State, reason: str) -> str:
        """Pause, leave the present mode, and begin the script again; the text of the event."""
        way_out, says = ("clear", "clears it") if state.mode == Mode.FAULT else ("stop", "stops it")
        self._steps = chain([({"command": way_out}, Mode.DISARMED, 0.5)], self._script())
        self._mode = state.mode
        self._left, self._waited = _PAUSE, 0.0
        return f"{reason}; the task {says} and begins again in {_PAUSE:g} s: the hand is simulated"


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
