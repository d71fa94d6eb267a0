"""Fuzz some or all targets with ``python -m tests.fuzz TARGET … --count N --seed S``.

Each target receives N inputs. The run stops at the first input that raises an unexpected exception.
Errors that do not raise an exception are printed, and the run continues.
"""

import argparse
import sys
import time
from functools import partial

from tests.fuzz import commands, plant, servo_bus, tactile

RUNS = {
    **{name: partial(commands.fuzz, name) for name in commands.TARGETS},
    **{name: partial(tactile.fuzz, name) for name in tactile.TARGETS},
    "servo_bus": servo_bus.fuzz,
    "plant": plant.fuzz,
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", choices=[*RUNS, []], metavar="TARGET")
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    failed = False
    for name in arguments.targets or RUNS:
        begin = time.monotonic()
        found = RUNS[name](arguments.count, arguments.seed)
        took = time.monotonic() - begin
        print(f"{name}: {arguments.count} in {took:.0f} s: {found}", flush=True)
        failed |= bool(getattr(found, "wrong", ()))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
