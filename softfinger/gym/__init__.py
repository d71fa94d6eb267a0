"""Gymnasium's environments of the simulated hand; `environment` has them.

``gymnasium.make("SoftFinger-Grasp-v0")``, ``…-Rotate-v0`` and ``…-Push-v0``: Gymnasium calls
`register` by itself, and the hand is loaded when the first is made.
"""

from __future__ import annotations

TASKS = ("grasp", "rotate", "push")
SECONDS = 4.0  # of an episode
STEP = 0.02  # s


def register() -> None:
    """Tell Gymnasium of the environments."""
    from gymnasium.envs.registration import register

    for task in TASKS:
        register(
            f"SoftFinger-{task.capitalize()}-v0",
            "softfinger.gym.environment:SoftFingerEnv",
            kwargs={"task": task},
            max_episode_steps=round(SECONDS / STEP),
        )
