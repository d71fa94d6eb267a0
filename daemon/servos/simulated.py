"""Simulate the servos of the hand in the daemon process, with the resolution of real servos."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from softfinger.daemon.clock import Clock
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.checks import check_model
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.servos.joint import Joint
from softfinger.daemon.types import Goal, Reading

if TYPE_CHECKING:
    from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand

_HEALTH_INTERVAL = 0.25  # time between temperature and supply voltage readings [s]
_OVERLOAD_TIME = 2.0  # time at maximum current after which an overload error occurs [s]


class SimulatedServos:
    """Servos of a simulated hand, with the resolution of the configured model.

    Every exchange first advances the hand to the clock time. If no exchange occurs within the
    watchdog time, the watchdog switches torque off. Only :meth:`torque_on` switches torque on
    again.
    """

    def __init__(self, settings: Settings, hand: SimulatedHand, clock: Clock) -> None:
        self._settings = settings.servos
        self._mode = reg.MODE_NUMBERS[settings.servos.mode]
        self._model = by_name(settings.servos.model)
        self._hand = hand
        self._clock = clock
        self._joints = []
        for i in settings.scene.indices:
            joint = Joint.of(settings.servos, i, self._model)
            joint.bound = joint.scale.bound_counts(settings.servos.current_limit[i])
            self._joints.append(joint)
        self._watchdog = settings.servos.watchdog or math.inf
        self._connected = False
        self._torque = False
        self._tripped = False  # True if the watchdog has switched torque off
        self._trips = 0
        self._last = -math.inf  # time of the last exchange [s]
        self._goal_q = [0.0, 0.0]
        self._goal_current = [0.0, 0.0]
        self._errors = [0, 0]  # hardware error bits
        self._pressed = [0.0, 0.0]  # time for which each motor has drawn its maximum current [s]
        self._health_read = -math.inf

    def connect(self) -> None:
        """Connect with torque off. Raises ServoError if the model does not support the mode."""
        unfit = check_model("servos.model", self._model, self._mode)
        if unfit is not None:
            raise ServoError(str(unfit))
        self._connected = True
        self._exchange()
        self._switch(False)

    def read(self, reading: Reading) -> None:
        """Update ``reading`` with angle, velocity and current, rounded to servo counts."""
        if not self._connected:
            reading.valid = False
            return
        reading.t = self._exchange()
        # Convert the arrays to lists, because reading single elements of an array is slow.
        q, dq = self._hand.q.tolist(), self._hand.dq.tolist()
        for joint in self._joints:
            f, scale = joint.finger, joint.scale
            reading.q[f] = joint.q = scale.angle(scale.position_counts(q[f]))
            reading.dq[f] = joint.dq = scale.rate(scale.velocity_counts(dq[f]))
            current = self._hand.measured_current(f)
            reading.current[f] = scale.amperes(scale.current_counts(current))
        if reading.t - self._health_read >= _HEALTH_INTERVAL:
            self._read_health(reading)
        reading.seq += 1
        reading.valid = True

    def _read_health(self, reading: Reading) -> None:
        passed = min(reading.t - self._health_read, _HEALTH_INTERVAL * 2.0)
        self._health_read = reading.t
        currents = [abs(each) for each in self._hand.current.tolist()]
        voltage = self._model.supply - reg.SAG * sum(currents)
        reading.alert = 0
        for f in (joint.finger for joint in self._joints):
            heat, current = self._hand.servo_heat[f], currents[f]
            heat.step(current, passed)
            reading.temperature[f] = float(round(heat.sensed))
            reading.voltage[f] = round(voltage / reg.VOLTAGE_UNIT) * reg.VOLTAGE_UNIT
            limit = min(self._settings.current_limit[f], self._model.stall_current)
            pressed = self._torque and current >= 0.99 * limit
            self._pressed[f] = self._pressed[f] + passed if pressed else 0.0
            hot = heat.sensed > self._model.temperature_limit
            over = self._pressed[f] > _OVERLOAD_TIME
            errors = hot << reg.OVERHEATING | over << reg.OVERLOAD
            # A servo keeps an error until a reboot; a simulated servo, until torque is off.
            errors |= self._errors[f] if self._torque else 0
            self._errors[f] = errors
            reading.hardware[f] = errors
            reading.alert |= bool(errors) << f
        if reading.alert and self._torque:
            self._drive()

    def torque_on(self) -> None:
        """Switch torque on with zero motor current. The goal is the current position."""
        if not self._connected:
            raise ServoError("the simulated servos are not connected")
        self._exchange()
        for joint in self._joints:
            f, scale = joint.finger, joint.scale
            self._goal_q[f] = scale.angle(scale.position_counts(float(self._hand.q[f])))
            self._goal_current[f] = 0.0
        self._switch(True)

    def torque_off(self, reading: Reading) -> bool:
        """Switch torque off, read the servos and return True."""
        if not self._connected:
            raise ServoError("the simulated servos are not connected")
        self._exchange()
        self._switch(False)
        self.read(reading)
        return True

    def write(self, goal: Goal) -> None:
        """Set each servo's goal angle and current limit, rounded to register counts."""
        if not self._connected:
            return
        self._exchange()
        if self._tripped:
            raise ServoError(
                "the bus watchdog stopped the simulated servos because no packet arrived within "
                "servos.watchdog: send `clear`, then `arm`"
            )
        for joint in self._joints:
            f, scale = joint.finger, joint.scale
            counts, position = joint.goal(self._settings, self._mode, goal.q[f], goal.current[f])
            signed = self._mode == reg.CURRENT_MODE
            self._goal_q[f] = scale.angle(position)
            self._goal_current[f] = scale.amperes(counts) if signed else counts * scale.current_unit
        self._drive()

    def counters(self) -> dict[str, int]:
        """Return the counters. Only ``watchdog``, the number of watchdog stops, can exceed 0."""
        return {"timeouts": 0, "crc": 0, "watchdog": self._trips}

    def close(self) -> None:
        """Switch torque off."""
        if self._connected:
            self._exchange()
            self._switch(False)
            self._connected = False

    def _exchange(self) -> float:
        """Advance the hand to the current time, then check and restart the watchdog."""
        now = self._clock.now()
        if self._torque and now > self._last + self._watchdog:
            self._torque = False
            self._tripped = True
            self._trips += 1
        self._hand.advance(now)
        self._last = now
        if self._torque:
            self._hand.hold_torque_until(now + self._watchdog)
        return now

    def _switch(self, on: bool) -> None:
        self._torque = on
        self._tripped = False
        self._hand.hold_torque_until(self._last + self._watchdog if on else math.inf)
        self._drive()

    def _drive(self) -> None:
        for f in (joint.finger for joint in self._joints):
            # Like a real servo, apply torque only if no hardware error has occurred.
            torque = self._torque and not self._errors[f]
            self._hand.drive(f, self._mode, torque, self._goal_q[f], self._goal_current[f])
