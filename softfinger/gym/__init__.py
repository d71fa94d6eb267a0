"""Gymnasium environments for the simulated hand.

Importing this package registers ``SoftFinger-Grasp-v0``, ``SoftFinger-Rotate-v0`` and
``SoftFinger-Push-v0``. The simulated hand is loaded when an environment is created, for example
with ``gymnasium.make("softfinger.gym:SoftFinger-Grasp-v0")``.
"""

from __future__ import annotations

from softfinger.tools.extras import require

require("gym")

from gymnasium.envs.registration import register  # noqa: E402 - require() explains a missing install

__all__ = ["SECONDS", "STEP", "TASKS"]

TASKS = ("grasp", "rotate", "push")
SECONDS = 4.0  # maximum episode duration [s]
STEP = 0.02  # simulated time per step [s]

for _task in TASKS:
    register(
        f"SoftFinger-{_task.capitalize()}-v0",
        "softfinger.gym.environment:SoftFingerEnv",
        kwargs={"task": _task},
        max_episode_steps=round(SECONDS / STEP),
    )
