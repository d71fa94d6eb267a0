"""Run a daemon in virtual time and record the simulated hand's true state.

``envelope``, ``bench`` and the tests use this module.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.load import checked
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Event

__all__ = ["SimulatedDaemon"]


@dataclass(frozen=True)
class TrueStates:
    """True state of the simulated hand at each tick."""

    t: NDArray[np.float64]  # s
    force: NDArray[np.float64]  # force per tip [n, 2] [N]
    angle: NDArray[np.float64]  # rad
    slip: NDArray[np.float64]  # maximum of |T|/μN over both tips


def _in_virtual_time(sections: dict[str, dict[str, Any]]) -> Settings:
    return checked(sections | {"loop": sections.get("loop", {}) | {"clock": "virtual"}})


class SimulatedDaemon:
    """Daemon in virtual time with an observable simulated hand. Raises SettingsError."""

    def __init__(
        self,
        sections: dict[str, dict[str, Any]],
        hand: dict[str, dict[str, Any]] | None = None,
    ) -> None:
        """Build the daemon; the settings in ``hand`` default to the daemon's ``sections``."""
        settings = _in_virtual_time(sections)
        self.events: list[Event] = []
        real = None if hand is None else _in_virtual_time(hand)
        self._daemon = Daemon(settings, wire=False, on_event=self._note, hand=real)
        self.loop, self.state = self._daemon.loop, self._daemon.loop.state
        self.control = self.loop._control
        assert self._daemon.hand is not None
        self.plant = self._daemon.hand
        self.estimator = self.loop.perception.filter
        self.contacts = self.state.contacts
        self.settings = settings

    def _note(self, level: str, kind: str, text: str) -> None:
        self.events.append((level, kind, text))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._daemon.close()

    @property
    def now(self) -> float:
        """Current virtual time [s]."""
        return self._daemon.clock.now()

    @property
    def mode(self) -> str:
        return self.state.mode

    def command(self, name: str, **numbers: float) -> dict[str, Any]:
        return self.loop.command({"command": name, **numbers})

    def grasp(self, force: float) -> None:
        """Arm the hand and start grasping."""
        self.loop.advance(0.3)
        self.command("arm")
        self.loop.advance(0.2)
        self.command("grasp", force=force)

    def run(self, seconds: float) -> None:
        """Advance by ``seconds`` without recording."""
        self.loop.advance(seconds)

    def watch(self, seconds: float) -> TrueStates:
        """Advance by ``seconds`` and return the true state at each tick."""
        return TrueStates(*(np.array(column) for column in zip(*self._ticks(seconds), strict=True)))

    def _ticks(self, seconds: float) -> Iterator[tuple[float, tuple[float, ...], float, float]]:
        loop, plant = self.loop, self.plant
        for _ in range(max(round(seconds / loop.period), 1)):
            loop.advance(loop.period)
            normal = self.settings.simulation.tip_friction * np.maximum(plant.normal, 1e-9)
            used = np.where(plant.normal > 0.1, np.abs(plant.tangential) / normal, 0.0)
            yield self.now, tuple(plant.force), float(plant.object_pose[2]), float(used.max())
