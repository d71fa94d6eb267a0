"""Gymnasium's environments of the simulated hand; `environment` has them.

Importing this registers them, and the hand is loaded when the first is made:
``gymnasium.make("softfinger.gym:SoftFinger-Grasp-v0")``, ``…-Rotate-v0`` and ``…-Push-v0``.
"""

from __future__ import annotations

from softfinger.tools.extras import require

require("gym")

from gymnasium.envs.registration import register  # noqa: E402 - after what says how to install it

TASKS = ("grasp", "rotate", "push")
SECONDS = 4.0  # of an episode
STEP = 0.02  # s

for _task in TASKS:
    register(
        f"SoftFinger-{_task.capitalize()}-v0",
        "softfinger.gym.environment:SoftFingerEnv",
        kwargs={"task": _task},
        max_episode_steps=round(SECONDS / STEP),
    )
