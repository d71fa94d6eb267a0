"""Drive the joints through dynamixel-sdk with one read and one write per tick.

A fast sync read returns the current, velocity, position and alert bit of all servos. Servos with
older firmware are read with the normal sync read. Every 10 ms, the read covers 28 more bytes per
servo: the stored goals, the bus watchdog and the clock. Four times per second, the read covers 11
more bytes per servo: supply voltage and temperature.

One sync write sends goal current and goal position as adjacent registers (:mod:`servos.torque`).
Current mode and position mode have a single goal, so they do not need indirect addresses. The
backend checks the required EEPROM values but never changes them.
"""

from __future__ import annotations

import contextlib
import logging
import math
import struct
import time
from collections import deque
from dataclasses import replace

from dynamixel_sdk.robotis_def import COMM_RX_CORRUPT, COMM_SUCCESS

from softfinger.daemon.clock import Clock
from softfinger.daemon.errors import ServoError, ServosSilent
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.servos.checks import Examined, check_latency_timer, examine
from softfinger.daemon.servos.control_table import ServoModel, by_name
from softfinger.daemon.servos.exchange import (
    CHECK,
    ENABLED,
    HEALTH,
    LENGTH_COUNT,
    PRESENT,
    Span,
    TickReads,
    choose_reads,
    note_slow_replies,
)
from softfinger.daemon.servos.joint import Joint, pack_goal
from softfinger.daemon.servos.protocol import (
    BITS_PER_BYTE,
    GroupRead,
    PacketHandler,
    PortLost,
    SerialPort,
    ServoLine,
)
from softfinger.daemon.servos.torque import Torque
from softfinger.daemon.types import Goal, Reading

_log = logging.getLogger(__name__)

_unpack_motion = struct.Struct("<hii").unpack_from  # current, velocity, position
_unpack_supply = struct.Struct("<HB").unpack_from  # voltage, temperature
_unpack_clock = struct.Struct("<H").unpack_from
_HEALTH_INTERVAL = 0.25  # s
_CHECK_INTERVAL = 0.01  # s
_CHECK_FRACTION = 0.05  # maximum fraction of the line capacity used by checks
_RECENT_TIME = 0.035  # maximum age of a recent goal [s]
_FROZEN_TIME = 0.1  # maximum time for which a servo's 1 ms clock may stop [s]
_VARIED_READ_COUNT = 32  # number of requests with varying span lengths after a missing reply
# Reply timeout during the checks [s]. A missing servo blocks the loop for four timeouts.
_CHECK_TIMEOUT = 0.2
# Reply timeout for an emulated hand [s]. The hand's clock pauses while the machine is late.
_BUSY_TIME = 0.04
_CLOSING_TRY_COUNT = 10  # number of torque-off attempts before the port is closed


