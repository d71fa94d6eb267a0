"""The hand's joints through dynamixel-sdk: check at connect, one read and one write a tick.

Current, velocity, position and the alert bit of all servos come in one fast sync read (sync read
where a firmware is older); four times a second that read reaches on to supply voltage and
temperature, which costs 11 bytes a servo and no exchange. Goal current and goal position go in one
sync write, side by side (:mod:`daemon.servos.torque`); in current and position mode there is one
goal and no indirection. What a servo must be set to in EEPROM is checked and never changed here.
"""

from __future__ import annotations

import contextlib
import logging
import math
import struct
import time

from dynamixel_sdk.robotis_def import COMM_RX_CORRUPT, COMM_SUCCESS

from daemon.clock import Clock
from daemon.records import FINGERS, Goal, Reading
from daemon.servos import registers as reg
from daemon.servos.base import ServoError
from daemon.servos.checks import check_latency
from daemon.servos.examine import examine
from daemon.servos.groups import GroupRead
from daemon.servos.joints import Joint
from daemon.servos.line import ServoLine
from daemon.servos.models import ServoModel, by_name
from daemon.servos.modes import mode_number
from daemon.servos.packets import PacketHandler
from daemon.servos.port import PortGone, SerialPort
from daemon.servos.torque import Torque
from daemon.servos.units import JointScale
from daemon.settings import Settings

_log = logging.getLogger(__name__)

_PRESENT = struct.Struct("<hii")  # current, velocity, position
_SPAN = reg.PRESENT_POSITION + 4 - reg.PRESENT_CURRENT
_HEALTH = struct.Struct("<hii8xHB")  # the same, supply voltage, temperature
_HEALTH_SPAN = reg.PRESENT_TEMPERATURE + 1 - reg.PRESENT_CURRENT
_HEALTH_EVERY = 0.25  # s
# A reply may come after its deadline, and be taken for the next question's. So after a question
# without an answer the next ones ask for spans of different lengths, which tell replies apart.
_MARKS = range(1, _HEALTH_SPAN - _SPAN)  # bytes more than are needed
_DOUBTFUL = 32  # questions
_PATIENCE = 0.02  # s that a reply may take while the servos are checked: nothing hurries there


