"""The tick rehearsed on a twin until its deadline comes, so that it finds warm caches.

After a sleep a tick takes several times as long as the same tick right after another: the
processor has forgotten its code, its branches and its data. So the last of each sleep is spent on
a twin, a loop of its own on the same settings. When a tick is over, the twin takes over what the
loop's stages remember, by value; before the next one it ticks on from there, again and again.

The loop is only read. A twin has no servos, no sensors, no clients and no log. What it shares with
the loop neither of them ever writes, but for the estimators' scratch, in which no frame leaves
anything for the next: whatever happens to a twin changes no tick.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Iterable
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.clock import LoopClock
from softfinger.daemon.control.modes import Mode
from softfinger.daemon.loop.loop import Loop
from softfinger.daemon.loop.timing import Statistics
from softfinger.daemon.perception.finger_model import FingerModel
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.profile.settings import Settings, TaskSettings
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import Frame, Goal, Reading
from softfinger.daemon.wire.command_server import CommandServer
from softfinger.daemon.wire.loop_link import Link
from softfinger.daemon.wire.publisher import Publisher
from softfinger.kinematics.compiled.layout import Record

_ROUND = 4  # passes: the first with new frames, and after a look at the loop's own data
_MORE = 1.25  # of the time taken lately that a pass may take
_SPARE = 2e-5  # s before the deadline that no pass may take, since some take longer
_FADE = 0.98  # of that time a tick later
_LARGEST = 16_384  # bytes: longer arrays are a kernel's constants and scratch
_VALUES = frozenset({bool, int, float, str, type(None), Mode})  # what nobody can write
_COLD, _FRESH, _SAME = range(3)  # kinds of passes: the first of all, the first of a round, others


class Rehearsal:
    """One loop's; the loop calls it before each sleep with its end. Not for virtual time."""

    def __init__(
        self,
        loop: Loop,
        settings: Settings,
        models: tuple[FingerModel, FingerModel],
        clock: LoopClock,
        lead: float,
    ) -> None:
        """``lead`` [s]: how long before a deadline it begins, after as long a sleep at least."""
        self._loop = loop
        self._lead = lead
        self._link = Link()  # with nobody at its other end
        self._sensors = {
            each.finger: GivenFrames(getattr(each.sensor, "live", None))
            for each in loop.perception.fingers
        }
        perception = Perception(settings, self._sensors, models)
        perception.share_scratch(loop.perception)
        self.twin = Loop(
            settings.model_copy(update={"task": TaskSettings()}),
            clock,
            None if loop.servos is None else _SameReading(1.0 / settings.loop.rate),
            perception,
            Publisher(self._link),
            CommandServer(self._link),
        )
        self.likeness = Likeness(loop.stages, self.twin.stages)
        self._took = [0.0, 0.0, 0.0]  # s that a pass of each kind takes

    def __call__(self, due: float) -> None:
        """Sleep, and rehearse until shortly before the machine's time ``due`` [s]."""
        # A pass that was interrupted once is tried again, though not soon.
        took = self._took = [min(_FADE * each, 2.0 * self._lead) for each in self._took]
        now, ends = time.monotonic, due - _SPARE
        if now() + _MORE * took[_COLD] > ends:
            return
        self.likeness.take()
        self._link.wanted = self._loop.wanted
        # Half of what is left at least: Linux takes the processor from a real-time thread that
        # leaves others less than 5 % of it, for 50 ms.
        left = due - now()
        time.sleep(max(left - self._lead, 0.5 * left, 0.0))
        kind, number, began = _COLD, 0, now()
        while began + _MORE * took[kind] < ends:
            try:
                self._pass(kind != _SAME)
            except Exception as error:  # a twin's; the loop goes on without
                self._loop.rehearsal = None
                self._loop.emit("warning", "rehearsal", f"ended by an error: {error!r}")
                return
            ended = now()
            took[kind] = max(ended - began, 0.9 * took[kind])  # most of the last few
            began = ended
            number += 1
            fresh = number % _ROUND == 0 and began + _MORE * took[_FRESH] < ends
            kind = _FRESH if fresh else _SAME

    def _pass(self, fresh: bool) -> None:
        twin = self.twin
        if twin.state.fault != self._loop.state.fault:
            self.likeness.take()  # it went its own way, on the same reading again and again
        t = twin.state.t + twin.period
        if fresh:
            self.likeness.look()
            for each in self._loop.perception.fingers:
                if (frame := each.frame) is not None:
                    newer = Frame(frame.seq + 1, t, t, frame.valid, frame.data)
                    self._sensors[each.finger].frame = newer
        twin.tick(t)


