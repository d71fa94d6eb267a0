"""The hand's joints through dynamixel-sdk: check at connect, one read and one write a tick.

Current, velocity, position and the alert bit of all servos come in one fast sync read (sync read
where a firmware is older); goal current and goal position go in one sync write, side by side
through indirect addresses, which live in RAM and are set whenever torque goes on; in current and
position mode there is one goal and no indirection. What a servo must be set to in EEPROM is checked
and never changed here.
"""

from __future__ import annotations

import contextlib
import logging
import math
import struct
import time

from dynamixel_sdk.group_sync_write import GroupSyncWrite
from dynamixel_sdk.robotis_def import COMM_RX_CORRUPT, COMM_SUCCESS

from daemon.clock import Clock
from daemon.records import FINGERS, Goal, Reading
from daemon.servos import registers as reg
from daemon.servos.base import ServoError
from daemon.servos.checks import check_angle, check_latency
from daemon.servos.examine import examine, servo_name
from daemon.servos.line import ServoLine
from daemon.servos.models import ServoModel, by_name
from daemon.servos.modes import current_toward, mode_number
from daemon.servos.packets import GroupRead, PacketHandler
from daemon.servos.port import PortGone, SerialPort
from daemon.servos.units import JointScale
from daemon.settings import Settings

_log = logging.getLogger(__name__)

_PRESENT = struct.Struct("<hii")  # current, velocity, position
_GOAL = struct.Struct("<hi")  # current, position
_CURRENT = struct.Struct("<h")
_POSITION = struct.Struct("<i")
_GOAL_BYTES = (
    reg.GOAL_CURRENT,
    reg.GOAL_CURRENT + 1,
    reg.GOAL_POSITION,
    reg.GOAL_POSITION + 1,
    reg.GOAL_POSITION + 2,
    reg.GOAL_POSITION + 3,
)


