"""Generate sample messages for every topic, and their golden bytes in ``tests/golden/``.

Run ``python -m tests.harness.golden_wire`` after adding a field.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from softfinger.daemon.loop.timing import Statistics, record
from softfinger.daemon.types import Frame, HandInfo, SceneParts, SensorInfo, State
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import packer
from softfinger.kinematics.estimation.invalid import Invalid


def message_maker(topic: bytes) -> Callable[..., dict[str, Any]]:
    """Return the function that builds a topic's message from its arguments."""
    pack = packer(topic)
    return lambda *arguments: msgpack.unpackb(pack(*arguments))


def golden_file(topic: bytes) -> Path:
    """Return the path of a topic's golden bytes."""
    name = f"{topic.decode().replace('/', '-')}.msgpack"
    return Path(__file__).parents[1] / "golden" / name


class SampleTruth:
    d = np.array([0.004, -0.001])
    theta = np.array([0.1, -0.1])
    force = np.array([10.5, 0.0])
    object_pose = np.array([0.001, 0.08, 0.05])


def sample_state() -> State:
    """Return a state whose fields all have different values."""
    state = State(seq=1234, t=12.5, wall=1.7e9 + 0.25, mode="holding", fault="", torque=True)
    state.reading.seq, state.reading.t, state.reading.valid = 1234, 12.4995, True
    state.timing.tick_s, state.timing.compute_s = 0.002, 15.5e-6
    state.timing.wake_late_s, state.timing.overruns = 3.25e-6, 2
    state.timing.behind_s, state.timing.busy_s = 1.875, 0.15625
    for finger, contact in enumerate(state.contacts):
        sign = 1.0 - 2.0 * finger
        state.reading.q[finger] = 0.25 + 0.0625 * finger
        state.reading.dq[finger] = 0.125 * sign
        state.reading.current[finger] = 0.5 + finger
        state.goal.q[finger] = 0.375 + 0.0625 * finger
        state.goal.current[finger] = 0.75 + finger
        contact.seq, contact.t, contact.contact = 77 + finger, 12.48, True
        contact.invalid = Invalid.NONE
        contact.d, contact.theta, contact.tilt_y = 0.004, 0.1 * sign, 0.01 * sign
        contact.d_std, contact.theta_std, contact.gain = 2e-5, 1e-3, 1.01
        contact.force_std = 0.03
        contact.modulus_scale, contact.modulus_scale_std = 1.125, 0.0625 + finger
        contact.sensor_gain, contact.sensor_gain_std = 0.875, 0.09375 + finger
        contact.torque_scale, contact.torque_scale_std = 1.03125, 0.046875 + finger
        contact.nis_angle, contact.nis_footprint = 1.25 + finger, 0.9375 + finger
        contact.nis_amplitude = 1.0625 + finger
        contact.shear_x, contact.shear_y = 0.75 * sign, 0.03125 * sign
        contact.force, contact.energy = 10.5 + finger, 0.0125 + finger
        heat = state.heat[finger]
        heat.winding, heat.winding_std = 61.5 + finger, 2.25 + finger
        heat.case, heat.case_std = 48.25 + finger, 0.28125 + finger
        heat.time_to_limit = 1800.5 + finger
    state.goal.force, state.goal.angle = 11.25, 0.0625
    state.object.valid, state.object.angle, state.object.width = True, 0.05, 0.04
    state.object.nis_torque, state.object.nis_balance = 0.84375, 1.15625
    return state


def arguments(topic: bytes) -> tuple[Any, ...]:
    """Return the arguments of the topic's sample message."""
    state, wall, t = sample_state(), 1.7e9 + 0.25, 12.5
    if topic == schema.STATE:
        return state, SceneParts(fingers=(True, True), has_servos=True, has_sensors=True), 5
    if topic == schema.TACTILE:
        counts = np.arange(20, dtype=np.uint16).reshape(4, 5) * 3000
        frame = Frame(seq=77, t_sample=12.48, t_arrival=12.49, valid=True, data=counts)
        facts = SensorInfo(
            pitch=0.0013,
            pitch_y=0.0014,
            centre_x=1e-4,
            centre_y=-2e-4,
            rotation=0.01,
            unit="count",
            scale=4.0,
            calibrated=False,
            calibration="",
        )
        return frame, counts, 1, facts, 1.7e9 + 0.23, 4, 19
    if topic == schema.STATS:
        statistics = Statistics()
        for k in range(1, 100):
            times = (1e-6 * k, 10e-6 * k, 3e-6 * k, 2e-6 * k)
            record(statistics.counts, statistics.largest, times)
        rates = schema.Rates(500.0, 100.0, 99.5, 50.0, 25.0)
        return state, 0.002, rates, statistics.ticks, statistics.spreads(), 500
    if topic == schema.TRUTH:
        return state, SampleTruth(), 5
    if topic == schema.INPUT:
        frame = Frame(77, t_sample=12.48, t_arrival=12.49, valid=True, data=np.zeros((4, 5), "<u2"))
        return state, (frame, None)
    if topic == schema.SETTINGS:
        facts = HandInfo("0.1.0", '{"loop":{"rate":500.0}}', "", "{}", "{}", "{}")
        return 1, 1.7e9, 10.0, facts
    if topic == schema.COMMAND:
        request = {"command": "grasp", "force": 5.0, "client": "notebook"}
        return 3, wall, t, 1234, request, "arm first"
    assert topic == schema.EVENT
    return 5, wall, t, "warning", "late", "a tick came late — ß"


def sample(topic: bytes) -> dict[str, Any]:
    """Return a sample message of the topic."""
    return message_maker(topic)(*arguments(topic))


def flat(message: dict[str, Any], outer: str = "") -> dict[str, Any]:
    """Flatten nested maps; for example, the key q in the map ``left`` becomes ``left.q``."""
    found: dict[str, Any] = {}
    for key, value in message.items():
        name = f"{outer}{key}"
        found |= flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return found


if __name__ == "__main__":
    for topic in schema.TOPICS:
        golden_file(topic).write_bytes(packer(topic)(*arguments(topic)))
