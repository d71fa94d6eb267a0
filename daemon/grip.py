"""The grip laws: forces and the object's angle to joint torques, once both tips touch.

Holds the laws and their memory; modes and limits are elsewhere. Two fingers have one motion that
changes the grip (both close) and one that moves the object (q1 + δ, q2 − δ), so every law has two
parts:

1. *grip*: a bias torque, lever times force wanted, with what the joints' friction takes on the way;
   a proportional and an integral part on the force felt; damping to the stiffness of the tips;
2. *steering*, the 'serial two-phased' law of the soft-fingertip literature: the object's angle
   error is integrated and fed antisymmetrically to the joints' goal, joint PD follows that goal.
   The object turns by φ̇ = turn1 q̇1 − turn2 q̇2, against the fingers' own sense.

``control.law`` says where the levers come from: ``two_phase`` takes the force's arm about the
pivot, ``energy`` the gradient of the tables' energy along the rolling increments, in which the
tips' moments and shear forces are counted, too. ``position`` commands angles and no torques; it is
there to be compared with.
"""

from __future__ import annotations

import math

from daemon.prediction import Held
from daemon.records import Contact, ObjectPose, Reading
from daemon.reference import Reference
from daemon.settings import Settings
from daemon.slip import SlipWatch

_INTEGRAL_SHARE = 0.3  # the integral's bound, as a share of the force wanted
_SHARE_BANDWIDTH = 2.0  # Hz of the integral of the tips' difference
_SHARE_ANGLE = 3e-3  # rad that the object may turn by that
_QUIET = 3.0  # standard deviations of the angle that the joints at rest don't follow
_STIFFNESS_MIN = 100.0  # N/m, below which a contact is too light to scale by