class DynamixelServos:
    """Servo backend over a serial port; see :class:`daemon.servos.base.Servos`.

    One thread, one owner. ``notices`` holds what connect found worth saying and not wrong.
    """

    def __init__(self, settings: Settings, clock: Clock) -> None:
        servos = settings.servos
        self.notices: tuple[str, ...] = ()
        self._clock = clock
        self._settings = servos
        self._profile = settings
        self._hand = settings.hand
        self._mode = mode_number(servos)
        self._fingers = [FINGERS.index(finger) for finger in settings.scene.fingers]
        self._ids = {finger: servos.ids[finger] for finger in self._fingers}
        self._handler = PacketHandler()
        self._line: ServoLine | None = None
        self._fast = False
        self._torque = False
        self._was_quiet = False  # the bus watchdog may have stopped the servos
        self._last_sent = 0.0  # time.monotonic() of the last packet the servos must have heard
        self._quiet_limit = math.inf  # s without a packet after which the watchdog is asked
        self._retries = 0
        self._alerts = 0
        self._present: GroupRead | None = None
        self._goals: GroupSyncWrite | None = None
        self._scales: dict[int, JointScale] = {}
        self._bounds: dict[int, int] = {}  # greatest goal current in counts
        self._ends: dict[int, tuple[int, int]] = {}  # position limits in counts
        self._q = [0.0, 0.0]  # of the last good reading [rad, rad/s]
        self._dq = [0.0, 0.0]

    # --- connect -----------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the port, again if it is open, and check every servo; changes nothing in them.

        Raises:
            ServoError: all that is wrong, one line each. The port is closed again.
        """
        self.close()
        try:
            model = by_name(self._settings.model)
        except KeyError as error:
            raise ServoError(f"servos.model: {error.args[0]}") from None
        port = SerialPort(self._settings.port, self._settings.baud, self._settings.reply_timeout)
        port.openPort()
        line = ServoLine(port, self._handler)
        self._prepare(port, model)
        try:
            self._check(line, model)
        except BaseException:
            port.closePort()
            self._present = None
            raise
        self._line = line

    def _check(self, line: ServoLine, model: ServoModel) -> None:
        port = line.port
        latency = check_latency(port.port_name, port.latency_timer(), port.reply_timeout)
        errors, notices = list(latency.errors), list(latency.notices)
        found = examine(line, self._profile, model)
        silent = [each.finger for each in found if not each.answers]
        self._fast = True
        for each in found:
            errors += each.findings.errors
            notices += each.findings.notices
            if each.table:
                self._fast = self._fast and model.fast_read(each.table[reg.FIRMWARE_VERSION])
                limit = self._settings.current_limit[each.finger]
                counts = self._scales[each.finger].bound_counts(limit)
                self._bounds[each.finger] = min(each.word(reg.CURRENT_LIMIT), counts)
                ends = each.long(reg.MIN_POSITION_LIMIT), each.long(reg.MAX_POSITION_LIMIT)
                self._ends[each.finger] = ends
        if silent and len(silent) == len(self._ids):
            raise ServoError(
                f"{port.port_name}: no servo answers at {port.baudrate} baud (IDs "
                f"{', '.join(map(str, self._ids.values()))}): check power and wiring; "
                "`softfinger doctor` looks for them at every rate"
            )
        for finger in silent:
            errors.append(
                f"{self._name(finger)}: no answer at {port.baudrate} baud: check its cable and ID; "
                "`softfinger doctor` looks for it at every rate"
            )
        if errors:
            raise ServoError("\n".join(errors))
        strayed = self._strayed({each.finger: each.position for each in found})
        notices += [f"{text}; torque is refused there" for text in strayed if text]
        self.notices = tuple(notices)
        for notice in notices:
            _log.warning(notice)

    def _prepare(self, port: SerialPort, model: ServoModel) -> None:
        self._scales = {
            finger: JointScale.of(self._settings, finger, model) for finger in self._fingers
        }
        span = reg.PRESENT_POSITION + 4 - reg.PRESENT_CURRENT
        ids = list(self._ids.values())
        self._present = GroupRead(port, self._handler, reg.PRESENT_CURRENT, span, ids)
        self._goals = None
        self._torque = False

    # --- the tick ----------------------------------------------------------------------------

    def read(self, reading: Reading) -> None:
        """Fill ``reading`` from one group read; a damaged reply is asked for once more in time.

        Raises:
            ServoError: the port is gone.
        """
        present = self._present
        if present is None:
            raise ServoError("servos: not connected")
        reading.seq += 1
        begin = time.monotonic()
        result = present.exchange(self._fast)
        if result == COMM_RX_CORRUPT:
            # Once more, with what is left of the first exchange's deadline.
            port = self._open_line().port
            port.not_after = port.deadline
            if time.monotonic() < port.deadline:
                self._retries += 1
                result = present.exchange(self._fast)
            port.not_after = math.inf
        reading.valid = result == COMM_SUCCESS
        if not reading.valid:
            return
        reading.t = self._clock.now()
        self._sent(begin)
        alert = 0
        for finger, servo_id in self._ids.items():
            current, velocity, position = _PRESENT.unpack(present.data_dict[servo_id])
            scale = self._scales[finger]
            reading.q[finger] = self._q[finger] = scale.angle(position)
            reading.dq[finger] = self._dq[finger] = scale.rate(velocity)
            reading.current[finger] = scale.amperes(current)
            if present.errors[servo_id] & 0x80:
                alert |= 1 << finger
        if alert:
            self._alerts += 1
        reading.alert = alert

    def write(self, goal: Goal) -> None:
        """Send goal angles and current bounds; nothing while torque was not switched on here.

        Raises:
            ServoError: the port is gone, or a servo's bus watchdog has stopped it.
        """
        goals = self._goals
        if goals is None or not self._torque:
            return
        if self._was_quiet or time.monotonic() - self._last_sent > self._quiet_limit:
            self._check_watchdog()
        for finger, servo_id in self._ids.items():
            goals.changeParam(servo_id, self._packed(finger, goal.q[finger], goal.current[finger]))
        if goals.txPacket() == COMM_SUCCESS:
            self._last_sent = time.monotonic()

    def _sent(self, t: float) -> None:
        """A packet went out at ``t``; note whether the line was quiet before for too long."""
        if t - self._last_sent > self._quiet_limit:
            self._was_quiet = True
        self._last_sent = t

    def _packed(self, finger: int, q: float, current: float) -> bytes:
        """One servo's goal as its registers take it in this mode."""
        scale = self._scales[finger]
        if self._mode == reg.CURRENT_BASED_POSITION_MODE:
            bound = min(scale.bound_counts(current), self._bounds[finger])
            return _GOAL.pack(bound, scale.position_counts(q))
        if self._mode == reg.POSITION_MODE:
            low, high = self._ends[finger]
            return _POSITION.pack(min(max(scale.position_counts(q), low), high))
        bound = min(scale.bound_counts(current), self._bounds[finger])
        wanted = current_toward(self._settings, q, current, self._q[finger], self._dq[finger])
        return _CURRENT.pack(min(max(scale.current_counts(wanted), -bound), bound))

    # --- torque ------------------------------------------------------------------------------

    def set_torque(self, on: bool) -> None:
        """Switch torque and make sure of it; on: from the present angle, with no current yet.

        Raises:
            ServoError: it could not be done or not be verified; on → off then is tried.
        """
        line = self._open_line()
        if not on:
            self._store(reg.TORQUE_ENABLE, "<B", dict.fromkeys(self._ids, 0), "torque off")
            self._torque = False
            self._store(reg.BUS_WATCHDOG, "<B", dict.fromkeys(self._ids, 0), "watchdog off")
            return
        self._refuse_hardware_errors(line)
        try:
            self._switch_on(line)
        except ServoError:
            with contextlib.suppress(ServoError):
                self._store(reg.TORQUE_ENABLE, "<B", dict.fromkeys(self._ids, 0), "torque off")
            raise

    def _switch_on(self, line: ServoLine) -> None:
        each = self._ids
        # Writing 0 ends a watchdog's stop, in which goals are read-only.
        self._store(reg.BUS_WATCHDOG, "<B", dict.fromkeys(each, 0), "watchdog cleared")
        self._choose_goals(line)
        if self._mode != reg.POSITION_MODE:
            self._store(reg.GOAL_CURRENT, "<h", dict.fromkeys(each, 0), "goal current")
        positions = self._positions(line)
        strayed = [text for text in self._strayed(positions) if text]
        if strayed:
            raise ServoError("\n".join(strayed))
        if self._mode != reg.CURRENT_MODE:
            self._store(reg.GOAL_POSITION, "<i", positions, "goal position")
        self._store(reg.TORQUE_ENABLE, "<B", dict.fromkeys(each, 1), "torque on")
        self._quiet_limit = math.inf
        if self._settings.watchdog > 0.0:
            ticks = math.ceil(self._settings.watchdog / reg.WATCHDOG_UNIT - 1e-9)
            ticks = min(max(ticks, 1), reg.WATCHDOG_MAX)
            self._quiet_limit = 0.8 * ticks * reg.WATCHDOG_UNIT
            self._store(reg.BUS_WATCHDOG, "<B", dict.fromkeys(each, ticks), "watchdog armed")
        self._last_sent = time.monotonic()
        self._was_quiet = False
        self._torque = True

    def _choose_goals(self, line: ServoLine) -> None:
        """The one sync write of a tick: goal current, goal position, or both side by side."""
        if self._mode == reg.CURRENT_BASED_POSITION_MODE:
            self._goals = self._map_goals(line)
        elif self._mode == reg.CURRENT_MODE:
            self._goals = self._group(line, reg.GOAL_CURRENT, _CURRENT.size)
        else:
            self._goals = self._group(line, reg.GOAL_POSITION, _POSITION.size)

    def _group(self, line: ServoLine, address: int, size: int) -> GroupSyncWrite:
        goals = GroupSyncWrite(line.port, self._handler, address, size)
        for servo_id in self._ids.values():
            goals.addParam(servo_id, bytes(size))
        return goals

    def _map_goals(self, line: ServoLine) -> GroupSyncWrite:
        """Put goal current and goal position side by side in the indirect data."""
        model = by_name(self._settings.model)
        starts = set()
        for finger, servo_id in self._ids.items():
            firmware = line.read(servo_id, reg.FIRMWARE_VERSION, 1)
            if firmware is None:
                raise ServoError(f"{self._name(finger)}: no answer")
            address, data, _ = model.indirect_blocks(firmware[0])[0]
            starts.add((address, data))
        if len(starts) > 1:
            raise ServoError(
                "servos: their firmwares place indirect data differently: bring both to the same "
                "version"
            )
        address, data = starts.pop()
        pointers = struct.pack(f"<{len(_GOAL_BYTES)}H", *_GOAL_BYTES)
        self._store_bytes(address, dict.fromkeys(self._ids, pointers), "indirect addresses")
        return self._group(line, data, _GOAL.size)

    def _strayed(self, positions: dict[int, int]) -> list[str]:
        """What is wrong with the joints' angles; torque there would swing them back at once."""
        hand = self._hand
        return [
            check_angle(
                self._name(finger),
                self._scales[finger].angle(counts),
                hand.q_min[finger],
                hand.q_max[finger],
            )
            for finger, counts in positions.items()
        ]

    def _positions(self, line: ServoLine) -> dict[int, int]:
        positions = {}
        for finger, servo_id in self._ids.items():
            raw = line.read(servo_id, reg.PRESENT_POSITION, 4)
            if raw is None:
                raise ServoError(f"{self._name(finger)}: position not read")
            positions[finger] = int.from_bytes(raw, "little", signed=True)
        return positions

    def _refuse_hardware_errors(self, line: ServoLine) -> None:
        lines = []
        for finger, servo_id in self._ids.items():
            name = self._name(finger)
            raw = line.read(servo_id, reg.HARDWARE_ERROR_STATUS, 1)
            if raw is None:
                lines.append(f"{name}: no answer: check its cable and power")
            elif raw[0]:
                lines.append(
                    f"{name}: hardware error: {reg.hardware_error_names(raw[0])}: remove the "
                    "cause, then `softfinger doctor --fix` reboots it"
                )
        if lines:
            raise ServoError("\n".join(lines))

    def _check_watchdog(self) -> None:
        line = self._open_line()
        for finger, servo_id in self._ids.items():
            raw = line.read(servo_id, reg.BUS_WATCHDOG, 1)
            if raw is not None and raw[0] == reg.WATCHDOG_ERROR:
                raise ServoError(
                    f"{self._name(finger)}: its bus watchdog stopped it, since no packet "
                    "came in time: disarm, then arm"
                )
        self._was_quiet = False
        self._last_sent = time.monotonic()

    # --- exchanges outside the tick ----------------------------------------------------------

    def _open_line(self) -> ServoLine:
        if self._line is None:
            raise ServoError("servos: not connected")
        return self._line

    def _name(self, finger: int) -> str:
        return servo_name(self._ids[finger], finger)

    def _store(self, address: int, form: str, values: dict[int, int], what: str) -> None:
        packed = {finger: struct.pack(form, value) for finger, value in values.items()}
        self._store_bytes(address, packed, what)

    def _store_bytes(self, address: int, values: dict[int, bytes], what: str) -> None:
        by_id = {self._ids[finger]: data for finger, data in values.items()}
        failed = self._open_line().store(address, by_id)
        if failed:
            names = ", ".join(
                self._name(finger) for finger in values if self._ids[finger] in failed
            )
            raise ServoError(f"{names}: {what} could not be set or not be verified")

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
            "alerts": self._alerts,
        }

    def close(self) -> None:
        """Torque off and verified as far as the bus allows, then close. Never raises.

        A servo whose torque another program switched on is left as it was found.
        """
        line = self._line
        if line is None:
            return
        try:
            if self._torque:
                self.set_torque(False)
        except PortGone:
            _log.error("servos: the port went away with torque on; their bus watchdog stops them")
        except Exception as error:
            _log.error("servos: torque off is not certain: %s", error)
        self._torque = False
        self._line = None
        self._present = None
        with contextlib.suppress(Exception):
            line.port.closePort()