class Likeness:
    """What one graph of objects remembers, handed to a like one by value."""

    def __init__(self, real: Iterable[object], twin: Iterable[object]) -> None:
        self.objects: list[tuple[Any, Any, tuple[str, ...], attrgetter[Any]]] = []
        self.lists: list[tuple[list[Any], list[Any]]] = []
        self.arrays: list[tuple[NDArray[Any], NDArray[Any]]] = []
        self._seen: dict[int, object] = {}
        for mine, its in zip(real, twin, strict=True):
            self._pair(mine, its)
        self._tracked = [each for each in self._seen.values() if gc.is_tracked(each)]

    def take(self) -> None:
        """The twin's becomes what the real one's is."""
        for real, twin, names, values in self.objects:
            for name, value in zip(names, values(real), strict=True):
                if type(value) in _VALUES:
                    setattr(twin, name, value)
        for mine, its in self.lists:
            its[:] = mine
        for array, copy in self.arrays:
            copy[...] = array

    def look(self) -> None:
        """Have the processor fetch the real one's data: all that it refers to is visited."""
        gc.get_referents(*self._tracked)

    def _pair(self, real: Any, twin: Any) -> None:
        kind = type(real)
        if real is twin or kind is not type(twin) or id(real) in self._seen or kind in _VALUES:
            return
        if kind in (Settings, Statistics, Publisher, Frame):
            return
        if isinstance(real, np.ndarray):
            self._pair_arrays(real, twin)
            return
        self._seen[id(real)] = real
        if isinstance(real, Record):
            self._seen[id(real._fields)] = real._fields
            self._pair_arrays(real.array, twin.array)
        elif isinstance(real, list | tuple):
            if isinstance(real, list) and _VALUES.issuperset(map(type, real)):
                self.lists.append((real, twin))
            for mine, its in zip(real, twin, strict=False):
                self._pair(mine, its)
        elif kind.__module__.startswith(_OURS) and not _frozen(kind):
            names = [name for name in attributes(kind) if hasattr(real, name)]
            values = [name for name in names if type(getattr(real, name)) in _VALUES]
            if len(values) > 1:  # of one alone the getter makes no tuple
                self.objects.append((real, twin, tuple(values), attrgetter(*values)))
            for name in names:
                self._pair(getattr(real, name), getattr(twin, name, None))

    def _pair_arrays(self, real: Any, twin: Any) -> None:
        while isinstance(real.base, np.ndarray) and isinstance(twin.base, np.ndarray):
            real, twin = real.base, twin.base
        same = real.shape == twin.shape and real.dtype == twin.dtype
        own = same and real.nbytes <= _LARGEST and not np.may_share_memory(real, twin)
        if own and id(real) not in self._seen:
            self._seen[id(real)] = real
            self.arrays.append((real, twin))


_OURS = __name__.split(".", 1)[0]


def _frozen(kind: type) -> bool:
    parameters = getattr(kind, "__dataclass_params__", None)
    return parameters is not None and parameters.frozen


def attributes(kind: type) -> list[str]:
    """The names of an instance's attributes, as far as its class's own code uses them.

    Its ``__dict__`` has them, too, but an object that was once asked for it is slower ever after.
    """
    names: dict[str, None] = {}
    for each in kind.__mro__:
        names |= dict.fromkeys(getattr(each, "__slots__", ()))
        for member in vars(each).values():
            function = member.fget if isinstance(member, property) else member
            if code := getattr(function, "__code__", None):
                used = (name for name in code.co_names if not hasattr(kind, name))
                names |= dict.fromkeys(used)
    return list(names)


class _SameReading:
    """Servos that read the same again, a period later; goals go nowhere."""

    def __init__(self, period: float) -> None:
        self._period = period

    def connect(self) -> None:
        """Nothing to do."""

    close = torque_on = connect

    def read(self, reading: Reading) -> None:
        """The same again."""
        reading.seq += 1
        reading.t += self._period

    def torque_off(self, reading: Reading) -> bool:
        """Never confirmed: the twin goes on as the loop would."""
        self.read(reading)
        return False

    def write(self, goal: Goal) -> None:
        """Nothing to do."""

    def counters(self) -> dict[str, int]:
        """None."""
        return {}
