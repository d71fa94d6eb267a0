"""Measure the returns of a random agent and of the built-in grip control law in each task.

Usage: ``python -m softfinger.gym [EPISODES [PROFILE]]``. Episodes run in parallel on the workers
selected by ``--processes`` or ``--scheduler``.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from softfinger.gym import SECONDS, STEP, TASKS
from softfinger.gym.environment import ANGLE, FORCE, FORCES, Observation
from softfinger.tools.sweep import Sweep, add_sweep

AGENTS = {"random": "joints", "law": "law"}  # maps each agent to its ``control`` argument
Policy = Callable[[Observation], NDArray[np.float32]]


def main(
    episodes: int, profile: str, processes: int | None = None, scheduler: str | None = None
) -> None:
    """Print the mean return for each task and agent over the seeds 0 to ``episodes`` - 1."""
    print(f"{'task':8}{'agent':8}return of {SECONDS / STEP:.0f} steps      x real time")
    rows = list(itertools.product(TASKS, AGENTS))
    cases = [(task, agent, seed) for task, agent in rows for seed in range(episodes)]
    found = Sweep("gym", partial(_tried, profile), cases).run(processes, scheduler)
    for task, agent in rows:
        returns, spent = np.array([next(found) for _ in range(episodes)]).T
        speed = SECONDS * episodes / spent.sum()
        told = f"{np.mean(returns):6.1f} ± {np.std(returns):<12.1f}{speed:6.0f}"
        print(f"{task:8}{agent:8}{told}")


def _tried(profile: str, case: tuple[str, str, int]) -> tuple[float, float]:
    """Run one episode; return the sum of its rewards and its run time [s]."""
    task, agent, seed = case
    name = f"SoftFinger-{task.capitalize()}-v0"
    with closing(gymnasium.make(name, control=AGENTS[agent], profile=profile)) as env:
        began = time.perf_counter()
        found = episode(env, by_law if agent == "law" else at_random(env), seed)
        return found, time.perf_counter() - began


def episode(env: gymnasium.Env[Any, Any], policy: Policy, seed: int) -> float:
    """Run one episode and return the sum of its rewards."""
    observation, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    total, over = 0.0, False
    while not over:
        observation, reward, ended, truncated, _ = env.step(policy(observation))
        total += float(reward)
        over = ended or truncated
    return total


def at_random(env: gymnasium.Env[Any, Any]) -> Policy:
    """Return a policy that chooses actions uniformly at random."""
    return lambda _: env.action_space.sample()


def by_law(observation: Observation) -> NDArray[np.float32]:
    """Return an action that commands the target force and, for ``rotate``, the goal angle."""
    least, most = FORCES
    goal = float(observation["goal"][0])
    angle = goal / ANGLE if abs(goal) < ANGLE else 0.0  # Larger goals are forces [N].
    return np.array([2.0 * (FORCE - least) / (most - least) - 1.0, angle], np.float32)


if __name__ == "__main__":
    # Import this module by name, because worker processes cannot unpickle functions from
    # ``__main__``.
    from softfinger.gym.__main__ import main

    parser = argparse.ArgumentParser(
        description="Compare the returns of a random agent and of the grip law."
    )
    parser.add_argument("episodes", type=int, nargs="?", default=20)
    parser.add_argument("profile", nargs="?", default="sim")
    add_sweep(parser)
    main(**vars(parser.parse_args()))