class Grip:
    """Force control from the tactile estimate, and steering by the antisymmetric joint motion."""

    def __init__(self, settings: Settings, fingers: list[int]) -> None:
        """``fingers`` take part, left first."""
        self._hand = settings.hand
        self._law = law = settings.control
        self._fingers = fingers
        self._dt = 1.0 / settings.loop.rate
        self._by_energy = law.law == "energy" and len(fingers) == 2
        # Joints that are held to angles give whatever torque that takes: it tells no load.
        self._watches = law.law != "position" and len(fingers) == 2
        self._torque_max = settings.safety.current_max * law.torque_constant  # N·m
        self.joint_stiffness = law.joint_stiffness
        self.force = Reference(self._dt, law.smooth_time)
        self.angle = Reference(self._dt, law.smooth_time)
        self.steering = False
        self.holding = False  # nothing but loads moves the joints
        self.slip = SlipWatch(settings)
        self._shift = 0.0  # of the offset, to share the force out between the tips [rad]
        self._closing_friction = 0.0  # share of the joints' friction that is given for closing
        self._force_rate = 0.0  # N/s
        self.force_target = 0.0  # N that was asked for
        self._integral = 0.0  # N
        self._push = 0.0  # N that the joints give, both laws' parts together
        self._lean = 0.0  # rad/s of the offset that turns the object
        self._rest = math.exp(
            -2.0 * self._dt / law.smooth_time
        )  # of it, a tick later without frames
        self._closed = 0.0  # goal of (q1 + q2)/2 in pure position control [rad]
        self._offset = 0.0  # goal of (q1 − q2)/2 [rad]
        self._torques = [0.0, 0.0]

    @property
    def angle_target(self) -> float:
        """The object's angle that is gone to [rad]."""
        return self.angle.target

    @property
    def turning_on(self) -> float:
        """The angle at which turning could stop, over the present one; 0 while it goes upright."""
        angle, speed = self.angle.value, self.angle.speed
        if speed * angle <= 0.0:
            return 0.0
        return 1.0 + min(speed * self._law.smooth_time / angle, 1.0)

    def start(self, held: Held, felt: float, force: float) -> None:
        """Take over from the approach with ``felt`` N on the tips."""
        self.slip.forget()
        self.force.reset(felt)
        self._integral = 0.0
        self._offset = 0.5 * (held.q[0] - held.q[1])
        self._closed = 0.5 * (held.q[0] + held.q[1])
        self.steering = False
        self._shift = 0.0
        self.retarget(force)

    def retarget(self, force: float) -> None:
        """Go to another grip force [N]."""
        self.force_target = self.force.target = force
        least = max(0.1 * force, 0.5 * self._law.grip_raise_max)
        self._force_rate = max(abs(force - self.force.value), least) / self._law.force_time

    def steer(self, present: float, angle: float) -> None:
        """Turn the object from its ``present`` angle to ``angle`` [rad], and keep it there."""
        if not self.steering:
            self.angle.reset(present)
        self.angle.target = angle
        self.steering = True

    def torques(
        self, reading: Reading, contacts: list[Contact], pose: ObjectPose, held: Held
    ) -> list[float]:
        """Joint torques [N·m], positive closing; pairs, of which the fingers' places are filled."""
        wanted = self._wanted(contacts, held)
        self._push = wanted + self._correction(wanted, contacts)
        if len(self._fingers) == 1:
            return self._press(self.force.speed, reading, held)
        self._lean = lean = self._steer(pose, held) if self.steering else 0.0
        self._share_out(held)
        close = self._closing(self.force.speed, lean, held)
        self._closing_friction = min(max(close / self._law.friction_speed, -1.0), 1.0)
        return self._give(close, lean, reading, held)

    def coast(self, reading: Reading, held: Held) -> list[float]:
        """Joint torques [N·m] while frames are late: the push stays, and turning comes to rest.

        Joints are read all the same. Torques that stayed as they are would turn the object on, to
        the end of what damps and steers it.
        """
        if len(self._fingers) == 1:
            return self._press(0.0, reading, held)
        self._lean *= self._rest
        self._offset += self._lean * self._dt
        return self._give(self._closing(0.0, self._lean, held), self._lean, reading, held)

    def _give(self, close: float, lean: float, reading: Reading, held: Held) -> list[float]:
        """Torques of two fingers at rates [rad/s] of closing and leaning that are wanted."""
        torques, push = self._torques, self._push
        dq1, dq2 = reading.dq
        arm = 0.5 * (held.arm[0] + held.arm[1])
        stiffness = _mean_stiffness(held)
        calm = self._damping(stiffness * arm * arm) * (close - 0.5 * (dq1 + dq2))
        error = self._offset - 0.5 * (held.q[0] - held.q[1])
        turn = self.joint_stiffness * error
        turn += self._damping(self.joint_stiffness) * (lean - 0.5 * (dq1 - dq2))
        lever1, lever2 = held.lever if self._by_energy else held.arm
        torques[0] = lever1 * push + calm + turn + self._friction(close + lean)
        torques[1] = lever2 * push + calm - turn + self._friction(close - lean)
        return torques

    def angles(self, contacts: list[Contact], pose: ObjectPose, held: Held) -> list[float]:
        """Joint goals [rad] of pure position control: both references moved into angles.

        What it can't do is why the other laws exist: its finest step is one count of the joints.
        """
        law = self._law
        wanted = self._wanted(contacts, held)
        error = wanted - 0.5 * (contacts[0].force + contacts[1].force)
        arm = 0.5 * (held.arm[0] + held.arm[1])
        lean = self._steer(pose, held) if self.steering else 0.0
        way = 2.0 * math.pi * law.force_bandwidth * error / (_mean_stiffness(held) * arm)
        self._closed += (self._closing(self.force.speed, lean, held) + way) * self._dt
        return [self._closed + self._offset, self._closed - self._offset]

    def _wanted(self, contacts: list[Contact], held: Held) -> float:
        """The force [N] at this tick: the target, raised where the tips would be near slipping."""
        if self._watches:
            self.force.target = self.slip.step(
                held, contacts, self.force_target, self.holding, self._closing_friction
            )
        return self.force.step(self._force_rate)

    def _closing(self, rate: float, lean: float, held: Held) -> float:
        """Closing [rad/s] for a ``rate`` [N/s] of the force, what turning takes counted in."""
        arm1, arm2 = held.arm
        way = 2.0 * rate / _mean_stiffness(held)
        way -= (arm1 - arm2 + held.slide * (held.turn[0] + held.turn[1])) * lean
        return way / (arm1 + arm2)

    def _press(self, rate: float, reading: Reading, held: Held) -> list[float]:
        """One finger on an object that stands by itself, its force to change by ``rate`` [N/s]."""
        index = self._fingers[0]
        arm = held.arm[index]
        stiffness = max(held.stiffness[index], _STIFFNESS_MIN)
        close = rate / (stiffness * arm)
        calm = self._damping(stiffness * arm * arm) * (close - reading.dq[index])
        self._torques[index] = arm * self._push + calm + self._friction(close)
        return self._torques

    def _correction(self, wanted: float, contacts: list[Contact]) -> float:
        """What the force felt asks for beyond the feed-forward [N]."""
        law = self._law
        felt = 0.0
        full = False  # beyond what the servos may give, more error must not be stored
        for index in self._fingers:
            felt += contacts[index].force
            full = full or abs(self._torques[index]) >= self._torque_max
        error = wanted - felt / len(self._fingers)
        proportional = law.force_gain * error
        if not full or error < 0.0:
            integral = self._integral + 2.0 * math.pi * law.force_bandwidth * error * self._dt
            bound = _INTEGRAL_SHARE * self.force.target
            self._integral = min(max(integral, -bound), bound)
        return proportional + self._integral

    def _steer(self, pose: ObjectPose, held: Held) -> float:
        """Move the antisymmetric goal; returns its rate [rad/s]."""
        law = self._law
        angle = self.angle.step(law.rotate_speed)
        turn = max(held.turn[0] + held.turn[1], 0.1)
        lean = self.angle.speed / turn
        if pose.valid:
            error = angle - pose.angle
            if self.angle.arrived:
                error = _beyond(error, _QUIET * held.angle_std)
            self._offset += 2.0 * math.pi * law.rotate_bandwidth * error / turn * self._dt
        self._offset += lean * self._dt
        return lean

    def _share_out(self, held: Held) -> None:
        """Take out what the object's rubbing on the table has put between the tips.

        The force law holds their mean; friction may keep the object where one tip is pressed more.
        Both fingers then shift sideways by a little, less than the object's angle is held to.
        """
        if not self.force.arrived or (self.steering and not self.angle.arrived):
            return
        arm = 0.5 * (held.arm[0] + held.arm[1])
        off = 0.5 * (held.normal[0] - held.normal[1]) / (_mean_stiffness(held) * arm)
        most = _SHARE_ANGLE / max(held.turn[0] + held.turn[1], 0.1)
        shift = self._shift - 2.0 * math.pi * _SHARE_BANDWIDTH * off * self._dt
        shift = min(max(shift, -most), most)
        self._offset += shift - self._shift
        self._shift = shift

    def _damping(self, stiffness: float) -> float:
        """N·m·s/rad that damp the joint's inertia on ``stiffness`` [N·m/rad]."""
        law = self._law
        return 2.0 * law.damping_ratio * math.sqrt(stiffness * law.joint_inertia)

    def _friction(self, rate: float) -> float:
        """What the joint's friction takes [N·m] at the ``rate`` [rad/s] that is wanted."""
        law = self._law
        return law.joint_friction * min(max(rate / law.friction_speed, -1.0), 1.0)


def _mean_stiffness(held: Held) -> float:
    return max(0.5 * (held.stiffness[0] + held.stiffness[1]), _STIFFNESS_MIN)


def _beyond(error: float, noise: float) -> float:
    """What of an error is more than noise: at rest the joints shall not follow that."""
    return error - min(max(error, -noise), noise)
