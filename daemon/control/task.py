"""Run a task, which is a script of commands that the daemon executes after startup.

The daemon checks task commands in the same way as client commands.
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

CLIENT = "task"  # client name in the commands of a task

Step = tuple[dict[str, Any], Mode, float]  # command, final mode and subsequent pause [s]

_STEP_TIMEOUT = 10.0  # s
_RESTART_PAUSE = 2.0  # pause before a restart, so that the user can read the message [s]


class TaskEnded(SoftfingerError):
    """The task can't continue. The message gives the reason."""


class Task:
    """Issue the commands of a script; each command waits until the previous step has ended.

    If ``restarts`` is True, the script restarts after a fault. ``restarts`` is False for real
    hardware, which must not start moving by itself after a fault.
    """

    def __init__(self, settings: Settings) -> None:
        self._script = partial(demo, settings.task.force, settings.task.angle)
        self.restarts = settings.simulated
        self._steps = self._script()
        self._end_mode: str = Mode.DISARMED  # mode that ends the current step
        self._pause = 0.5
        self._remaining = self._pause
        self._waited = 0.0

    @staticmethod
    def named(settings: Settings) -> Task | None:
        """Return the task that the settings select, or None."""
        return None if settings.task.name == "none" else Task(settings)

    def next(self, state: State, dt: float) -> dict[str, Any] | None:
        """Return the command that is due on this tick, with the client name CLIENT, or None.

        Raises
        ------
        TaskEnded
            If the hand has a fault or is disarmed, or if a step times out.
        """
        if state.mode != self._end_mode:
            if state.mode in (Mode.FAULT, Mode.DISARMED):
                raise TaskEnded(f"the mode is {state.mode}")
            self._remaining = self._pause
            self._waited += dt
            if self._waited > _STEP_TIMEOUT:
                raise TaskEnded(f"still {state.mode} after {_STEP_TIMEOUT:g} s")
            return None
        self._remaining -= dt
        if self._remaining > 0.0:
            return None
        request, self._end_mode, self._pause = next(self._steps)
        self._remaining, self._waited = self._pause, 0.0
        return request | {"client": CLIENT}

    def restart(self, state: State, reason: str) -> str:
        """Schedule a pause and a restart of the script; return the event text."""
        way_out, says = (
            ("clear", "clears the fault")
            if state.mode == Mode.FAULT
            else ("stop", "stops the hand")
        )
        self._steps = chain([({"command": way_out}, Mode.DISARMED, 0.5)], self._script())
        self._end_mode = state.mode
        self._remaining, self._waited = _RESTART_PAUSE, 0.0
        pause = f"{_RESTART_PAUSE:g} s"
        return f"{reason}; the simulated hand's task {says} and restarts in {pause}"


def demo(force: float, angle: float) -> Iterator[Step]:
    """Grasp with ``force`` [N], rotate by ±``angle`` [rad], release, and repeat."""
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
