"""Faults of the witnesses of a grip's force, each found by the others.

Frames, encoders and torques each tell how hard a tip is pressed. A scale that is off is found in
`perception.scales`; here stands what no scale explains:

- *jump*: what a frame shows of the object's angle, beyond what the joints' rolling predicts, comes
  in one frame of one tip alone, or of both while the joints stand still. A turn that is real shows
  in both tips, and turns the joints. So does d, where the joints stand still: an object that is
  struck is pressed into one tip as it leaves the other.
- *drift*: frames say that a tip is pressed less than the joints' closing makes it, and the joint's
  torque agrees with its closing. A load changes the torque alone; an object that has another width
  elsewhere changes the frames, and the torque agrees with them.
- *repeat*: frames come again in the order in which they came before. A sensor with noise never
  repeats one.
- *current*: a joint's current is not the goal's.

Frames that jump are refused: the contact is carried on by the joints, the grip's push stays as it
was, and what holds for a board that has fallen silent follows. Of frames that drift d is refused
alone, with what they have falsified of it since the grip holds: their zero has moved, they still
show that something touches and where. The joints tell d until the contact ends.
"""

from __future__ import annotations

import math

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.layout import Pair, Record

JUMP = 0.12  # rad beyond the joints' prediction in one frame: honest ones stay below 0.04
DEEPER = 1e-3  # m, likewise
_SURE = 5.0  # standard deviations, likewise
_ALIKE = 0.5  # fraction of it that the other tip shows of what is real
_TURNING = 0.1  # rad/s of both joints together, or …
_GOES_ON = 0.06  # … rad from frame to frame, likewise
JUMPS_MAX = 2  # frames that are refused before it is reported
_GIVE_UP = 50  # frames after which the contact is taken as they show it
_RECENT = 600.0  # s within which a drift shows
_DRIFT = 0.08  # N·m that frames and closing must be apart
_DRIFT_RATIO = 0.15  # of the joint's moment, likewise
_RATIO_MIN, _RATIO_MAX = 0.6, 1.5  # times as much the torque changes then, …
_FRICTION = 0.06  # … and N·m by which a joint's friction adds to it
DRIFT_TIME = 0.05  # s for which that must stand
QUIET = 0.1  # rad/s of a joint; beyond, torques move it
_NOISE = 0.02  # N·m by which they are apart when nothing is wrong
_CURRENT = 0.25  # fraction of its goal that a current may be off …
_CURRENT_NOISE = 0.02  # … and A besides
CURRENT_TIME = 0.1  # s for which that must stand


class WitnessState(Record):
    """Evidence against each finger's witnesses."""

    innovation: Pair  # of the newest frame's angle, before it was taken in or refused [rad]
    deeper: Pair  # of its d, where it tells the gain, too [m]
    jumps: Pair  # frames that were refused in a row
    corrected: Pair  # d that frames have added lately to what the joints did [m]
    standing: Pair  # the torque that nothing explains, averaged [N·m]
    drifted: Pair  # for how long frames contradict closing and torque [s]
    off: Pair  # d that frames then showed too much: they tell of it no more; 0: they do [m]
    off_goal: Pair  # for how long the current is not its goal's [s]


@inner_kernel
def forget(w: WitnessState) -> None:
    """Forget the evidence: nothing is held any more, or something else."""
    w.innovation[:] = 0.0
    w.deeper[:] = 0.0
    w.jumps[:] = 0.0
    w.corrected[:] = 0.0
    w.standing[:] = 0.0
    w.drifted[:] = w.off[:] = 0.0


@inner_kernel
def doubts(w: WitnessState) -> bool:
    """Return whether a witness is to be named."""
    for k in range(2):
        frames = w.jumps[k] > JUMPS_MAX or w.off[k] != 0.0
        if frames or w.off_goal[k] > CURRENT_TIME:
            return True
    return False


