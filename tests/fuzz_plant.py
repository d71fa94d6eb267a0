"""Random commands, pushes and parameters against the simulated hand.

The tests run some thousand commands; ``python -m tests.fuzz_plant --count 1000000`` runs a million.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from tests.plant_harness import BOUNDED, CURRENT, PAPER, POSITION, TABLE_I, make, place, run

LONG_STEP = 2.5e-3  # s, ten times the longest that the plant chooses


def abuse(seed: int, count: int) -> str:
    """Send ``count`` random commands to a hand of random parameters; what went wrong, or \"\".

    Masses from 1 g to 10 kg, moduli from 10 kPa to 10 MPa, friction from 0 to 2, joints from 1e-4
    to 0.1 kg·m², gravity in any direction.
    """
    generator = np.random.default_rng(seed)
    hand = make(
        TABLE_I if seed % 2 else PAPER,
        step=LONG_STEP if seed % 3 == 0 else None,
        object_mass=float(10 ** generator.uniform(-3, 1)),
        modulus_scale=float(10 ** generator.uniform(-1.5, 1.5)),
        tip_friction=float(generator.uniform(0, 2)),
        joint_inertia=float(10 ** generator.uniform(-4, -1)),
        tip_loss=float(10 ** generator.uniform(-5, -1)),
        gravity=tuple(float(g) for g in generator.normal(size=2)),
    )
    for k in range(count):
        hand.drive(
            int(generator.integers(2)),
            int(generator.choice([CURRENT, POSITION, BOUNDED])),
            bool(generator.random() < 0.9),
            float(generator.uniform(-2, 2)),
            float(generator.uniform(-4, 4)),
        )
        if generator.random() < 0.2:
            hand.push(*generator.normal(size=2), float(generator.normal() * 0.05))
        if generator.random() < 0.01:
            place(hand, (0.0, 0.0), (0.0, 0.08, 0.0))  # open, the object back between the fingers
        run(hand, float(generator.uniform(0, 0.02)))
        if not np.isfinite(hand.memory).all():
            return f"seed {seed}, command {k}: not finite"
        # Past the tip's limit only with the rim pressed in, which is told.
        limit = 0.020 * (1 - np.abs(np.sin(hand.theta)))
        past = (hand.d > limit + 1e-9) & (hand.force > 0)
        if not (hand.rim[past] > 0).all():
            return f"seed {seed}, command {k}: past the limit untold, d = {hand.d}"
        if np.abs(hand.q).max() > 1.6:
            return f"seed {seed}, command {k}: joints far past their stops, q = {hand.q}"
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100_000, help="commands in all")
    parser.add_argument("--seed", type=int, default=1000, help="of the first hand")
    options = parser.parse_args()
    each, bad, begin = 400, 0, time.perf_counter()
    hands = max(options.count // each, 1)
    for seed in range(options.seed, options.seed + hands):
        wrong = abuse(seed, each)
        if wrong:
            bad += 1
            print(wrong)
    seconds = time.perf_counter() - begin
    print(f"{hands * each} commands to {hands} hands in {seconds:.0f} s, {bad} hands went wrong")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
