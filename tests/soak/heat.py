"""Predict the temperatures of servos whose thermal constants are unknown.

``python -m tests.soak.heat --runs 40`` performs 40 runs.

Each run draws a servo model and a room temperature from 15 to 35 °C. The factors for heating,
cooling and heat capacity are 0.75 to 1.33. The current is 1.15 to 1.8 times the maximum continuous
current. At a random time, the room becomes 5 or 8 °C warmer or colder. The daemon's filter receives
temperatures in whole degrees and a current with 3 % noise. The plant is `servo_model.servo_joint`.
``--grips N`` also simulates N complete hands, each of which grips too hard for too long.
"""

import argparse
import random
import sys
from copy import copy
from typing import NamedTuple

from softfinger.daemon.control.modes import GRIPPING_MODES
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.heat import HeatWatch
from softfinger.daemon.simulation.servo_model.servo_joint import ServoHeat
from softfinger.daemon.types import State
from softfinger.tools.simulated_daemon import SimulatedDaemon

LIMIT = 70.0  # °C
_DT = 0.5  # s
_MODELS = ("XM430-W350", "XL330-M288")
_LONG = 8000.0  # duration that is long enough to reach the steady state [s]


class Foreseen(NamedTuple):
    """Result of the prediction in one run."""

    warned: float  # time from the warning to the limit [s]
    told: float  # time until the limit as predicted 60 s before [s]
    lasted: float  # total duration [s]


class Bench:
    """Servo with random thermal constants, and the daemon's prediction of its temperature."""

    def __init__(self, seed: int) -> None:
        self.chance = chance = random.Random(seed)
        model = chance.choice(_MODELS)
        factors = tuple(chance.uniform(0.75, 1.33) for _ in range(3))
        simulation = {"servo_heat": factors, "ambient": chance.uniform(15.0, 35.0)}
        settings = Settings.model_validate({"servos": {"model": model}, "simulation": simulation})
        self.plant = ServoHeat.of(settings)
        self.state = State()
        self.state.reading.t = self.t = 0.0
        self._watch = HeatWatch(settings, self.state)

    def lasting_current(self) -> float:
        """Return the current [A] at which the plant's case temperature settles at the limit."""
        low, high = 0.0, 3.0
        while high - low > 3e-3:
            current = 0.5 * (low + high)
            trial = copy(self.plant)
            trial.step(current, _LONG)
            if trial.case > LIMIT:
                high = current
            else:
                low = current
        return low

    def step(self, current: float) -> float:
        """Apply a current [A] for _DT seconds; return the predicted time until the limit [s]."""
        self.t += _DT
        noisy = current * (1.0 + 0.03 * self.chance.gauss(0.0, 1.0))
        self.plant.step(current, _DT)
        reading = self.state.reading
        reading.t = self.t
        reading.current[0] = noisy
        reading.temperature[0] = float(round(self.plant.sensed))
        self._watch.update()
        return self.state.heat[0].time_to_limit


def foreseen(seed: int) -> Foreseen:
    """Apply an excessive current until the temperature reading reaches the limit."""
    bench = Bench(seed)
    chance = bench.chance
    current = bench.lasting_current() * chance.uniform(1.15, 1.8)
    begins, changes = chance.uniform(10.0, 60.0), chance.uniform(60.0, 600.0)
    change = chance.choice((-8.0, -5.0, 5.0, 8.0))
    told = []
    while round(bench.plant.sensed) < LIMIT and bench.t < _LONG:
        if abs(bench.t - changes) < 0.5 * _DT:
            bench.plant.ambient += change
        told.append(bench.step(current if bench.t > begins else 0.0))
    warned = next(k for k, left in enumerate(told) if left < 60.0)
    return Foreseen((len(told) - 1 - warned) * _DT, told[-1 - round(60.0 / _DT)], bench.t)


def least_at_half_load(seed: int, seconds: float = 3600.0) -> float:
    """Apply half the maximum continuous current, and make the room 8 °C warmer halfway through.

    Returns the minimum predicted time until the limit [s].
    """
    bench = Bench(seed)
    current, least = 0.5 * bench.lasting_current(), _LONG
    while bench.t < seconds:
        if bench.t == 0.5 * seconds:
            bench.plant.ambient += 8.0
        least = min(least, bench.step(current))
    return least


class Held(NamedTuple):
    """Result of a grip whose force is higher than the servos can sustain."""

    # True if the hand lost its grip for any reason.
    dropped: bool
    force: float  # requested force at the end [N]
    events: list[str]


def held(seed: int, seconds: float = 400.0) -> Held:
    """Grip with 20 to 26 N, using servos with about a fifth of the usual heat capacity."""
    chance = random.Random(seed)
    factors = (
        chance.uniform(0.9, 1.33),
        chance.uniform(0.75, 1.1),
        0.2 * chance.uniform(0.75, 1.33),
    )
    simulation = {"servo_heat": factors, "ambient": chance.uniform(25.0, 40.0), "seed": seed}
    with SimulatedDaemon({"simulation": simulation}) as hand:
        hand.grasp(chance.uniform(20.0, 26.0))
        hand.run(seconds)
        told = [text for _, kind, text in hand.events if kind == "servos.heat"]
        return Held(hand.mode not in GRIPPING_MODES, hand.state.goal.force, told)


def main(argv: list[str] | None = None) -> int:
    """Print the fraction of runs that met each target; return 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="of the first run")
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--grips", type=int, default=0)
    arguments = parser.parse_args(argv)
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    runs = [foreseen(seed) for seed in seeds]
    ahead = sum(run.warned >= 30.0 for run in runs) / len(runs)
    near = sum(abs(run.told / 60.0 - 1.0) <= 0.15 for run in runs) / len(runs)
    errors = sorted(run.told / 60.0 - 1.0 for run in runs)
    print(f"warned 30 s ahead: {ahead:.1%}; least {min(run.warned for run in runs):.1f} s")
    print(f"60 s told within 15 %: {near:.1%}; errors {errors[0]:+.1%} to {errors[-1]:+.1%}")
    false = sum(least_at_half_load(seed) < 60.0 for seed in seeds)
    print(f"false warnings in an hour at half load: {false} of {arguments.runs}")
    drops = 0
    for seed in seeds[: arguments.grips]:
        outcome = held(seed)
        drops += outcome.dropped
        print(f"grip {seed}: {outcome.force:.1f} N in the end, {'; '.join(outcome.events)}")
    print(f"dropped: {drops} of {arguments.grips}")
    return int(ahead < 0.95 or near < 0.95 or false > 0 or drops > 0)


if __name__ == "__main__":
    sys.exit(main())
