"""Messages packed by their layout say what the maps say, for any state."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import msgpack
import numpy as np
import pytest

from softfinger.daemon.types import Frame, Parts, State
from softfinger.daemon.wire.packer import message_maker, packer
from softfinger.daemon.wire.schema import INPUT, STATE
from softfinger.kinematics.estimation.invalid import Invalid

input_message = message_maker(INPUT)
state_message = message_maker(STATE)

ENDS: dict[type, tuple[Any, ...]] = {
    int: (0, 1, 127, 128, 2**31, 2**40),
    float: (0.0, -0.0, 1.5, -2.5e-300, 1e300, math.pi),
    bool: (False, True),
    Invalid: tuple(Invalid),
    str: ("", "left joint at 2.5 rad, outside its limits — ß"),
}


def shake(record: Any, generator: np.random.Generator) -> None:
    """Put other values into all of a record's fields and of those in it."""
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if dataclasses.is_dataclass(value):
            shake(value, generator)
        elif isinstance(value, list):
            for place, each in enumerate(value):
                if dataclasses.is_dataclass(each):
                    shake(each, generator)
                else:
                    value[place] = some(type(each), generator)
        else:
            setattr(record, field.name, some(type(value), generator))


def some(kind: type, generator: np.random.Generator) -> Any:
    return ENDS[kind][generator.integers(len(ENDS[kind]))]


@pytest.mark.parametrize("seed", range(20))
def test_both_ways_say_the_same(seed: int) -> None:
    generator = np.random.default_rng(seed)
    pack_state, pack_input, state = packer(STATE), packer(INPUT), State()
    for _ in range(30):
        shake(state, generator)
        state.t = generator.uniform(0.0, 1e6)
        scene = Parts((bool(seed & 1), True), bool(seed & 2), bool(seed & 4))
        told = msgpack.unpackb(pack_state(state, scene, seed + 1))
        assert same(told, state_message(state, scene, seed + 1))
        frame = Frame(some(int, generator), 1.25, 1.5, bool(seed & 1), np.zeros((2, 2), np.uint16))
        told = msgpack.unpackb(pack_input(state, (None, frame)))
        assert same(told, input_message(state, (None, frame)))


def same(found: Any, expected: Any) -> bool:
    """Equal with types, order of the keys and signs of zeros."""
    return repr(found) == repr(expected)


def test_what_is_no_number_yet_goes_out_as_it_is() -> None:
    state = State()  # no reading yet: its time is −∞, and a grip's goal is no number
    told = msgpack.unpackb(packer(INPUT)(state, (None, None)))
    assert told["reading"]["t"] == -math.inf
    told = msgpack.unpackb(packer(STATE)(state, Parts((True, True), True, True)))
    assert math.isnan(told["goal_force"])


def test_messages_of_one_topic_are_of_one_length_while_their_texts_stay() -> None:
    pack, scene, state = packer(STATE), Parts((True, True), True, True), State()
    first = pack(state, scene)
    state.seq, state.timing.overruns, state.torque = 2**40, 2**33, True
    assert len(pack(state, scene)) == len(first)
    state.mode = "holding"
    assert len(pack(state, scene)) == len(first) - 1
