"""Slip margin of a held object, and the grip force that keeps it.

With the names of `SlipLaw`, `SlipState` and `GraspState`, at each tick:

    r                  mean(torque_residual) − closing · joint_friction, low-pass filtered: smooth
    L                  load on each tip: r − still = load_arm L + load_curvature L²      (`load_of`)
    s.friction         max(joint_friction, free_torque) + load_friction · normal force · its lever
    sure               |L| − (1/2 … 3/2) s.friction/load_arm
    s.load             min(max(4 sure, 0), |L| + s.friction/slope, friction force_limit)
    spare              friction (1 − margin) − shear                      of the normal force
    needed             max(s.load, felt, object_load/2)/spare
    force              min(max(commanded, needed), force_limit)
    force_limit        min(commanded + min(raise_max, share · commanded), force_max)
    share              raise_ratio if s.moved, else at most _UNSURE_SHARE

`still` is the part of the residual that is not a load. It starts with the residual that stands when
holding begins, because an error of the modulus or the torque constant is the largest part of that.
It then follows r within a second, and it follows the commanded torque while the joints stand still:
torque that the force law adds to a joint that sticks is carried by friction. It stays within
s.friction of `base`, the part of its start that exceeds friction; rubber that relaxes may lower it
by a further _RELAXES of the tip's moment.

`s.moved` is true once the object has turned, both joints have given way at once, or |L| exceeds
twice what friction can hide. `needed` stays for _HOLD_TIME and then falls by raise_max in _BACK. A
sudden load, or a turn of the object beyond μ (d1 + d2)/2W · _WELL, raises the force at once.

The sensors have these limits:

- A pressure grid measures normal pressure only. A solid tip's frames also show the shear on its
  face, to 0.1 N.
- The joints' currents show a load along the faces as torque beyond the tips' normal forces, if both
  joints show it alike. Joint friction hides a load of its torque over load_arm, 2 N a tip for the
  default hand. A load that arrives slowly stays hidden in friction, so a 10 N grip is raised too
  late for loads that grow by more than about 4 to 6 N/s (simulated). A weak grip, below 7 N for the
  default hand, is not guarded well; below 2.8 N not at all.
- A load towards the palm wedges the object between the tips. It shows less, and slips later. A
  sudden one never shows more than lever²/4 bow, or 0.07 N·m at 10 N.
- The object's angle is measured by the frames and predicted by rolling. A difference is shear of
  the tips up to μ (d1 + d2)/2W, and slip well beyond.
- An object that slides along parallel faces without turning changes no d, no θ and no joint angle.
  ``control.tip_friction`` must therefore not exceed the real friction.
- While the grip is built up or the object turns, currents also move the joints, and the last load
  is kept.
- A sudden load makes both joints give way, and the damping torque shows that before the sensors do:
  both torques jump beyond their noise while both encoders move. For a pull the jumps have the same
  sign, for a twist opposite ones. A sideways push looks like a twist. The grip is then raised by as
  much as allowed, as fast as ``safety.current_rate`` permits, since a sliding tip shows no more
  load than its friction bears.
"""

from __future__ import annotations

import math

from softfinger.daemon.perception.grasp import GraspState
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import GRIP_FRACTION
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.layout import Pair, Record
from softfinger.kinematics.hand.grasp_state import Two, load_of

_SMOOTH = 0.1  # s over which the load is averaged: joint velocities flicker by a count
_SUDDEN = 0.7  # of what friction bears with its margin: a load that comes at once, and may go on
_LEARN = 1.0  # s in which the friction at rest is learnt
_HOLD_TIME = 1.0  # s that a raised grip is kept after the need for it has gone
_BACK = 2.0  # s in which it then comes back by all of `grip_raise_max`
_TURNED_MORE = 0.5  # fraction that the grip is raised by when the object turns in it
_EACH = 0.15  # of such turning: each tip must show so much
_WELL = 1.5  # times what the tips' shear explains: the object turns in the grip
_FORGET = 2.0  # s in which turning that no joint explains is forgotten: warmth, creep
_JUMP_MIN = 0.01  # N·m of a jump, besides
_SHEAR_JUMP = 0.6  # N: frames scatter by 0.1
_YIELDS = 0.01  # rad/s that both joints give way faster than just before: half a count of one
_FAST = 0.1  # rad/s, likewise
_SIGNS = 4.0  # standard deviations, of the angle and of the torques, more than that
_BOTH = 0.5  # of the mean of both joints' torques: each must show so much of a load, …
_AT_ONCE = 0.25  # … and so much of one that comes at once, while a joint may still stick
_BALANCED = 0.6  # of both tips' mean force: each must feel so much, as of any object that is free
_FRICTION_MOST = 0.3  # N·m: what more a joint took on its way was no friction
_UNSURE_SHARE = 0.3  # of the force asked for: no grip is raised by more before something moves, …
_RELAXES = 0.2  # share of a tip's force that rubber may lose while it is held
_ARM_MIN = 0.2  # of the object's width: a load's lever is not taken for less
_SPARE_MIN = 0.3  # of the friction: where rolling takes more, a firmer grip hardly helps