@inner_kernel
def refuses(
    w: WitnessState,
    finger: int,
    innovation: float,
    variance: float,
    deeper: float,
    deeper_variance: float,
    speed: float,
) -> bool:
    """Return whether a frame is to be refused for what it is off its prediction.

    ``innovation`` [rad] and ``deeper`` [m]: its angle and d, with their variances; ``speed``
    [rad/s]: of both joints together. The first frame of what is real is refused as well: what the
    other tip shows is not known yet.
    """
    other = w.innovation[1 - finger]
    before = w.innovation[finger]
    w.innovation[finger] = innovation
    w.deeper[finger] = deeper
    turned = abs(innovation) > max(JUMP, _SURE * math.sqrt(variance))
    moved = abs(deeper) > max(DEEPER, _SURE * math.sqrt(deeper_variance))
    if moved:
        moved = speed < _TURNING and abs(w.deeper[1 - finger]) < _ALIKE * abs(deeper)
    if turned:
        again = w.jumps[finger] > 0.0 and abs(innovation - before) > _GOES_ON
        goes_on = speed > _TURNING or again
        alike = innovation * other > _ALIKE * innovation * innovation
        turned = not (alike and goes_on)
    if w.jumps[finger] >= _GIVE_UP or not (turned or moved):
        w.jumps[finger] = 0.0
        return False
    w.jumps[finger] += 1.0
    return True


@inner_kernel
def set_aside(w: WitnessState, finger: int) -> float:
    """Return what is to be taken off a finger's d [m] as frames are found to drift, else 0."""
    if w.off[finger] != 0.0 or w.drifted[finger] <= DRIFT_TIME:
        return 0.0
    off: float = w.corrected[finger]
    w.off[finger] = off
    w.corrected[finger] = 0.0
    return off


@inner_kernel
def begin_holding(w: WitnessState, residual: Pair) -> None:
    """Mark the grip as held: from now on only loads and faulty witnesses change what is felt."""
    for k in range(2):
        w.corrected[k] = 0.0
        w.standing[k] = residual[k]


@inner_kernel
def check_drift(
    w: WitnessState,
    finger: int,
    residual: float,
    moment: float,
    by_depth: float,
    quiet: bool,
    holding: bool,
    dt: float,
) -> float:
    """Return the torque [N·m] that a load remains to explain: less that of the joint's closing.

    ``residual``: torque beyond the frames' force; ``moment`` [N·m]: torque of that force;
    ``by_depth`` [N]: the moment's slope by d; ``quiet``: the joint hardly moves. Unless the grip is
    ``holding`` still, only a tip that is pressed more than its frames say is looked for.
    """
    w.corrected[finger] -= w.corrected[finger] * dt / _RECENT
    w.standing[finger] += (residual - w.standing[finger]) * dt / _RECENT
    # What one tip gains and the other loses, the object does that is pushed towards one. What both
    # show alike while joints move may be their rolling: it explains torque, and tells no drift.
    corrected = w.corrected[finger]
    other = w.corrected[1 - finger]
    shared = math.copysign(min(abs(corrected), abs(other)), corrected)
    own = corrected - shared
    if corrected * other < 0.0:
        corrected = own
    elif holding:
        own = corrected
    closing = -by_depth * corrected
    recent = residual - w.standing[finger]
    ratio = recent / closing if closing != 0.0 else 0.0
    apart = max(_DRIFT, _DRIFT_RATIO * moment)
    beyond = max(abs(closing) - _NOISE, 0.0)
    limit = _RATIO_MAX * beyond + min(2.0 * beyond, _FRICTION)
    agrees = ratio > _RATIO_MIN and abs(recent) < limit + _NOISE
    if quiet and by_depth * abs(own) > apart and (holding or closing > 0.0) and agrees:
        w.drifted[finger] += dt
    else:
        w.drifted[finger] = 0.0
    if ratio <= 0.0:
        return residual
    return residual - math.copysign(min(abs(recent), limit), recent)


@inner_kernel
def trusted_current(w: WitnessState, finger: int, current: float, goal: float, dt: float) -> float:
    """Return joint's current [A]: as it was read, or its ``goal`` where it is off that for long.

    ``goal`` is 0 where no grip says what it should be.
    """
    if goal <= 0.0:
        w.off_goal[finger] = 0.0
        return current
    if abs(current - goal) <= _CURRENT * goal + _CURRENT_NOISE:
        w.off_goal[finger] = 0.0
    else:
        w.off_goal[finger] += dt
    return goal
