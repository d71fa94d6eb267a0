"""The two maps that may go out at every tick, packed in one step; nothing decides here.

Which bytes of such a map change is known from the contract: its numbers. All else, the keys and the
few texts, is laid out once, until a text changes, so that packing is one call of `struct`. Integers
take 64 bits whatever their value, so that a topic's messages all have the same layout.
`wire.messages` tells the same maps field by field.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import Any

import msgpack

from softfinger.daemon.types import Frame, State
from softfinger.daemon.wire.messages import INPUT, SCHEMA, STATE, Parts
from softfinger.daemon.wire.schema import TOPICS, Field

FALSE = 0xC2  # msgpack's byte; true is the next
_MARKS = {"bool": (b"", "B"), "int": (b"\xd3", "q"), "float": (b"\xcb", "d")}

Texts = tuple[str, ...]
Numbers = list[float]  # or integers; a flag is a number, too: `FALSE` plus it


class FixedMap:
    """Packs the maps of one topic from their texts and numbers, each in the contract's order."""

    def __init__(self, fields: Sequence[Field]) -> None:
        self._tree: dict[str, Any] = {}
        for field in fields:
            *outer, name = field.name.split(".")
            place = self._tree
            for part in outer:
                place = place.setdefault(part, {})
            place[name] = field
        self._texts: Texts | None = None
        self._struct = struct.Struct("")
        self._parts: list[bytes | float] = []  # by turns what stays, and a number

    def pack(self, texts: Texts, numbers: Numbers) -> bytes:
        """The map as msgpack."""
        if texts != self._texts:
            self._lay_out(texts)
        self._parts[1::2] = numbers
        return self._struct.pack(*self._parts)

    def _lay_out(self, texts: Texts) -> None:
        """Find the bytes between the numbers."""
        form, fixed = ">", b""
        self._parts = []
        for part, code in self._pieces(self._tree, iter(texts)):
            fixed += part
            if code:
                form += f"{len(fixed)}s{code}"
                self._parts += [fixed, 0]
                fixed = b""
        # What stands behind the last number has none of its own.
        self._struct = struct.Struct(f"{form}{len(fixed)}s")
        self._parts.append(fixed)
        self._texts = texts

    def _pieces(self, tree: dict[str, Any], texts: Iterator[str]) -> Iterator[tuple[bytes, str]]:
        """Bytes that stay, each with the form of the number behind it, if one is."""
        yield msgpack.Packer().pack_map_header(len(tree)), ""
        for name, field in tree.items():
            yield msgpack.packb(name), ""
            if isinstance(field, dict):
                yield from self._pieces(field, texts)
            elif field.kind == "str":
                yield msgpack.packb(next(texts)), ""
            else:
                yield _MARKS[field.kind]


class StateMap(FixedMap):
    """``hand/state``."""

    def __init__(self) -> None:
        super().__init__(TOPICS[STATE])

    def __call__(self, state: State, scene: Parts, step: int = 1) -> bytes:
        """As `wire.messages.state_message`."""
        timing, reading, goal, pose = state.timing, state.reading, state.goal, state.object
        q, dq, current = reading.q, reading.dq, reading.current
        temperature, voltage = reading.temperature, reading.voltage
        goal_q, goal_current = goal.q, goal.current
        fingers, sensors, t = scene.fingers, scene.sensors, state.t
        read = reading.valid or not scene.servos
        numbers = [
            SCHEMA,
            state.seq,
            step,
            state.wall,
            int(t * 1e9),
            FALSE + state.torque,
            timing.tick_s,
            timing.compute_s,
            timing.wake_late_s,
            timing.overruns,
            timing.behind_s,
            goal.force,
            goal.angle,
        ]
        for finger, contact in enumerate(state.contacts):
            numbers += (
                FALSE + (fingers[finger] and read and (contact.valid or not sensors)),
                q[finger],
                dq[finger],
                current[finger],
                temperature[finger],
                voltage[finger],
                goal_q[finger],
                goal_current[finger],
                contact.d,
                contact.theta,
                contact.tilt_y,
                contact.force,
                contact.energy,
                contact.d_std,
                contact.theta_std,
                contact.gain,
                FALSE + contact.misfit,
                FALSE + contact.contact,
                contact.seq,
                t - contact.t if contact.seq else 0.0,
            )
        numbers += (FALSE + pose.valid, pose.angle, pose.width)
        return self.pack((state.mode, state.fault, state.fault_name), numbers)


class InputMap(FixedMap):
    """``hand/input``."""

    def __init__(self) -> None:
        super().__init__(TOPICS[INPUT])

    def __call__(self, state: State, frames: tuple[Frame | None, Frame | None]) -> bytes:
        """As `wire.messages.input_message`."""
        reading = state.reading
        numbers = [
            SCHEMA,
            state.seq,
            state.wall,
            int(state.t * 1e9),
            state.t,
            state.timing.late_in_row,
            state.timing.busy_s,
            reading.seq,
            reading.t,
            FALSE + reading.valid,
            reading.alert,
            reading.lost,
            reading.frozen,
        ]
        for finger, frame in enumerate(frames):
            numbers += (
                reading.q[finger],
                reading.dq[finger],
                reading.current[finger],
                reading.hardware[finger],
                reading.temperature[finger],
                reading.voltage[finger],
            )
            if frame is None:
                numbers += (0, 0.0, 0.0, FALSE)
            else:
                numbers += (frame.seq, frame.t_sample, frame.t_arrival, FALSE + frame.valid)
        numbers.append(FALSE + state.torque_off)
        return self.pack((state.read_error, state.write_error), numbers)
