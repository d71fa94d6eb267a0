"""Provide the simulated hand to LeRobot, with the same observations and actions as the robot."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from lerobot_robot_softfinger.features import IMAGES, STATE, image, observation
from softfinger.gym.environment import ANGLE, FORCES, REACH, SoftFingerEnv

_DESCRIPTIONS = {
    "grasp": "grasp the object with 6 N",
    "rotate": "turn the held object to the goal",
    "push": "hold the object against a push",
}


class LeRobotHand(gymnasium.Wrapper):
    """`SoftFingerEnv` with the robot's observations and actions.

    Actions outside the environment's range are clipped. Joint goals change by at most 0.02 rad per
    step.
    """

    def __init__(self, task: str, control: str, **options: Any) -> None:
        self._hand = SoftFingerEnv(task, control, **options)
        super().__init__(self._hand)
        self.task, self.task_description = task, _DESCRIPTIONS[task]
        self._by_law = control == "law"
        rows, cols = self._hand.observation_space["pressure"].shape[1:]
        picture = spaces.Box(0, 255, (rows, cols, 3), np.uint8)
        self.observation_space = spaces.Dict(
            {
                "agent_pos": spaces.Box(-np.inf, np.inf, (len(STATE),), np.float32),
                "environment_state": spaces.Box(-np.inf, np.inf, (1,), np.float32),
                "pixels": spaces.Dict(dict.fromkeys(IMAGES.values(), picture)),
            }
        )
        low, high = (FORCES[0], -ANGLE), (FORCES[1], ANGLE)
        if not self._by_law:
            low, high = (-np.pi, -np.pi), (np.pi, np.pi)
        self.action_space = spaces.Box(np.float32(low), np.float32(high))

    def reset(self, **options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        found, info = self._hand.reset(**options)
        return self._seen(found), info

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        wanted = np.asarray(action, np.float64)
        if self._by_law:
            least, most = FORCES
            middle, reach = (0.5 * (least + most), 0.0), (0.5 * (most - least), ANGLE)
        else:
            middle, reach = tuple(self._hand.goals), (REACH, REACH)
        found, *others = self._hand.step((wanted - middle) / reach)
        return self._seen(found), *others

    def _seen(self, found: dict[str, Any]) -> dict[str, Any]:
        state = self._hand.state()
        frames = {
            name: SimpleNamespace(mono_ns=state.mono_ns - 1e9 * getattr(state, name).frame_age_s)
            for name in IMAGES
        }
        images = map(image, found["pressure"] * self._hand.pascal_per_count)
        values = observation(state, frames)
        return {
            "agent_pos": np.array([values[name] for name in STATE], np.float32),
            "environment_state": found["goal"],
            "pixels": dict(zip(IMAGES.values(), images, strict=True)),
        }