class DynamixelServos:
    """Servo backend over a serial port; see :class:`daemon.servos.base.Servos`.

    One thread, one owner. ``notices`` holds what connect found worth saying and not wrong.
    """

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self.notices: tuple[str, ...] = ()
        self._clock = clock
        self._settings = settings.servos
        self._profile = settings
        self._mode = mode_number(settings.servos)
        self._handler = PacketHandler()
        self._joints: list[Joint] = []
        self._line: ServoLine | None = None
        self._present: GroupRead | None = None
        self._health: GroupRead | None = None
        self._marked: list[GroupRead] = []
        self._turn = 0
        self._doubtful = 0  # questions to come whose replies may be mistaken for each other's
        self._next_health = -math.inf  # time.monotonic() at which it is read in present's place
        self._torque: Torque | None = None
        self._fast = False
        self._retries = 0
        self._alerts = 0

    # --- connect -----------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the port, again if it is open, and check every servo; changes nothing in them.

        Raises:
            ServoError: all that is wrong, one line each. The port is closed again.
        """
        self.close()
        servos = self._settings
        try:
            model = by_name(servos.model)
        except KeyError as error:
            raise ServoError(f"servos.model: {error.args[0]}") from None
        fingers = [FINGERS.index(name) for name in self._profile.scene.fingers]
        self._joints = [
            Joint(finger, servos.ids[finger], JointScale.of(servos, finger, model))
            for finger in fingers
        ]
        port = SerialPort(servos.port, servos.baud, servos.reply_timeout)
        port.openPort()
        line = ServoLine(port, self._handler)
        torque = Torque(line, model, servos, self._profile.hand, self._joints, self._mode)
        try:
            self._check(line, model, torque)
        except BaseException:
            port.closePort()
            raise
        ids = [joint.id for joint in self._joints]
        self._present = GroupRead(port, self._handler, reg.PRESENT_CURRENT, _SPAN, ids)
        self._health = GroupRead(port, self._handler, reg.PRESENT_CURRENT, _HEALTH_SPAN, ids)
        self._marked = [
            GroupRead(port, self._handler, reg.PRESENT_CURRENT, _SPAN + more, ids)
            for more in _MARKS
        ]
        self._doubtful = 0
        self._next_health = -math.inf
        self._torque = torque
        self._line = line

    def _check(self, line: ServoLine, model: ServoModel, torque: Torque) -> None:
        port = line.port
        latency = check_latency(port.port_name, port.latency_timer(), port.reply_timeout)
        errors, notices = list(latency.errors), list(latency.notices)
        allowed, port.reply_timeout = port.reply_timeout, max(port.reply_timeout, _PATIENCE)
        try:
            found = examine(line, self._profile, model)
        finally:
            port.reply_timeout = allowed
        silent = []
        self._fast = True
        for joint, each in zip(self._joints, found, strict=True):
            errors += each.findings.errors
            notices += each.findings.notices
            if not each.answers:
                silent.append(joint.name)
            if each.table:
                self._fast = self._fast and model.fast_read(each.table[reg.FIRMWARE_VERSION])
                limit = self._settings.current_limit[joint.finger]
                joint.bound = min(each.word(reg.CURRENT_LIMIT), joint.scale.bound_counts(limit))
                joint.ends = each.long(reg.MIN_POSITION_LIMIT), each.long(reg.MAX_POSITION_LIMIT)
        if silent and len(silent) == len(self._joints):
            raise ServoError(
                f"{port.port_name}: no servo answers at {port.baudrate} baud (IDs "
                f"{', '.join(str(joint.id) for joint in self._joints)}): check power and wiring; "
                "`softfinger doctor` looks for them at every rate"
            )
        for name in silent:
            errors.append(
                f"{name}: no answer at {port.baudrate} baud: check its cable and ID; "
                "`softfinger doctor` looks for it at every rate"
            )
        if errors:
            raise ServoError("\n".join(errors))
        strayed = torque.strayed({each.id: each.position for each in found})
        notices += [f"{text}; torque is refused there" for text in strayed if text]
        self.notices = tuple(notices)
        for notice in notices:
            _log.warning(notice)

    # --- the tick ----------------------------------------------------------------------------

    def read(self, reading: Reading) -> None:
        """Fill ``reading`` from one group read; a damaged reply is asked for once more in time.

        Raises:
            ServoError: the port is gone.
        """
        present, torque = self._present, self._torque
        if present is None or torque is None:
            raise ServoError("servos: not connected")
        reading.seq += 1
        begin = time.monotonic()
        healthy = begin >= self._next_health
        if healthy and self._health is not None:
            self._next_health = begin + _HEALTH_EVERY
            present = self._health
        elif self._doubtful:
            self._doubtful -= 1
            self._turn = (self._turn + 1) % len(self._marked)
            present = self._marked[self._turn]
        result = present.exchange(self._fast)
        if result == COMM_RX_CORRUPT:
            # Once more, with what is left of the first exchange's deadline.
            port = present.port
            port.not_after = port.deadline
            if time.monotonic() < port.deadline:
                self._retries += 1
                result = present.exchange(self._fast)
            port.not_after = math.inf
        reading.valid = result == COMM_SUCCESS
        if not reading.valid:
            self._doubtful = _DOUBTFUL
            return
        reading.t = self._clock.now()
        torque.heard(begin)
        alert = 0
        for joint in self._joints:
            finger, scale, data = joint.finger, joint.scale, present.data_dict[joint.id]
            if healthy:
                current, velocity, position, voltage, temperature = _HEALTH.unpack(data)
                reading.voltage[finger] = voltage * reg.VOLTAGE_UNIT
                reading.temperature[finger] = float(temperature)
            else:
                current, velocity, position = _PRESENT.unpack_from(data)
            reading.q[finger] = joint.q = scale.angle(position)
            reading.dq[finger] = joint.dq = scale.rate(velocity)
            reading.current[finger] = scale.amperes(current)
            if present.errors[joint.id] & 0x80:
                alert |= 1 << finger
        if alert:
            self._alerts += 1
            if alert != reading.alert:
                self._ask_errors(reading)
        reading.alert = alert

    def _ask_errors(self, reading: Reading) -> None:
        """Learn what the servos' alert means, once."""
        if self._line is not None:
            for joint in self._joints:
                status = self._line.read(joint.id, reg.HARDWARE_ERROR_STATUS, 1)
                reading.hardware[joint.finger] = status[0] if status else 0

    def write(self, goal: Goal) -> None:
        """Send goal angles and current bounds; nothing while torque was not switched on here.

        Raises:
            ServoError: the port is gone, or a servo's bus watchdog has stopped it.
        """
        torque = self._torque
        if torque is None or torque.goals is None:
            return
        torque.ask_watchdog_if_quiet(time.monotonic())
        servos, mode, q, current = self._settings, self._mode, goal.q, goal.current
        values = [
            joint.goal(servos, mode, q[joint.finger], current[joint.finger])
            for joint in self._joints
        ]
        if torque.goals.send(values) == COMM_SUCCESS:
            torque.heard(time.monotonic())

    def set_torque(self, on: bool) -> None:
        """Switch torque and make sure of it; on: from the present angle, with no current yet.

        Raises:
            ServoError: it could not be done or not be verified; on → off then is tried.
        """
        if self._torque is None:
            raise ServoError("servos: not connected")
        if on:
            self._torque.on()
        else:
            self._torque.off()

    # --- the end -----------------------------------------------------------------------------

    def counters(self) -> dict[str, int]:
        """Exchanges that went wrong since connect, by kind."""
        handler = self._handler
        return {
            "timeouts": handler.timeouts,
            "crc": handler.crc_errors,
            "torn": handler.torn,
            "retries": self._retries,
            "skipped_bytes": handler.skipped_bytes,
            "late": handler.late,
            "alerts": self._alerts,
        }

    def close(self) -> None:
        """Torque off and verified as far as the bus allows, then close. Never raises.

        A servo whose torque another program switched on is left as it was found.
        """
        line, torque = self._line, self._torque
        self._line = self._present = self._health = self._torque = None
        if line is None or torque is None:
            return
        try:
            if torque.goals is not None:
                torque.off()
        except PortGone:
            _log.error("servos: the port went away with torque on; their bus watchdog stops them")
        except Exception as error:
            _log.error("servos: torque off is not certain: %s", error)
        with contextlib.suppress(Exception):
            line.port.closePort()
