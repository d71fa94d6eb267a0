"""Every limit of the hand in one table, ``ROWS``: name, what is judged, what follows, setting.

- ``warn``: told once on ``hand/event``, again only after it has been over for a while.
- ``limit``: the goal is changed before it reaches the bus; ``status`` counts the ticks.
- ``fault``: torque off, latched until ``clear``, which is refused as long as the cause stands.

``softfinger limits`` prints the table with a profile's numbers. A row's name is the ``kind`` of its
events and the ``fault_name`` of ``hand/state``. How each is judged stands in `safety.limit_checks`;
when, and how a warning is told once, in `safety.safety`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from softfinger.daemon.safety import limit_checks as by
from softfinger.daemon.safety.limit_checks import View
from softfinger.daemon.types import State

Check = Callable[[View, State, float], str]

_NEAR = 0.9  # of a fault's limit: warned from there on


@dataclass(frozen=True, slots=True)
class Row:
    """One limit. ``check`` is None where it is met elsewhere: in `Safety.bound`, or on the bus."""

    name: str
    judged: str
    level: Literal["warn", "limit", "fault"]
    keys: tuple[str, ...] = ()
    check: Check | None = None
    needs: Literal["", "servos", "sensors"] = ""
    at_once: bool = False  # judged at every tick; the others take turns, one a tick
    lasts: float | str = 0.0  # s that it must stand, or the setting that says so
    share: float = 1.0  # of the bound
    gripping: bool = False  # stands only while the hand grips


_S: Literal["servos"] = "servos"
_T: Literal["sensors"] = "sensors"

ROWS: tuple[Row, ...] = (
    Row("servos.bus", "the port is there, the servos obey and were not stopped by their watchdog",
        "fault", ("servos.watchdog",)),
    Row("servos.silent", "age of the last good servo reading; an error for answer is none",
        "fault", ("servos.fault_after",), by.servos_silent, _S, True),
    Row("servos.frozen", "servo whose own clock stands still for 0.1 s: its readings are old",
        "fault", (), by.servo_frozen, _S, True),
    Row("servos.alert", "hardware error that a servo reports", "fault", (),
        by.servo_alert, _S, True),
    Row("servos.temperature", "temperature of a servo", "warn", ("safety.temperature_warn",),
        by.temperature_warn, _S),
    Row("servos.temperature", "temperature of a servo", "fault", ("safety.temperature_max",),
        by.temperature, _S),
    Row("servos.voltage", "supply of a servo", "fault",
        ("safety.voltage_min", "safety.voltage_max"), by.voltage, _S, lasts=0.1),
    Row("joint.angle", "joint angle, 0.1 rad past its limits", "fault",
        ("hand.q_min", "hand.q_max"), by.joint_angle, _S, True),
    Row("joint.velocity", "joint velocity", "fault", ("safety.velocity_max",),
        by.joint_velocity, _S, True),
    Row("joint.jump", "joint angle against its velocity, 0.1 rad within 0.1 s, and against the "
        "greatest velocity", "fault", ("safety.velocity_max",), by.joint_jump, _S, True),
    Row("joint.dead", "joint that stands 0.05 rad off its goal without current for 0.05 s",
        "fault", (), by.joint_dead, _S, lasts=0.05),
    Row("joint.current", "measured current", "fault", ("safety.current_fault",),
        by.joint_current, _S, True, lasts=0.1),
    Row("joint.stall", "current at its bound, off the goal, and standing", "fault",
        ("safety.stall_error", "safety.stall_time"), by.joint_stall, _S, lasts="stall_time"),
    Row("joint.strained", "grip that takes all the current there may be", "warn",
        ("safety.current_max",), by.joint_strained, _S, lasts=1.0),
    Row("torque.off", "torque off not confirmed within half the watchdog's time: the bus is kept "
        "silent until the watchdog stops the servos", "fault", ("servos.watchdog",)),
    Row("goal.lost", "servo that for 0.05 s holds none of the goals sent to it", "fault", (),
        by.goal_lost, _S, True),
    Row("goal.number", "goal that is no number: it is not sent", "fault", (),
        by.no_number, _S, True),
    Row("goal.angle", "goal angle", "limit", ("hand.q_min", "hand.q_max")),
    Row("goal.current", "goal current", "limit", ("safety.current_max",)),
    Row("goal.step", "goal angle's way in a tick, where it is far from the joint", "limit",
        ("safety.goal_reach", "safety.goal_speed")),
    Row("goal.slew", "goal current's rise in a tick", "limit", ("safety.current_rate",)),
    Row("tip.force", "normal force of a tip", "warn", ("safety.force_max",), by.tip_force, _T, True,
        share=_NEAR),
    Row("tip.force", "normal force of a tip", "fault", ("safety.force_max",),
        by.tip_force, _T, True),
    Row("tip.displacement", "displacement of a tip", "warn", ("safety.d_max",),
        by.tip_displacement, _T, True, share=_NEAR),
    Row("tip.displacement", "displacement of a tip", "fault", ("safety.d_max",),
        by.tip_displacement, _T, True),
    Row("tip.tilt", "|θ| against asin(1 − d/a) less a margin", "warn", ("safety.theta_margin",),
        by.tip_tilt, _T, True, share=_NEAR),
    Row("tip.tilt", "|θ| against asin(1 − d/a) less a margin", "fault", ("safety.theta_margin",),
        by.tip_tilt, _T, True),
    Row("tactile.late", "age of the last sound frame: nothing is moved on", "limit",
        ("safety.frame_age_hold",), needs=_T, gripping=True),
    Row("tactile.silent", "age of the last sound frame", "fault",
        ("safety.frame_age_fault", "safety.frame_age_action"), by.frames_silent, _T, True,
        gripping=True),
    Row("tactile.frozen", "frames that are the same again and again while something touches",
        "fault", ("safety.frozen_after",), by.frozen, _T),
    Row("tactile.saturated", "share of full cells", "warn", ("safety.saturated",), by.saturated, _T,
        lasts=0.1),
    Row("tactile.misfit", "frames that fit no contact of the model", "warn", ("tactile.noise",),
        by.misfit, _T, lasts=0.5),
    Row("hand.angle", "object's angle by one finger against the other's", "warn",
        ("safety.residual_angle", "object.taper"), by.hand_angle, _T, lasts=0.2, share=0.5),
    Row("hand.angle", "object's angle by one finger against the other's", "fault",
        ("safety.residual_angle", "object.taper"), by.hand_angle, _T, lasts=0.2),
    Row("hand.width", "held object's width by joints and sensors, since it was gripped", "fault",
        ("safety.residual_width",), by.hand_width, _T, lasts=0.2),
    Row("hand.force", "one tip's force against the other's", "warn", ("safety.residual_force",),
        by.hand_force, _T, lasts=0.3),
    Row("hand.torque", "joint torque against what the tip feels", "warn",
        ("safety.residual_torque",), by.hand_torque, _T, lasts=0.3),
    Row("grip.slip", "shear against friction less a margin", "warn",
        ("control.tip_friction", "control.slip_margin"), by.slip, _T, lasts=0.1),
    Row("commands.pace", "a client's commands a second, stop not counted", "limit",
        ("commands.per_second",)),
    Row("loop.overruns", "late ticks in a row", "fault", ("safety.overruns_fault",), by.overrunning,
        "", True),
)  # fmt: skip
