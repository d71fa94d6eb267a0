"""Returns of a random agent and of the built-in law in each task.

``python -m softfinger.gym [EPISODES [PROFILE]]``
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from softfinger.gym import SECONDS, STEP, TASKS
from softfinger.gym.environment import ANGLE, FORCE, FORCES, Observation

Policy = Callable[[Observation], NDArray[np.float32]]


def main(episodes: int = 20, profile: str = "sim") -> None:
    """Print a line for each task and agent; the seeds are 0 to ``episodes`` - 1."""
    print(f"{'task':8}{'agent':8}return of {SECONDS / STEP:.0f} steps      x real time")
    for task in TASKS:
        name = f"SoftFinger-{task.capitalize()}-v0"
        for agent, control in (("random", "joints"), ("law", "law")):
            env = gymnasium.make(name, control=control, profile=profile)
            policy = by_law if agent == "law" else at_random(env)
            began = time.perf_counter()
            returns = [episode(env, policy, seed) for seed in range(episodes)]
            speed = SECONDS * episodes / (time.perf_counter() - began)
            env.close()
            told = f"{np.mean(returns):6.1f} ± {np.std(returns):<12.1f}{speed:6.0f}"
            print(f"{task:8}{agent:8}{told}")


def episode(env: gymnasium.Env[Any, Any], policy: Policy, seed: int) -> float:
    """One episode's return."""
    observation, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    total, over = 0.0, False
    while not over:
        observation, reward, ended, truncated, _ = env.step(policy(observation))
        total += float(reward)
        over = ended or truncated
    return total


def at_random(env: gymnasium.Env[Any, Any]) -> Policy:
    """Any action."""
    return lambda _: env.action_space.sample()


def by_law(observation: Observation) -> NDArray[np.float32]:
    """The built-in law's setpoints: the wanted force, and in ``rotate`` the goal."""
    least, most = FORCES
    goal = float(observation["goal"][0])
    angle = goal / ANGLE if abs(goal) < ANGLE else 0.0  # a goal in N is no angle
    return np.array([2.0 * (FORCE - least) / (most - least) - 1.0, angle], np.float32)


if __name__ == "__main__":
    main(*(convert(word) for convert, word in zip((int, str), sys.argv[1:], strict=False)))
