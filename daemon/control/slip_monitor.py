"""How near a held object is to slipping, and the grip force that keeps the margin.

What these sensors show, and what they don't:

- A pressure grid feels normal pressure only; shear does not change it.
- The joints' currents show a load along the faces: what pressure does not explain of a torque is
  shear (`hand.external_load`). A joint's friction hides a load of its torque over W turn, 1.7 N a
  tip at the default hand. What stands when holding begins is taken as friction up to that, and as
  load beyond; what comes slower than a second is followed as friction up to that, too. Half of it
  is no sign, and a load that is seen is taken as so much more as friction may hide. So a grip whose
  friction bears less than about twice that is not guarded well, at the default hand below 7 N; one
  that bears less than it is not guarded, below 2.8 N.
- A torque constant that is wrong by a share looks like a load in proportion to the grip: up to 10 %
  of the torque are taken out when holding begins.
- A load towards the palm wedges the object between the tips: it shows less, and needs more to slip.
- The object's angle is known twice, from frames and from the joints by rolling. What frames correct
  and no joint explains is shear of the tips up to μ (d1 + d2)/2W, and slip well beyond.
- An object that slides along its parallel faces without turning changes no d, no θ and no joint:
  once it slides, nothing shows it until a tip comes to its edge. So the margin is kept before, and
  ``control.tip_friction`` must not be more than the real friction.
- While the grip is built up or the object turns, currents also move the joints: the load of before
  stands. A load that grows by more than about 10 N a second is too fast for the grip.

Holds the judgement alone; the grip law raises the force, within ``control.grip_raise_max``.
"""

from __future__ import annotations

import math

from softfinger.daemon.perception.contact_filter import GraspState
from softfinger.daemon.profile.settings import GRIP_SHARE, Settings
from softfinger.daemon.types import Contact

_EACH = 0.008  # s between two looks
_SMOOTH = 0.1  # s over which the load is averaged: joint velocities flicker by a count
_LEARN = 1.0  # s in which the friction at rest is learnt
_SCALE_OFF = 0.1  # share by which the torque constant may be off
_KEPT = 1.0  # s that a raised grip is kept after the need for it has gone
_BACK = 2.0  # s in which it then comes back by all of `grip_raise_max`
_TURNED_MORE = 0.25  # share that the grip is raised by when the object turns in it
_WELL = 1.5  # times what the tips' shear explains: the object turns in the grip
_FORGET = 2.0  # s in which turning that no joint explains is forgotten: warmth, creep
_SIGNS = 3.0  # standard deviations of the angle, more than that
_LEAST_LEVER = 0.2  # of the object's width: a load's lever is not taken for less
_LEAST_SPARE = 0.3  # of the friction: where rolling takes more, a firmer grip hardly helps


