"""Train a baseline policy on ``SoftFinger-Grasp-v0`` with the cross-entropy method.

``python -m softfinger.gym.baseline [GENERATIONS]`` trains with shaped rewards for several minutes
and prints the unshaped return after each generation. ``--plot`` draws the returns. Episodes run on
the workers selected by ``--processes`` or ``--scheduler``.

The policy has a single weight vector, which is applied to each finger's features. Each generation
samples weight vectors from a normal distribution that is fitted to the previous generation's best
samples.
"""

from __future__ import annotations

import argparse
import time
from contextlib import closing
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
from numpy.typing import NDArray

from softfinger.gym import SECONDS, STEP
from softfinger.gym.__main__ import Policy, episode
from softfinger.gym.environment import FORCE, Observation
from softfinger.tools import style
from softfinger.tools.sweep import Sweep, add_sweep

SAMPLE_COUNT, ELITE_COUNT, EPISODES = 24, 6, 2  # samples, elites, and episodes per sample
STEPS = round(SECONDS / STEP)
FEATURES = 5
# Scale of the weights. An action of 1 means 1 rad/s, so small weights limit the joint speed.
_WEIGHT_SCALE = 0.2
_ADDED_STD = 0.2  # added to the standard deviation to avoid premature convergence

Weights = NDArray[np.float64]


def policy(weights: Weights) -> Policy:
    """Create the policy with the given ``weights`` [FEATURES]."""

    def act(observation: Observation) -> NDArray[np.float32]:
        contacts, joints = observation["contacts"].reshape(2, 3), observation["joints"]
        own = (observation["goal"] - contacts[:, 2]) / FORCE
        touching = contacts[:, 0] > 0.0
        features = [np.ones(2), own, own[::-1], touching, joints[2:4]]
        action: NDArray[np.float32] = np.tanh(_WEIGHT_SCALE * weights @ np.array(features)).astype(
            np.float32
        )
        return action

    return act


def returns(seed: int, shaped: bool, weights: Weights) -> float:
    """Compute the mean return of EPISODES episodes with consecutive seeds from ``seed`` on."""
    with closing(gymnasium.make("SoftFinger-Grasp-v0", shaped=shaped)) as env:
        act = policy(weights)
        return float(np.mean([episode(env, act, seed + k) for k in range(EPISODES)]))


def learn(
    generations: int, processes: int | None = None, scheduler: str | None = None
) -> list[float]:
    """Train the policy and return the unshaped return of each generation.

    The function prints one line per generation and the final mean weights.
    """
    rng, curve = np.random.default_rng(0), []
    mean, std = np.zeros(FEATURES), np.ones(FEATURES)
    began = time.monotonic()
    for k in range(generations):
        rows = mean + std * rng.standard_normal((SAMPLE_COUNT, FEATURES))
        tried = Sweep(f"{k + 1}", partial(returns, 1000 + EPISODES * k, True), list(rows))
        found = np.array(list(tried.run(processes, scheduler)))
        best = rows[np.argsort(found)[-ELITE_COUNT:]]
        mean, std = best.mean(axis=0), best.std(axis=0) + _ADDED_STD / (k + 1)
        curve.append(returns(0, False, mean))
        spent = time.monotonic() - began
        print(f"{k + 1:3}  {curve[-1]:6.1f} of {STEPS}  {spent:5.0f} s", flush=True)
    print(mean)
    return curve


def draw(curve: list[float], path: Path) -> None:
    """Save a plot of the return versus the generation to ``path``.

    Raises MissingExtra if matplotlib is not installed, and OSError if the file cannot be written.
    """
    with style.settings():
        figure = style.new_figure(4.2, 2.2)
        axes = figure.subplots()
        axes.plot(range(1, len(curve) + 1), curve, marker="o", color=style.KINDS[0])
        axes.set(xlabel="generation", ylabel=f"return of {STEPS}", ylim=(0, STEPS))
        style.save(figure, path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Learn to grasp by the cross-entropy method.")
    parser.add_argument("generations", type=int, nargs="?", default=12)
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the returns (extra 'plot')")
    add_sweep(parser)
    options = vars(parser.parse_args())
    picture = options.pop("plot")
    found = learn(**options)
    if picture:
        draw(found, picture)
