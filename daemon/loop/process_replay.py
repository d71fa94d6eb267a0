"""Run the installed code, tick by tick, on a recording's readings, frames and commands.

The servos, sensors, clock and commands are replayed from the recording. The estimator, tables,
filter, control and limits come from the installed code. The states are reproduced bit for bit if
the code and the settings are unchanged. The recording must also contain all inputs since the first
tick.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.control.task import CLIENT
from softfinger.daemon.errors import Refused, ServoError
from softfinger.daemon.loop.loop import Loop
from softfinger.daemon.perception.finger_model import FingerModel
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.profile.settings import Settings, TaskSettings
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import FINGERS, Frame, Goal, Reading, State
from softfinger.daemon.wire.loop_link import Link


class ProcessReplay:
    """Loop that runs on recorded inputs."""

    def __init__(self, settings: Settings, models: tuple[FingerModel, FingerModel]) -> None:
        """Build the loop from the settings of a recording and the models of its fingers."""
        # Disable the task, because the recording contains the task's commands.
        settings = settings.model_copy(update={"task": TaskSettings()})
        self._clock = _Clock()
        self._commands = _Commands()
        self._servos = _Servos() if settings.servos.backend != "none" else None
        sensing = [] if settings.tactile.backend == "none" else settings.scene.indices
        self._sensors = {finger: GivenFrames() for finger in sensing}
        self._loop = Loop(
            settings,
            self._clock,
            self._servos,
            Perception(settings, self._sensors, models),
            None,
            self._commands,
        )

    @property
    def fingers(self) -> tuple[int, ...]:
        """Fingers for which the caller must supply frames."""
        return tuple(self._sensors)

    def tick(
        self,
        taken: Mapping[str, Any],
        frames: Mapping[int, Frame],
        commands: Sequence[dict[str, Any]],
    ) -> State:
        """Run one tick and return the loop's own state object, which the next call modifies.

        Parameters
        ----------
        taken : ``hand/input`` message of the tick
        frames : new frames by finger index
        commands : commands that were executed on the tick
        """
        loop = self._loop
        self._clock.sleep_until(taken["t"])
        self._clock.unix = taken["timestamp"]
        for finger, frame in frames.items():
            self._sensors[finger].frame = frame
        if self._servos is not None:
            self._servos.taken = taken
        self._commands.waiting = commands
        loop.state.seq = taken["seq"] - 1
        loop.state.timing.late_in_row = taken["late_in_row"]
        loop.state.timing.busy_s = taken["busy_s"]
        loop.tick(taken["t"])
        return loop.state


class _Clock(VirtualClock):
    """Clock that returns recorded times."""

    unix = 0.0

    def wall(self) -> float:
        """Return the recorded Unix time [s]."""
        return self.unix


class _Servos:
    """Servos that replay recorded readings and failures, and discard all writes."""

    def __init__(self) -> None:
        self.taken: Mapping[str, Any] = {}

    def connect(self) -> None:
        pass

    def read(self, reading: Reading) -> None:
        taken = self.taken
        said = taken["reading"]
        reading.seq = said["seq"]
        reading.t = said["t"] if said["t"] is not None else -math.inf
        reading.valid = said["valid"]
        reading.alert = said["alert"]
        reading.lost = said.get("lost", 0)
        reading.frozen = said.get("frozen", 0)
        for finger, name in enumerate(FINGERS):
            for field in ("q", "dq", "current", "hardware", "temperature", "voltage"):
                getattr(reading, field)[finger] = taken[name][field]
        if said["error"]:
            raise ServoError(said["error"])

    def torque_on(self) -> None:
        self._fail_as_recorded()

    def torque_off(self, reading: Reading) -> bool:
        self.read(reading)
        confirmed: bool = self.taken.get("torque_off", not self.taken["write_error"])
        return confirmed

    def write(self, goal: Goal) -> None:
        self._fail_as_recorded()

    def _fail_as_recorded(self) -> None:
        if self.taken["write_error"]:
            raise ServoError(self.taken["write_error"])

    def counters(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        pass


class _Commands:
    """Command source that replays the recorded commands of a tick."""

    def __init__(self) -> None:
        self.waiting: Sequence[dict[str, Any]] = ()
        self.link = Link()

    def serve(self, handler: Callable[..., Any]) -> None:
        for request in self.waiting:
            try:
                handler(request, 0.0, request.get("client") == CLIENT)
            except Refused:
                pass  # After a refusal, the replayed states differ from the recording.