class SlipWatch:
    """Watches one held object, tick by tick."""

    def __init__(self, settings: Settings) -> None:
        self._law = settings.control
        self._every = max(round(_EACH * settings.loop.rate), 1)
        self._dt = self._every / settings.loop.rate
        self._width = settings.object.width
        self._force_most = GRIP_SHARE * settings.safety.force_max
        self._friction = 0.0  # what a joint's friction looks like, as a load [N]
        self.forget()

    def forget(self) -> None:
        """Nothing is held any more, or something else."""
        self._ticks = 0  # until the next look
        self.load = 0.0  # N that each tip may bear along its face, hidden part included
        self.turned = False  # the object has turned in the grip, at this tick
        self._known = False  # what stood when holding began is known:
        self._still = 0.0  # what of it does not grow with the grip [N]
        self._share = 0.0  # and what does, as a share of the normal force
        self._smooth = 0.0
        self._age = 0.0  # s since holding began, up to `_LEARN`
        self._stray = 0.0  # sum of unexplained turning that has been looked at [rad]
        self._away = 0.0  # unexplained turning that is not forgotten yet [rad]
        self._needed = 0.0  # force for the margin, kept for a while [N]
        self._most = 0.0  # N that the grip may be raised to
        self._idle = 0.0  # s since that was needed

    def begin(self, held: GraspState) -> None:
        """Holding begins, or begins again after a command: learn what is no load."""
        # Where the faces lean towards each other, the object going out takes part of the turning.
        lean = math.tan(0.5 * held.taper)
        lever = self._width * _mean(held.turn) - lean * _mean(held.arm)
        if lever <= 0.0:
            self._known = False
            return
        normal = _mean(held.normal)
        scale = _SCALE_OFF * normal * _mean(held.arm) / lever
        self._friction = self._law.joint_friction / lever
        found = self._smooth + self._share * normal
        self._still = min(max(found, -self._friction), self._friction)
        taken = min(max(found - self._still, -scale), scale)
        self._share = taken / normal if normal > 0.0 else 0.0
        self._smooth = found - taken
        self._stray = held.stray
        self._away = 0.0
        self._age = _SMOOTH
        self._known = True

    def kept(self, asked: float) -> float:
        """The grip force [N] for ``asked`` between two looks."""
        return max(asked, min(self._needed, self._most))

    def due(self) -> bool:
        """Whether this tick takes a look: not every one does, loads are slower."""
        self.turned = False
        if self._ticks:
            self._ticks -= 1
            return False
        self._ticks = self._every - 1
        return True

    def step(
        self, held: GraspState, contacts: list[Contact], asked: float, holding: bool, closing: float
    ) -> float:
        """Look; the grip force [N] to go to: ``asked``, or more where the margin needs it.

        ``holding`` says that nothing but loads moves the joints; ``closing``, -1 to 1, how much of
        the joints' friction is given at present for closing.
        """
        law = self._law
        self._most = most = max(min(asked + law.grip_raise_max, self._force_most), asked)
        found = held.load - closing * self._friction - self._share * _mean(held.normal)
        self._smooth += (found - self._smooth) * self._dt / _SMOOTH
        if holding and self._known:
            self._weigh(held)
            self._watch_turning(held, contacts)
        else:
            self._stray = held.stray
        # Of the shear one part grows with the grip, the rolling's; the load is borne by both tips.
        spare = law.tip_friction * (1.0 - law.slip_margin) - held.shear
        # A grip that bears less than the joints' friction hides is told nothing by their torques.
        told = self.load if law.tip_friction * asked > self._friction else 0.0
        load = max(told, 0.5 * law.object_load)
        needed = 0.0
        if load > 0.0:
            needed = load / max(spare, _LEAST_SPARE * law.tip_friction)
        if self.turned:
            needed = max(needed, (1.0 + _TURNED_MORE) * max(asked, self._needed))
        if needed >= self._needed:
            self._needed = min(needed, most)
            self._idle = 0.0
        else:
            self._idle += self._dt
            if self._idle > _KEPT:
                back = law.grip_raise_max / _BACK * self._dt
                self._needed = max(self._needed - back, needed)
        return min(max(asked, self._needed), most)

    def _weigh(self, held: GraspState) -> None:
        seen = abs(self._smooth - self._still)
        self._age = min(self._age + self._dt, _LEARN)
        if seen < self._friction:
            # So little may as well be friction that gives way; what comes slower stays hidden.
            still = self._still + (self._smooth - self._still) * self._dt / self._age
            self._still = min(max(still, -self._friction), self._friction)
        # Half the friction is no sign yet, and after a motion it may turn round; from all of it on
        # as much may be hidden.
        sure = seen - (0.5 + max(1.0 - self._age / _LEARN, 0.0)) * self._friction
        lever = max(held.load_lever, _LEAST_LEVER * self._width)
        hidden = max(self._law.joint_friction / lever, self._friction)
        self.load = min(max(4.0 * sure, 0.0), seen + hidden)

    def _watch_turning(self, held: GraspState, contacts: list[Contact]) -> None:
        self._away += held.stray - self._stray - self._away * self._dt / _FORGET
        self._stray = held.stray
        sheared = 0.5 * self._law.tip_friction * (contacts[0].d + contacts[1].d) / self._width
        if abs(self._away) > _WELL * sheared + _SIGNS * held.angle_std:
            self.turned = True
            self._away = 0.0


def _mean(pair: list[float]) -> float:
    return 0.5 * (pair[0] + pair[1])