class DynamixelServos:
    """Servo backend over a serial port; see :class:`servos.base.Servos`.

    An instance must be used from a single thread. ``notices`` contains the findings of `connect`
    that are not errors.
    """

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self.notices: tuple[Finding, ...] = ()
        self._clock = clock
        self._settings = settings.servos
        self._profile = settings
        self._mode = reg.MODE_NUMBERS[settings.servos.mode]
        self._handler = PacketHandler()
        self._joints: list[Joint] = []
        self._port: SerialPort | None = None  # open port
        self._torque: Torque | None = None  # None while the port is closed
        self._reads: TickReads | None = None  # None until the servos on the port have been checked
        self._torque_may_be_on = False  # True if torque was not confirmed off on the last port
        self._turn = 0  # index of the most recently used span length
        self._varied_reads = 0  # remaining number of requests with varying span lengths
        self._next_health = self._next_check = -math.inf  # clock times of the next reads
        self._check_interval = _CHECK_INTERVAL
        self._retries = 0
        self._alerts = 0

    # --- connect ---------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open or reopen the port and check every servo, without changing any register.

        If this object has lost the port while torque was on, torque is first switched off.

        Raises
        ------
        ServoError
            If problems were found; the message has one line per problem. The port is closed again,
            unless torque may be on. While the port is open, `torque_off` can be called.
        ServosSilent
            If the only problem is that servos do not respond. The port stays open for the next
            call, because reopening may restart an adapter that is still booting.
        """
        if self._reads is not None:
            self.close()
        servos, profile = self._settings, self._profile
        model = by_name(servos.model)
        stored = max(2, round(_RECENT_TIME * profile.loop.rate))
        self._joints = [Joint.of(servos, f, model) for f in profile.scene.indices]
        for joint in self._joints:
            joint.sent = deque(maxlen=stored)
        if self._port is None:
            patience = _BUSY_TIME if self._clock.pauses_when_late else 0.0
            port = SerialPort(servos.port, servos.baud, max(servos.reply_timeout, patience))
            port.openPort()
            self._port = port
        line = ServoLine(self._port, self._handler)
        self._torque = torque = Torque(line, model, profile, self._joints)
        torque.may_be_on = self._torque_may_be_on
        try:
            if torque.may_be_on:
                torque.ask_off()
            self._reads = self._check(line, model)
        except ServosSilent:
            raise  # The port stays open.
        except PortLost:
            self.close()
            raise
        except BaseException:
            if not torque.may_be_on:
                self.close()
            raise
        more = len(self._joints) * (PRESENT[0] - CHECK[0]) * BITS_PER_BYTE / servos.baud
        self._check_interval = max(_CHECK_INTERVAL, more / _CHECK_FRACTION)
        self._varied_reads = 0
        self._next_health = self._next_check = -math.inf

    def _check(self, line: ServoLine, model: ServoModel) -> TickReads:
        """Check the servos, the adapter and the group reads, and store joint limits and notices."""
        port = line.port
        allowed, port.reply_timeout = port.reply_timeout, max(port.reply_timeout, _CHECK_TIMEOUT)
        try:
            notices = self._judge(examine(line, self._profile, model), port, allowed)
            claims = all(model.fast_read(joint.firmware) for joint in self._joints)
            ids = [joint.id for joint in self._joints]
            reads, more = choose_reads(line, ids, claims)
            more += note_slow_replies(port, reads, self._profile)
        finally:
            port.reply_timeout = allowed
        self.notices = (*notices, *more)
        for notice in self.notices:
            _log.warning(notice)
        return reads

    def _judge(self, found: list[Examined], port: SerialPort, allowed: float) -> list[Finding]:
        """Set the joint limits from the results in ``found``, and return the notices.

        ``allowed`` is the maximum reply time [s]. Raises ServoError, which lists all problems.
        """
        if not any(each.replies for each in found):
            ids = ", ".join(str(joint.id) for joint in self._joints)
            raise ServosSilent(
                f"{port.port_name}: no servo replies at {port.baudrate} baud (IDs {ids}): check "
                "the power supply and the wiring; `softfinger doctor` tries every baud rate"
            )
        slow = check_latency_timer(port.port_name, allowed)
        findings = [slow] if slow else []
        for each in found:
            findings += each.findings
            if not each.replies:
                problem = f"no reply at {port.baudrate} baud"
                fix = "check the cable and the ID; `softfinger doctor` tries every baud rate"
                findings.append(Finding("FAIL", each.joint.name, problem, fix))
        if errors := [each for each in findings if each.status == "FAIL"]:
            silent = sum(not each.replies for each in found)
            kind = ServosSilent if len(errors) == silent else ServoError
            raise kind("\n".join(map(str, errors)))
        notices = [each for each in findings if each.status == "warn"]
        for joint, each in zip(self._joints, found, strict=True):
            limit = self._settings.current_limit[joint.finger]
            joint.firmware = each.table[reg.FIRMWARE_VERSION]
            joint.bound = min(each.table.word(reg.CURRENT_LIMIT), joint.scale.bound_counts(limit))
            joint.ends = (
                each.table.long(reg.MIN_POSITION_LIMIT),
                each.table.long(reg.MAX_POSITION_LIMIT),
            )
            if each.misplaced is not None:
                fix = f"{each.misplaced.fix}; until then, `arm` is rejected"
                notices.append(replace(each.misplaced, fix=fix))
        return notices

    # --- the tick --------------------------------------------------------------------------------

    def read(self, reading: Reading) -> None:
        """Update ``reading`` with one group read; repeat the read once after a corrupted reply."""
        now = self._clock.now()
        if now >= self._next_health:
            self._next_health = now + _HEALTH_INTERVAL
            found = self._exchange(HEALTH, reading)
            if found is not None:
                self._take_health(found, reading)
        elif now >= self._next_check:
            found = self._exchange(CHECK, reading)
            if found is not None:
                self._next_check = now + self._check_interval
                self._check_torque(found, reading, now)
        else:
            self._exchange(PRESENT, reading)

    def _exchange(self, span: Span, reading: Reading) -> GroupRead | None:
        """Read a span of registers that includes the joint motion, then update ``reading``."""
        if self._reads is None:
            raise ServoError("servos: not connected")
        reading.seq += 1
        turn = 0
        if self._varied_reads:
            self._varied_reads -= 1
            turn = self._turn = self._turn % (LENGTH_COUNT - 1) + 1
        group = self._reads.spans[span][turn]
        result = group.exchange()
        if result == COMM_RX_CORRUPT:
            # The repetition must finish before the deadline of the first exchange.
            deadline = group.port.deadline
            if time.monotonic() < deadline:
                self._retries += 1
                result = group.exchange(deadline)
        reading.valid = result == COMM_SUCCESS
        if not reading.valid:
            self._varied_reads = _VARIED_READ_COUNT
            return None
        reading.t = self._clock.now()
        at = reg.PRESENT_CURRENT - group.start
        alert = 0
        for joint in self._joints:
            f, scale = joint.finger, joint.scale
            current, velocity, position = _unpack_motion(group.data[joint.id], at)
            reading.q[f] = joint.q = scale.angle(position)
            reading.dq[f] = joint.dq = scale.rate(velocity)
            reading.current[f] = scale.amperes(current)
            if group.errors[joint.id] & 0x80:
                alert |= 1 << f
        if alert != reading.alert:
            reading.hardware[:] = 0, 0
        if alert:
            self._alerts += 1
            if not any(reading.hardware):
                self._ask_errors(reading)
        reading.alert = alert
        return group

    def _take_health(self, group: GroupRead, reading: Reading) -> None:
        at = reg.PRESENT_INPUT_VOLTAGE - group.start
        for joint in self._joints:
            voltage, temperature = _unpack_supply(group.data[joint.id], at)
            reading.voltage[joint.finger] = voltage * reg.VOLTAGE_UNIT
            reading.temperature[joint.finger] = float(temperature)

    def _check_torque(self, group: GroupRead, reading: Reading, now: float) -> None:
        """Check that the clock of each servo advances and that each servo has a recent goal."""
        start, torque = group.start, self._torque
        assert torque is not None
        reading.lost = reading.frozen = 0
        for joint in self._joints:
            table = group.data[joint.id]
            (ticks,) = _unpack_clock(table, reg.REALTIME_TICK - start)
            if ticks != joint.ticks:
                joint.ticks, joint.ticked = ticks, now
            elif now - joint.ticked > _FROZEN_TIME:
                reading.frozen |= 1 << joint.finger
            if not torque.holds_goal(joint, table, start):
                reading.lost |= 1 << joint.finger

    def _ask_errors(self, reading: Reading) -> None:
        """Read the hardware error registers to explain an alert."""
        assert self._reads is not None
        errors = self._reads.errors
        if errors.exchange() == COMM_SUCCESS:
            for joint in self._joints:
                reading.hardware[joint.finger] = errors.data[joint.id][0]

    def write(self, goal: Goal) -> None:
        """Send the goal angles and current limits if this object has switched torque on."""
        torque = self._torque
        if torque is None or torque.goals is None:
            return
        servos, mode, q, current = self._settings, self._mode, goal.q, goal.current
        values = []
        for joint in self._joints:
            counts = joint.goal(servos, mode, q[joint.finger], current[joint.finger])
            value = pack_goal(mode, *counts)
            joint.sent.append(value)
            values.append(value)
        torque.goals.send(values)

    def torque_on(self) -> None:
        """Switch torque on; see `Torque.on`."""
        if self._torque is None or self._reads is None:
            raise ServoError("servos: not connected")
        self._torque.on()

    def torque_off(self, reading: Reading) -> bool:
        """Request torque off and read the servos; return True if all servos confirm torque off."""
        torque = self._torque
        if torque is None:
            raise ServoError("servos: not connected")
        torque.ask_off()
        if self._reads is None:  # `connect` has failed.
            reading.valid = False
            is_off = torque.is_off()
        else:
            found = self._exchange(ENABLED, reading)
            is_off = found is not None and not any(
                found.data[joint.id][reg.TORQUE_ENABLE - found.start] for joint in self._joints
            )
        if is_off:
            torque.confirmed_off()
            self._torque_may_be_on = False
            reading.lost = 0
        return is_off

    # --- closing ---------------------------------------------------------------------------------

    def counters(self) -> dict[str, int]:
        return {**self._handler.counters, "retries": self._retries, "alerts": self._alerts}

    def close(self) -> None:
        """Switch torque off, verify the result if possible, and close the port. Never raises.

        If another program switched torque on, the torque stays on.
        """
        torque, reading, why = self._torque, Reading(), ""
        try:
            for _ in range(_CLOSING_TRY_COUNT):
                if torque is None or not torque.may_be_on:
                    break
                self.torque_off(reading)
        except Exception as error:
            why = f" ({error})"
        if torque is not None:
            self._torque_may_be_on = torque.may_be_on
        if torque is not None and torque.may_be_on:
            _log.error(
                "servos: torque off was not confirmed%s; the bus watchdogs will stop the servos",
                why,
            )
        port, self._port = self._port, None
        self._torque = self._reads = None
        if port is not None:
            with contextlib.suppress(Exception):
                port.closePort()