class SlipLaw(Record):
    """Constants of one slip monitor."""

    dt: float  # [s]
    width: float  # of the object [m]
    force_max: float  # [N]
    friction: float  # Coulomb, tip on object
    margin: float  # fraction of it that is kept unused
    joint_friction: float  # [N·m]
    load_friction: float  # fraction of the tip's moment that gears hold until the joint opens
    object_load: float  # [N]
    shear_shows: bool  # in the tips' frames
    raise_max: float  # [N]
    raise_ratio: float  # of the force asked for


class SlipState(Record):
    """Load, friction and margin of one held object."""

    law: SlipLaw
    friction: float  # of a joint, what gears hold of this tick's force included [N·m]
    load: float  # that each tip may bear along its face, hidden part included [N]
    guarded: float  # likewise, as tips feel it and as declared included: the force is for that [N]
    turned: bool  # the object has turned in the grip, at this tick
    reflex: bool  # it has, or a load came at once: the grip is to be raised at once
    known: bool  # what stood of the joints' torques when holding began:
    still: float  # friction, as a rule [N·m]
    base: float  # what stood of it beyond friction: of a force that is not known well [N·m]
    given: float  # mean torque of both joints at the last tick [N·m]
    moved: bool  # a joint gave way to a load, or the object turned: so the grip was raised
    smooth: Pair  # what nothing else explains of them, averaged [N·m]
    variance: Pair  # of both joints' mean about that, and of half their difference [N²·m²]
    speed: Pair  # of the joints, averaged [rad/s]
    felt: float  # the load that solid tips feel, averaged [N]
    twisted: float  # a twist's shear that they feel, averaged [N]
    age: float  # since holding began, up to `_LEARN` [s]
    unexplained_rotation: Pair  # sums of unexplained turning that have been looked at [rad]
    away: Pair  # unexplained turning that is not forgotten yet, as each tip shows it [rad]
    needed: float  # force for the margin, kept for a while [N]
    force_limit: float  # that the grip may be raised to [N]
    idle: float  # since that was needed [s]


def set_law(law: SlipLaw, settings: Settings) -> None:
    """Fill in what the settings say."""
    control = settings.control
    law.dt = 1.0 / settings.loop.rate
    law.width = settings.object.width
    law.force_max = GRIP_FRACTION * settings.safety.force_max
    law.friction, law.margin = control.tip_friction, control.slip_margin
    law.joint_friction = control.joint_friction
    law.load_friction = control.load_held
    law.object_load = control.object_load
    law.shear_shows = settings.tip.physics == "solid"
    law.raise_max, law.raise_ratio = control.grip_raise_max, control.grip_raise_share


@inner_kernel
def forget(s: SlipState) -> None:
    """Forget the object: nothing is held any more, or something else."""
    s.turned = s.known = s.reflex = s.moved = False
    s.load = s.guarded = s.felt = s.twisted = s.still = s.base = s.age = s.friction = 0.0
    s.smooth[:] = s.variance[:] = s.speed[:] = 0.0
    s.unexplained_rotation[:] = s.away[:] = 0.0
    s.needed = s.force_limit = s.idle = 0.0


@inner_kernel
def begin(s: SlipState, grasp: GraspState) -> None:
    """Begin holding, or begin again after a command: learn the torques that are no load."""
    s.known = grasp.load_arm > 0.0
    if not s.known:
        return
    s.still = mean(s.smooth)
    s.base = s.still - min(max(s.still, -s.friction), s.friction)
    s.unexplained_rotation[:] = grasp.unexplained_rotation
    s.away[:] = 0.0
    s.age = _SMOOTH


