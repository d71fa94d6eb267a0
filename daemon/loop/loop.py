"""Run the control tick: read, estimate, decide, limit, write, publish.

The loop defines the order of the stages, and the clock defines the time. `loop.build` builds,
connects and warms up everything that the loop calls.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from softfinger.daemon.clock import LoopClock
from softfinger.daemon.control.modes import GRIPPING_MODES, Mode
from softfinger.daemon.control.state_machine import Control
from softfinger.daemon.control.task import Task, TaskEnded
from softfinger.daemon.errors import Refused, ServoError
from softfinger.daemon.loop.publishing import Publishing
from softfinger.daemon.loop.requests import Requests
from softfinger.daemon.loop.timing import Lateness, Statistics, record
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.heat import HeatWatch
from softfinger.daemon.safety.safety import BUS, Breach, Safety
from softfinger.daemon.safety.torque_state import TorqueState
from softfinger.daemon.servos.base import Servos
from softfinger.daemon.types import EventSink, State, Truth
from softfinger.daemon.wire.command_server import Handler
from softfinger.daemon.wire.loop_link import Link
from softfinger.daemon.wire.publisher import Publisher


class Commands(Protocol):
    """Command source: `wire.command_server.CommandServer` or a recording."""

    link: Link  # The loop emits the link's notices as events. Recordings use an unconnected link.

    def serve(self, handler: Handler) -> None:
        """Pass each request that is due on this tick to ``handler``."""


class Loop:
    """Clock-driven pipeline that runs entirely in the thread that calls `run`."""

    def __init__(
        self,
        settings: Settings,
        clock: LoopClock,
        servos: Servos | None,
        perception: Perception,
        publisher: Publisher | None,
        server: Commands | None,
        on_event: EventSink | None = None,
        truth: Truth | None = None,
    ) -> None:
        self.state = State(t=clock.now(), wall=clock.wall())
        self.period = 1.0 / settings.loop.rate
        self._settings = settings
        self._clock = clock
        self.perception = perception
        self._publisher = publisher
        self._server = server
        self._on_event = on_event
        grasp, sensors = perception.filter.grasp, perception.fingers
        self._control = Control(settings, self.state, grasp)
        self._task = Task.named(settings)
        self._safety = Safety(settings, grasp, sensors)
        self._heat = HeatWatch(settings, self.state)
        self.torque = TorqueState(
            servos, settings.servos, self.state, self._safety, self._fail, self.emit
        )
        self._requests = Requests(
            settings,
            self.state,
            self._control,
            self._safety,
            self.torque,
            perception,
            self.emit,
            clock.pauses_when_late,
        )
        self._after_opening: Breach | None = None  # fault that is latched once the hand is open
        self.statistics = Statistics()
        self._lateness = Lateness(settings, self.state.timing, clock.pauses_when_late)
        self._publishing = None
        if publisher is not None:
            self._publishing = Publishing(settings, publisher, sensors, self.statistics, truth)
        self.heartbeat: Callable[[float], None] | None = None  # called with each tick's end time
        self._reports: deque[tuple[str, str, str]] = deque()  # events reported outside a tick
        self._ending = False
        self._stopping = False
        self._began = -math.inf  # machine time at the start of the current tick [s]
        self._commanded = False  # True if a potentially slow command was executed on this tick

    # Other threads and signal handlers may call the following methods.

    def end(self) -> None:
        """Leave `run` after this tick and turn torque off."""
        self._ending = True

    def stop(self) -> None:
        """Turn torque off on the next tick, like the ``stop`` command."""
        self._stopping = True

    def report(self, level: str, kind: str, text: str) -> None:
        """Emit an event on the next tick. This method is thread-safe."""
        self._reports.append((level, kind, text))

    # Time

    def run(self, duration: float | None = None) -> None:
        """Run ticks until `end` is called or ``duration`` [s] has elapsed, then turn torque off."""
        self.state.t = self._clock.now()
        self.state.wall = self._clock.wall()
        self.emit("info", "start", "running, disarmed")
        try:
            self.advance(duration)
        finally:
            self._control.stop()
            self.torque.end()
            if self.state.torque:
                self.emit("error", "end", "exited; torque MAY STILL BE ON")
            else:
                self.emit("info", "end", "exited; torque is off")

    def advance(self, duration: float | None = None) -> None:
        """Run ticks for ``duration`` [s] of machine time or until `end` is called.

        The torque state does not change.

        Deadlines are absolute. After a late tick, the next deadline is set to the current time to
        avoid a burst of ticks. Real hardware continues to move during a late tick, whereas the
        clock of a simulated hand pauses.
        """
        clock, timing = self._clock, self.state.timing
        clock.sleep_until(clock.now())  # The time before the first tick does not count as a delay.
        before = clock.behind - timing.behind_s
        deadline = clock.now()
        last = clock.host() - self.period
        finish = math.inf
        if duration is not None:
            finish = deadline + clock.behind + duration - 0.5 * self.period
        while not self._ending and deadline + clock.behind < finish:
            timing.wake_late_s = clock.sleep_until(deadline)
            timing.behind_s = clock.behind - before
            began = clock.host()
            timing.tick_s = began - last
            last = began
            event = self._lateness.look(began, self._commanded)
            if event is not None:
                self.emit(*event)
            self._commanded = False
            done = self.tick(clock.now())
            deadline += self.period
            if done > deadline + clock.behind:
                timing.overruns += 1
            if (now := clock.now()) > deadline:
                timing.late_in_row += 1
                deadline = now
            else:
                timing.late_in_row = 0
            if self.heartbeat is not None:
                self.heartbeat(done)
        clock.sleep_until(deadline)

    # The tick

    def tick(self, now: float) -> float:
        """Run the pipeline once at clock time ``now``; return the machine time at the end."""
        state, clock, statistics = self.state, self._clock, self.statistics
        began = self._began = clock.host()
        state.seq += 1
        state.t = now
        state.wall = clock.wall()
        self._read()
        read = clock.host()
        self.perception.update(state)
        self._decide()
        decided = clock.host()
        self.torque.write(self._control.torque)
        written = clock.host()
        if self._publishing is not None:
            self._publishing(state)
        done = clock.host()
        state.timing.compute_s = done - began
        record(
            statistics.counts,
            statistics.largest,
            (
                state.timing.wake_late_s,
                done - began,
                (read - began) + (written - decided),
                done - written,
            ),
        )
        return done

    def _read(self) -> None:
        state, reading = self.state, self.state.reading
        state.read_error = state.write_error = ""
        try:
            self.torque.read()
        except ServoError as error:
            reading.valid = False
            state.read_error = str(error)
            self._fail(str(error))
        self._heat.update()
        if reading.valid and self.perception.fingers:
            gripping = state.mode in GRIPPING_MODES and state.goal.valid
            self.perception.filter.predict(reading, state.goal if gripping else None)

    def _decide(self) -> None:
        state, control = self.state, self._control
        stopped, self._stopping = self._stopping, False
        if stopped:
            self.command({"command": "stop"})
        if self._server is not None:
            if stopped:
                self._server.link.fence()
            self._server.serve(self.command)
            while self._server.link.notices:
                self.emit("warning", "clients", self._server.link.notices.popleft())
        if self._task is not None:
            self._follow(self._task)
        else:
            self._requests.watch_silence()
        state.mode = control.mode
        self._react(self._safety.judge(state))
        if self._heat.due and (action := self._heat.act(control)):
            self._requests.end_grip(action)
        if self._safety.must_hold and state.mode in GRIPPING_MODES:
            control.hold_goal(state.goal)
        else:
            control.step(self.period, state.goal)
        self._emit_events()
        state.mode = control.mode

    def _emit_events(self) -> None:
        for events in (self.perception.events, self._control.events):
            for event in events:
                self.emit(*event)
            events.clear()
        while self._reports:
            self.emit(*self._reports.popleft())

    def _react(self, breach: Breach | None) -> None:
        """Report new warnings; after a fault, open the hand or turn torque off."""
        state, control, safety = self.state, self._control, self._safety
        for warning in safety.warnings:
            self.emit("warning", *warning)
        safety.warnings.clear()
        if not control.torque:
            self._after_opening = None
            return
        if breach is not None:
            breach = breach._replace(text=self._with_cause(*breach))
            if safety.opens_first(breach, state.mode):
                self.emit("error", *breach)
                self._after_opening = breach
                control.release()
            else:
                self._fail(breach.text, breach.name)
        elif self._after_opening is not None and state.mode != Mode.RELEASING:
            self._fail(self._after_opening.text, self._after_opening.name)

    # Commands, events and faults

    def command(
        self, request: dict[str, Any], age: float = 0.0, by_task: bool = False
    ) -> dict[str, Any]:
        """Execute one request on the current tick; see `Requests.carry_out`.

        A request from any source other than the running task ends the task.
        """
        name = request["command"]
        if name == "status":
            if self._server is not None and self._server.link.refused:
                self._safety.limited["commands.pace"] = self._server.link.refused
            return self._requests.carry_out(request)
        try:
            reply = self._requests.carry_out(request, age, by_task)
        except Refused as refusal:
            self._publish_command(request, str(refusal))
            raise
        self._publish_command(request, "")
        self._commanded = True
        if name == "clear":
            self.state.fault = self.state.fault_name = ""
        if self._task is not None and not by_task:
            self._end_task(f"the command {name} was received")
        if name == "demo":
            self._task = Task.named(self._settings)
        return reply

    def _publish_command(self, request: dict[str, Any], error: str) -> None:
        if self._publisher is not None:
            state = self.state
            self._publisher.command(state.wall, state.t, state.seq, request, error)

    def _follow(self, task: Task) -> None:
        """Execute the task's next request; if execution fails, end or restart the task."""
        try:
            request = task.next(self.state, self.period)
            if request is not None:
                self.command(request, by_task=True)
        except (TaskEnded, Refused) as reason:
            if task.restarts:
                self.emit("warning", "task", task.restart(self.state, str(reason)))
            else:
                self._end_task(str(reason))
                self._requests.end_grip(self._settings.commands.on_silence)

    def _end_task(self, reason: str) -> None:
        self._task = None
        self.emit("warning", "task", f"task ended: {reason}")

    def emit(self, level: str, kind: str, text: str) -> None:
        """Publish an event and pass it to the log."""
        if self._publisher is not None:
            self._publisher.event(self.state.wall, self.state.t, level, kind, text)
        if self._on_event is not None:
            self._on_event(level, kind, text)

    def _with_cause(self, name: str, text: str) -> str:
        # Ignore the duration of a tick with a command, because the command may occupy the bus for a
        # long time.
        at_work = 0.0 if self._commanded else self._clock.host() - self._began
        return self._lateness.with_cause(name, text, at_work)

    def _fail(self, reason: str, name: str = BUS) -> None:
        """Latch a fault, unless another fault is latched."""
        if not self.state.fault:
            if name == BUS:
                reason = self._with_cause(name, reason)
            self.state.fault, self.state.fault_name = reason, name
            self._control.fail(reason, name)
            self._emit_events()
            self.state.mode = self._control.mode
