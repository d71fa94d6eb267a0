"""Test that measurement faults are parsed, and that they affect only the sensors."""

import numpy as np
import pytest

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.simulation.faults import (
    MEASUREMENT_FAULTS,
    FaultError,
    MeasurementFaults,
    parse_faults,
)
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.simulation.servo_model.servo_bus import ServoBus
from softfinger.daemon.simulation.simulated_tactile import SimulatedTactile
from tests.harness.servos import BusClient

SHAPE = (5, 7)


class Press:
    """Sensor of a left tip whose indentation increases steadily."""

    def __init__(self, **simulation) -> None:
        self.settings = Settings.model_validate(
            {
                "servos": {"backend": "none"},
                "simulation": {"compression_speed": 0.01, "tactile_noise": 0.0, **simulation},
            }
        )
        self.clock = VirtualClock()
        self.hand = SimulatedHand(self.settings)
        self.sensor = SimulatedTactile(self.settings, self.hand, self.clock, 0)
        self.sensor.open()
        self.faults = self.hand.measurement_faults[0]

    def frames(self, count: int) -> list[np.ndarray]:
        """Return the counts of the next frames; check that each frame has a new number and time."""
        found = []
        for _ in range(count):
            before = self.sensor.latest()
            self.clock.sleep_until(self.clock.now() + 0.01)
            frame = self.sensor.latest()
            assert frame.seq == before.seq + 1
            assert frame.t_sample == pytest.approx(before.t_sample + 0.01)
            assert frame.valid
            found.append(frame.data)
        return found

    def pressed(self, count: int) -> list[np.ndarray]:
        """Compress the tip for 1.4 s, then return the given number of frames."""
        self.clock.sleep_until(1.4)
        self.sensor.latest()
        return self.frames(count)


def signal() -> np.ndarray:
    return np.arange(1.0, 36.0).reshape(SHAPE)


def applied(*faults: tuple[str, float], t: float = 0.0) -> np.ndarray:
    made, image = MeasurementFaults(), signal()
    for kind, value in faults:
        made.begin(kind, value, 0.0)
    made.apply(image, 1000, t)
    return image


def test_each_kind_changes_the_image_as_its_name_says():
    image = signal()
    np.testing.assert_array_equal(applied(), image)
    np.testing.assert_array_equal(applied(("gain", 0.5)), 0.5 * image)
    np.testing.assert_array_equal(applied(("drift", -0.02)), image - 20.0)
    np.testing.assert_array_equal(applied(("mirror", 1.0)), image[:, ::-1])
    right = applied(("shift-x", 2.0))
    np.testing.assert_array_equal(right[:, 2:], image[:, :-2])
    assert not right[:, :2].any()
    up = applied(("shift-y", -3.0))
    np.testing.assert_array_equal(up[:-3], image[3:])
    assert not up[-3:].any()
    between = applied(("shift-x", 0.25))
    np.testing.assert_allclose(between[:, 1:], 0.75 * image[:, 1:] + 0.25 * image[:, :-1])
    np.testing.assert_array_equal(applied(("current", 3.0)), image)
    np.testing.assert_array_equal(applied(("gain", 2.0), ("gain", 1.0)), image)


def test_faults_develop_linearly_over_their_duration_and_end():
    faults = MeasurementFaults()
    faults.begin("gain", 0.5, 3.0, 2.0)
    assert [faults("gain", t) for t in (0.0, 3.0, 4.0, 4.5, 5.0, 9.0)] == [
        *(1.0, 1.0, 0.75, 0.625, 0.5, 0.5)
    ]
    faults.begin("gain", 2.625, 4.5, 4.0)  # This ramp starts from the present value.
    assert [faults("gain", t) for t in (4.5, 6.5, 8.5)] == [0.625, 1.625, 2.625]
    faults.begin("drift", 0.1, 7.0)
    assert [faults("drift", t) for t in (6.999, 7.0)] == [0.0, 0.1]
    faults.clear()
    assert {kind: faults(kind, 9.0) for kind in MEASUREMENT_FAULTS} == {
        kind: neutral for kind, (neutral, *_) in MEASUREMENT_FAULTS.items()
    }
    with pytest.raises(KeyError):
        faults.begin("smell", 1.0, 0.0)


def test_a_faulty_sensor_does_not_affect_the_tip():
    honest, lying = Press(), Press()
    lying.faults.begin("gain", 0.5, 1.45, 0.1)
    true, read = honest.pressed(30), lying.pressed(30)
    sums = np.array([b.sum() / a.sum() for a, b in zip(true, read, strict=True)])
    instants = 1.39 + 0.01 * np.arange(30)
    np.testing.assert_allclose(sums, np.interp(instants, [1.45, 1.55], [1.0, 0.5]), atol=2e-3)
    np.testing.assert_array_equal(honest.hand.force, lying.hand.force)
    # The other finger has no faults.
    assert lying.hand.measurement_faults[1]("gain", 9.0) == 1.0


def test_frames_are_repeated_with_new_numbers():
    press = Press()
    kept = press.pressed(20)
    assert len({each.tobytes() for each in kept}) == 20
    press.faults.begin("replay", 0.06, press.clock.now())
    again = press.frames(18)
    # The sensor delivers each frame one period late, so the first frame was measured before the
    # fault.
    last = [*kept, again[0]][-6:]
    assert [each.tobytes() for each in again[1:]] == [
        last[k % 6].tobytes() for k in range(len(again) - 1)
    ]
    press.faults.clear()
    assert press.frames(3)[-1].sum() > kept[-1].sum()