@inner_kernel
def update(
    s: SlipState,
    grasp: GraspState,
    commanded: float,
    holding: bool,
    closing: float,
    dq: Two,
    given_torques: Pair,
    doubted: bool,
) -> float:
    """Return the grip force [N] to go to: ``commanded``, or more where the margin needs it.

    ``holding``: nothing but loads moves the joints. ``closing``, -1 to 1: how much of the joints'
    friction is given at present for closing. ``dq`` [rad/s]: of the joints. ``doubted``: what is
    measured is named as false, and raises no grip.
    """
    law = s.law
    s.turned = False
    moment = mean(grasp.normal) * mean(grasp.moment_arm)
    s.friction = _friction(s, grasp) + law.load_friction * moment
    monitored = holding and s.known and grasp.load_arm > 0.0
    given = mean(given_torques)
    # Of the shear one part grows with the grip, the rolling's; the load is borne by both tips.
    spare = law.friction * (1.0 - law.margin) - grasp.shear
    bearing = max(spare, _SPARE_MIN * law.friction)
    sudden = _average(s, grasp, closing, dq, monitored, spare)
    if monitored:
        standing = max(abs(dq[0]), abs(dq[1])) < _YIELDS
        _estimate_load(s, grasp, given, standing)
        _watch_turning(s, grasp)
    else:
        s.unexplained_rotation[:] = grasp.unexplained_rotation
    # A grip that bears less than the joints' friction hides is not judged by their torques.
    if law.friction * commanded * grasp.load_arm <= s.friction:
        s.load = 0.0
    felt = max(abs(grasp.sheared) - grasp.shear * mean(grasp.normal), 0.0)
    if law.shear_shows:  # what torques say beyond that is a force that is not known well
        s.load = min(s.load, felt + _SHEAR_JUMP)
    bears = spare * mean(grasp.normal)
    sudden = _shear_jumps(s, felt, grasp.twisted, bears, monitored) or sudden
    if doubted:
        s.load = felt = s.needed = 0.0
        s.turned = sudden = s.moved = False
    s.given = given
    s.guarded = max(s.load, felt, 0.5 * law.object_load)
    needed = s.guarded / bearing
    if s.turned:
        needed = max(needed, (1.0 + _TURNED_MORE) * max(commanded, s.needed))
    s.reflex = s.turned or sudden
    s.moved = s.moved or s.reflex
    s.force_limit = _force_limit(s, commanded, 0.5 * law.object_load / bearing)
    if sudden:
        needed = s.force_limit  # how much more is to come is not known
    if needed >= s.needed:
        s.needed = min(needed, s.force_limit)
        s.idle = 0.0
    else:
        s.idle += law.dt
        if s.idle > _HOLD_TIME:
            s.needed = max(s.needed - law.raise_max / _BACK * law.dt, needed)
            s.moved = s.moved and s.needed > commanded
    return min(max(commanded, s.needed), s.force_limit)


@inner_kernel
def _force_limit(s: SlipState, commanded: float, declared: float) -> float:
    """Return the force [N] that a grip may be raised to; a ``declared`` load's is not in doubt."""
    law = s.law
    share = law.raise_ratio if s.moved else min(law.raise_ratio, _UNSURE_SHARE)
    raised = min(max(share * commanded, declared - commanded), law.raise_ratio * commanded)
    return max(min(commanded + min(raised, law.raise_max), law.force_max), commanded)


@inner_kernel
def _average(
    s: SlipState, grasp: GraspState, closing: float, dq: Two, monitored: bool, spare: float
) -> bool:
    """Take in both joints' torques; whether a load has come at once that needs a firmer grip.

    A jump of both that is no flicker, while the joints give way, is a load: no current that was
    read wrongly, and no frame's error, by which one tip alone seems to let go. A twist makes
    joints show the contrary of each other.
    """
    friction = s.friction
    known = closing * (friction if closing < 0.0 else s.law.joint_friction)
    off1 = grasp.torque_residual[0] - known - s.smooth[0]
    off2 = grasp.torque_residual[1] - known - s.smooth[1]
    unsettled = _JUMP_MIN + friction * max(1.0 - s.age / _LEARN, 0.0)  # they may come to rest
    balanced = min(grasp.normal[0], grasp.normal[1]) > _BALANCED * mean(grasp.normal)
    sudden = False
    for k in range(2):
        sense = 1.0 - 2.0 * k
        off = 0.5 * (off1 + sense * off2)
        before = 0.5 * (s.smooth[0] + sense * s.smooth[1])
        before -= s.still if k == 0 else min(max(before, -friction), friction)
        alike = min(off1 * off, sense * off2 * off) > _AT_ONCE * off * off
        # Each: one alone has broken loose, or stops after that.
        gives1 = math.copysign(s.speed[0] - dq[0], off * (s.speed[0] - dq[0]))
        gives2 = math.copysign(s.speed[1] - dq[1], sense * off * (s.speed[1] - dq[1]))
        yields = min(gives1, gives2) > _YIELDS
        flicker = _SIGNS * math.sqrt(s.variance[k]) + unsettled
        felt = abs(off) > flicker and abs(before + off) > abs(before)
        if monitored and alike and balanced and yields and felt:
            curvature = grasp.load_curvature if k == 0 else 0.0
            load, slope = load_of(before + off, grasp.load_arm, curvature)
            undetected = friction / max(slope, _ARM_MIN * s.law.width)
            needs = abs(load) + 0.5 * undetected > _SUDDEN * max(spare, 0.0) * mean(grasp.normal)
            sudden = sudden or needs
    settles = abs(dq[0] + dq[1]) < 2.0 * _FAST  # beyond, torques also move the joints
    kept = 1.0 if sudden else s.law.dt / _SMOOTH if settles else 0.0
    if settles and not sudden:
        for k in range(2):
            off = 0.5 * (off1 + (1.0 - 2.0 * k) * off2)
            s.variance[k] += (off * off - s.variance[k]) * s.law.dt / _LEARN
    s.smooth[0] += off1 * kept
    s.smooth[1] += off2 * kept
    for k in range(2):
        s.speed[k] += (dq[k] - s.speed[k]) * s.law.dt / _SMOOTH
    return sudden


