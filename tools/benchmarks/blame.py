"""Whose fault a missed cycle is: the time of one, taken apart. Pure, so that it can be tested.

A cycle is the program's own fault when its computing and the bytes' own time on the wire alone take
more than a period: it would have been missed on a machine that does nothing else. Otherwise the
largest of what held it up is named, each as the kernel counts it. A virtual machine's kernel
charges what its host takes to whoever runs, so that a cycle that the host held up may count as its
own.
"""

from __future__ import annotations

from dataclasses import dataclass

OWN = "the program's own computing"
PUT_ASIDE = "another process had the program's processor"
TIMER = "the timer woke it late"
SERVOS_PUT_ASIDE = "another process had the emulated servos' processor"
SERVOS = "the emulated servos' own computing"
BETWEEN = "the kernel's worker that carries bytes across, or the host"
CAUSES = (OWN, PUT_ASIDE, TIMER, SERVOS_PUT_ASIDE, SERVOS, BETWEEN)


@dataclass(frozen=True, slots=True)
class Cycle:
    """One cycle from its deadline to its end [s]; of both sides what the kernel counted in it."""

    late: float  # from the deadline to the wake-up
    work: float  # from there to the end
    computing: float  # processor time of the program's thread
    put_aside: float  # it was ready to run, and did not
    servos_computing: float
    servos_put_aside: float


def cause(cycle: Cycle, period: float, wire: float, servos_usual: float) -> str:
    """One of CAUSES for a cycle that ended after the next was due.

    ``wire`` [s] is the bytes' own time, ``servos_usual`` [s] what the emulated servos compute in an
    undisturbed cycle, in which they also wait awake for a reply's due time.
    """
    if cycle.computing + wire > period:
        return OWN
    timer = max(cycle.late - cycle.put_aside, 0.0)
    theirs = max(cycle.servos_computing - servos_usual, 0.0)
    known = cycle.computing + cycle.put_aside + timer + cycle.servos_put_aside + theirs
    between = max(cycle.late + cycle.work - wire - known, 0.0)
    shares = {
        PUT_ASIDE: cycle.put_aside,
        TIMER: timer,
        SERVOS_PUT_ASIDE: cycle.servos_put_aside,
        SERVOS: theirs,
        BETWEEN: between,
    }
    return max(shares, key=lambda name: shares[name])