def test_each_sensor_has_its_own_gain():
    total = []
    for gain in ([1.0, 1.0], [0.7, 1.0], [1.0, 0.7]):
        total.append(float(Press(tactile_gain=tuple(gain)).pressed(1)[0].sum()))
    assert total[1] == pytest.approx(0.7 * total[0], rel=2e-3)
    assert total[2] == total[0]


def test_a_servo_reports_a_current_other_than_the_actual_one():
    settings = Settings()
    hand = SimulatedHand(settings)
    client = BusClient(ServoBus.from_settings(settings, hand))
    unit = client.bus.servos[0].model.current_unit
    signs = settings.servos.direction
    for servo, sign in zip((1, 2), signs, strict=True):
        client.write(reg.TORQUE_ENABLE, 1, 1, servo)
        client.write(reg.GOAL_CURRENT, 200, 2, servo)
        client.write(reg.GOAL_POSITION, 2048 + sign * 600, 4, servo)
    client.later(1.5 - client.t)
    flows = hand.current.copy()
    assert np.all(flows > 0.9 * 200 * unit)
    hand.measurement_faults[1].begin("current", 0.5, 1.0, 1.0)
    assert [hand.measured_current(0), hand.measured_current(1)] == [flows[0], 0.75 * flows[1]]
    client.later(1.0)
    counts = [
        sign * client.read(reg.PRESENT_CURRENT, 2, servo)
        for servo, sign in zip((1, 2), signs, strict=True)
    ]
    assert counts == [round(hand.current[0] / unit), round(0.5 * hand.current[1] / unit)]
    # The hand reaches the goal despite the fault.
    np.testing.assert_allclose(hand.current, flows, rtol=0.02)


def test_faults_are_parsed():
    words = [" silent=2@3 ", "silent", "left:torn=0.2", "right:frozen@1e1", "drop=0.1", "unplug@2"]
    assert parse_faults(words, (1, 2)) == [
        (0.0, "left", "silent", 1.0, 0.0),
        (0.0, "right", "silent", 1.0, 0.0),
        (0.0, "left", "torn", 0.2, 0.0),
        (0.0, "servos", "drop", 0.1, 0.0),
        (2.0, "servos", "unplug", 1.0, 0.0),
        (3.0, "servos", "silent", 2.0, 0.0),
        (10.0, "right", "frozen", 1.0, 0.0),
    ]
    assert parse_faults(["twist=-0.3@1", "push=15"], (1, 2)) == [
        (0.0, "object", "push", 15.0, 0.0),
        (1.0, "object", "twist", -0.3, 0.0),
    ]
    assert parse_faults(["well", "left:well@1", "right:plug", "noisy"], (1, 2)) == [
        (0.0, "all", "well", 1.0, 0.0),
        (0.0, "right", "plug", 1.0, 0.0),
        (0.0, "left", "noisy", 0.1, 0.0),
        (0.0, "right", "noisy", 0.1, 0.0),
        (1.0, "left", "well", 1.0, 0.0),
    ]
    assert parse_faults(["left:gain=0.5@3..5", "current=2", "drift=-.2@.5...75"], (1, 2)) == [
        (0.0, "left", "current", 2.0, 0.0),
        (0.0, "right", "current", 2.0, 0.0),
        (0.5, "left", "drift", -0.2, 0.25),
        (0.5, "right", "drift", -0.2, 0.25),
        (3.0, "left", "gain", 0.5, 2.0),
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "wrong-size"),
        ("melted", "wrong-size"),
        ("left:melted", "wrong-size"),
        ("left:drop=0.1", "wrong-size"),
        ("drop", "drop, late, .* =PROBABILITY"),
        ("middle:torn", "'left:' or 'right:'"),
        ("push", "push, twist =NUMBER"),
        ("push=inf", "not a number"),
        ("push=1e300", r"found 1e\+300, expected -1e\+06 to 1e\+06 \(number\)"),
        ("gain", "gain, shift-x, .* =NUMBER"),
        ("gain=-1", "0 to 100"),
        ("drift=1.5", "-1 to 1"),
        ("replay=4", "0 to 3"),
        ("gain=2@3..1", "found the end time '1', expected at least 3 s"),
        ("gain=2@3..", "found the end time '', expected at least 3 s"),
        ("mirror=1@1..2", "mirror does not change gradually; give a single start time such as @1"),
        ("push=3@1..2", "push does not change gradually; give a single start time such as @1"),
        ("torn=2", "0 to 1"),
        ("left:silent=2", "0 to 1"),
        ("drop=7", "0 to 1"),
        ("torn=much", "not a number"),
        ("torn@never", "expected at least 0 s"),
        ("torn@-1", "expected at least 0 s"),
        ("drop=0.1@inf", "expected at least 0 s"),
        ("silent=9", "no servo has this ID"),
        ("reboot=1.5", "no servo has this ID"),
    ],
)
def test_invalid_faults_are_refused(text, told):
    with pytest.raises(FaultError, match=told):
        parse_faults([text], (1, 2))
