"""Choose and perform the group reads of a tick, and measure how long exchanges take.

The daemon and `doctor` share this code, so `doctor` tests the exchanges that the daemon uses.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from dynamixel_sdk.robotis_def import COMM_SUCCESS

from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Finding, Status
from softfinger.daemon.servos.protocol import (
    TRY_COUNT,
    FastGroupRead,
    GroupRead,
    SerialPort,
    ServoLine,
)

Span = tuple[int, int]  # first and last address
# Register spans that are read in one exchange. Most ticks read PRESENT. CHECK adds the goals and
# the bus watchdog. HEALTH adds supply voltage and temperature. ENABLED begins at the torque-enable
# register.
PRESENT: Span = (reg.PRESENT_CURRENT, reg.PRESENT_POSITION + 3)
CHECK: Span = (reg.BUS_WATCHDOG, reg.PRESENT_POSITION + 3)
HEALTH: Span = (reg.PRESENT_CURRENT, reg.PRESENT_TEMPERATURE)
ENABLED: Span = (reg.TORQUE_ENABLE, reg.PRESENT_POSITION + 3)
# A late reply could be mistaken for the reply to the next request. After a missing reply, each of
# the next requests therefore has a different length, which identifies the reply.
LENGTH_COUNT = 11  # number of variants of each span, with zero to ten extra bytes at the start

EXCHANGE_COUNT = 50  # number of exchanges that `doctor` times
_TIMED_REPLY_TIMEOUT = 0.1  # minimum reply timeout for timed exchanges [s]
_CONNECT_READ_COUNT = 9  # number of reads in `connect`; the fastest sets the minimum reply time
_REPLY_FRACTION_MAX = 0.8  # maximum duration of a reply as a fraction of the tick period
# Fraction of failed exchanges above which a warning is issued, and fraction above which the check
# fails.
_FAILED_FRACTION_WARN, _FAILED_FRACTION_FAIL = 0.02, 0.2


class TickReads:
    """Group reads of a tick, one for each register span and length."""

    def __init__(self, line: ServoLine, ids: Sequence[int], kind: type[GroupRead]) -> None:
        self.spans = {
            (first, last): [
                kind(line, first - more, last + 1 - first + more, ids)
                for more in range(LENGTH_COUNT)
            ]
            for first, last in (PRESENT, CHECK, HEALTH, ENABLED)
        }
        self.errors = kind(line, reg.HARDWARE_ERROR_STATUS, 1, ids)

    def answered(self) -> bool:
        """Return True if all servos respond to each group read."""
        return all(
            any(lengths[0].exchange() == COMM_SUCCESS for _ in range(TRY_COUNT))
            for lengths in self.spans.values()
        )


def choose_reads(
    line: ServoLine, ids: Sequence[int], claims_fast: bool
) -> tuple[TickReads, list[Finding]]:
    """Return the fastest group reads that all servos support, and a list of notices.

    ``claims_fast`` is True if the firmware should support fast sync reads. If fast reads fail, the
    normal sync read is used and a notice is returned. Raises ServoError if the servos do not
    respond to any group read.
    """
    notices: list[Finding] = []
    if claims_fast:
        reads = TickReads(line, ids, FastGroupRead)
        if reads.answered():
            return reads, notices
        text = "the servos do not reply to fast sync reads, although their firmware supports them"
        notices.append(Finding("warn", "servos", text, "the daemon uses slower normal sync reads"))
    reads = TickReads(line, ids, GroupRead)
    if not reads.answered():
        listed = ", ".join(map(str, ids))
        raise ServoError(
            f"{line.port.port_name}: the servos (IDs {listed}) reply to single reads, but not to a "
            "sync read of all servos: check the cables between the servos, and lower servos.baud"
        )
    return reads, notices


class ExchangeTimes(NamedTuple):
    """Exchange durations [s] and the fraction of failed exchanges."""

    least: float
    p50: float
    p99: float
    failed: float


def time_exchanges(
    port: SerialPort,
    reads: TickReads,
    write: Callable[[], None] | None = None,
    count: int = EXCHANGE_COUNT,
) -> ExchangeTimes:
    """Measure the duration of ``count`` exchanges with the reads and writes of a tick.

    There are no pauses between exchanges. A read waits until the preceding write has been
    transmitted, so the read's duration includes both transmissions. If ``write`` is None, only
    reads are timed. The reply timeout is at least 0.1 s.
    """
    allowed, port.reply_timeout = port.reply_timeout, max(port.reply_timeout, _TIMED_REPLY_TIMEOUT)
    group, durations = reads.spans[PRESENT][0], []
    try:
        for _ in range(count):
            began = time.monotonic()
            if group.exchange() == COMM_SUCCESS:
                durations.append(time.monotonic() - began)
            if write is not None:
                write()
    finally:
        port.reply_timeout = allowed
    if not durations:
        return ExchangeTimes(math.inf, math.inf, math.inf, 1.0)
    p50, p99 = np.percentile(durations, (50, 99)).tolist()
    return ExchangeTimes(min(durations), p50, p99, (count - len(durations)) / count)


def judge_exchanges(
    times: ExchangeTimes, settings: Settings, what: str, emulated: bool = False
) -> Finding:
    """Compare exchange durations with the tick period and with ``servos.reply_timeout``.

    ``what`` is the name of the timed exchanges in the report. An ``emulated`` hand shares the
    processors with its clients, so the fastest exchange is compared instead of the 99th percentile.
    """
    decisive = times.least if emulated else times.p99
    rate, allowed = settings.loop.rate, settings.servos.reply_timeout
    failed = f"{times.failed:.0%} failed"
    if times.failed == 1.0:
        text = f"{what}: no reply within {_TIMED_REPLY_TIMEOUT * 1e3:g} ms"
        return Finding("FAIL", "exchange", text, "check the cable, and lower servos.baud")
    text = f"{what}: p50 {_ms(times.p50)}, p99 {_ms(times.p99)}, {failed}"
    if decisive > min(1.0 / rate, allowed):
        text += (
            f"; expected at most {_ms(1.0 / rate)}, the period of a tick (loop.rate = {rate:g}), "
            f"and at most {_ms(allowed)} (servos.reply_timeout)"
        )
        return Finding("FAIL", "exchange", text, _remedy(decisive, settings))
    if times.failed > _FAILED_FRACTION_WARN:
        status: Status = "FAIL" if times.failed > _FAILED_FRACTION_FAIL else "warn"
        fix = "check the cable and its connectors, and lower servos.baud"
        return Finding(status, "exchange", text, fix)
    if decisive * rate > _REPLY_FRACTION_MAX:
        text += (
            f"; a cycle takes up most of a tick of {_ms(1.0 / rate)} (loop.rate = {rate:g}), so "
            "ticks will be late"
        )
        return Finding("warn", "exchange", text, _remedy(decisive, settings))
    return Finding("pass", "exchange", text)


def note_slow_replies(port: SerialPort, reads: TickReads, settings: Settings) -> list[Finding]:
    """Return a notice if even the fastest of a few test reads takes up most of a tick."""
    least = time_exchanges(port, reads, count=_CONNECT_READ_COUNT).least
    rate = settings.loop.rate
    if least * rate <= _REPLY_FRACTION_MAX:
        return []
    text = (
        f"the servos take at least {_ms(least)} to reply, which is {least * rate:.0%} of a tick of "
        f"{_ms(1.0 / rate)} (loop.rate = {rate:g}), so ticks will be late"
    )
    fix = (
        f"{_remedy(least, settings)}; run `softfinger doctor` to measure the reply times of "
        f"{EXCHANGE_COUNT} exchanges"
    )
    return [Finding("warn", "servos", text, fix)]


def _remedy(duration: float, settings: Settings) -> str:
    """Suggest settings for replies that take ``duration`` seconds."""
    rate = _REPLY_FRACTION_MAX / duration
    digit = 10.0 ** max(len(str(int(rate))) - 2, 0)
    parts = []
    if duration > settings.servos.reply_timeout:
        parts.append(f"servos.reply_timeout = {1.5 * duration:.2g}")
    if duration * settings.loop.rate > _REPLY_FRACTION_MAX:
        parts.append(f"loop.rate = {max(rate // digit * digit, 1.0):g}")
    return f"set {' and '.join(parts)}, or use a faster adapter (latency timer of 1 ms)"


def _ms(seconds: float) -> str:
    value = seconds * 1e3
    return f"{value:.0f} ms" if value >= 100.0 else f"{value:.3g} ms"