@inner_kernel
def _friction(s: SlipState, grasp: GraspState) -> float:
    """Return the most friction [N·m] that the joints may have, as the approach has shown it."""
    return min(max(mean(grasp.free_torque), s.law.joint_friction), _FRICTION_MOST)


@inner_kernel
def _shear_jumps(s: SlipState, felt: float, twisted: float, bears: float, monitored: bool) -> bool:
    """Take in the load and the twist that solid tips feel [N]; whether one has come at once.

    ``bears`` [N]: what friction does with its margin.
    """
    jump, turn = felt - s.felt, abs(twisted - s.twisted)
    s.felt += jump * s.law.dt / _SMOOTH
    s.twisted += (twisted - s.twisted) * s.law.dt / _SMOOTH
    pulled = jump > _SHEAR_JUMP and felt > _SUDDEN * bears
    return monitored and (pulled or (turn > _SHEAR_JUMP and abs(twisted) > _SUDDEN * bears))


@inner_kernel
def _estimate_load(s: SlipState, grasp: GraspState, given: float, standing: bool) -> None:
    """Tell the load from the joints' friction, and from rubber that relaxes."""
    law = s.law
    both = _alike(s)
    off = both - s.still
    s.age = min(s.age + law.dt, _LEARN)
    if standing:  # what was commanded meanwhile, friction holds
        s.still += given - s.given
    relaxed = _RELAXES * mean(grasp.normal) * mean(grasp.moment_arm)
    if -s.friction - relaxed < off < s.friction:
        # So little may as well be friction that gives way; what comes slower stays hidden.
        s.still += off * law.dt / s.age
    s.still = min(max(s.still, s.base - s.friction - relaxed), s.base + s.friction)
    # Friction that lets go, or turns round, is no load.
    off = min(max(off, min(both - s.base, 0.0)), max(both - s.base, 0.0))
    load, slope = load_of(off, grasp.load_arm, grasp.load_curvature)
    load = abs(load)
    # Half the friction is no sign yet, and after a motion it may turn round; from all of it on
    # as much may be hidden. What no raised grip bears need not be told apart.
    friction = s.friction / grasp.load_arm
    s.moved = s.moved or load > 2.0 * friction
    sure = load - (0.5 + max(1.0 - s.age / _LEARN, 0.0)) * friction
    undetected = s.friction / max(slope, _ARM_MIN * law.width)
    s.load = min(max(4.0 * sure, 0.0), load + undetected, law.friction * s.force_limit)


@inner_kernel
def _alike(s: SlipState) -> float:
    """The torque [N·m] that both joints show of a load: one alone doesn't speak for both."""
    both = mean(s.smooth)
    smaller = 0.0
    if s.smooth[0] * s.smooth[1] > 0.0:
        smaller = min(abs(s.smooth[0]), abs(s.smooth[1]))
    force_limit = smaller / _BOTH + s.friction
    return min(max(both, -force_limit), force_limit)


@inner_kernel
def _watch_turning(s: SlipState, grasp: GraspState) -> None:
    """Look for turning beyond what the tips' shear explains, and that both tips show.

    One that shows the contrary of the other, or next to nothing of it, is a faulty witness.
    """
    for k in range(2):
        s.away[k] += grasp.unexplained_rotation[k] - s.unexplained_rotation[k]
        s.away[k] -= s.away[k] * s.law.dt / _FORGET
        s.unexplained_rotation[k] = grasp.unexplained_rotation[k]
    away = s.away[0] + s.away[1]
    depth = grasp.d[0] + grasp.d[1]
    sheared = 0.5 * s.law.friction * depth / s.law.width
    alike = min(s.away[0] * away, s.away[1] * away) > _EACH * away * away
    if alike and abs(away) > _WELL * sheared + _SIGNS * grasp.angle_std:
        s.turned = True
        s.away[:] = 0.0


@inner_kernel
def mean(pair: Pair) -> float:
    """Return the mean of (left, right)."""
    value: float = 0.5 * (pair[0] + pair[1])
    return value
