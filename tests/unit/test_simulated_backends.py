"""Test the servos, sensors and frame arrival times of the simulated hand in virtual time."""

import math
from itertools import pairwise

import numpy as np
import pytest

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.simulated import SimulatedServos
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.simulation.simulated_tactile import Arrivals, SimulatedTactile
from softfinger.daemon.types import Goal, Reading
from tests.harness.plant import PAPER
from tests.harness.servos import RADIAN

CURRENT_UNIT = 2.69e-3


class Bench:
    """A hand with its servos and sensors on one virtual clock."""

    def __init__(self, **sections) -> None:
        sections.setdefault("material", {"law": "constant"})
        self.settings = Settings.model_validate(sections)
        self.clock = VirtualClock()
        self.hand = SimulatedHand(self.settings, table=PAPER)
        self.servos = SimulatedServos(self.settings, self.hand, self.clock)
        self.sensors = [
            SimulatedTactile(self.settings, self.hand, self.clock, finger) for finger in (0, 1)
        ]
        self.reading = Reading()
        self.goal = Goal()

    def run(self, seconds: float, period: float = 0.002) -> None:
        """Read the joints and then write the goal on each tick, as the loop does."""
        end = self.clock.now() + seconds
        while self.clock.now() < end - 1e-9:
            self.clock.sleep_until(self.clock.now() + period)
            self.servos.read(self.reading)
            self.servos.write(self.goal)

    def grasp(self, current: float = 0.5, seconds: float = 1.0) -> None:
        self.servos.connect()
        self.servos.torque_on()
        self.goal.q = [0.6] * 2
        self.goal.current = [current] * 2
        self.run(seconds)


# Servos.


def test_a_hardware_error_persists_until_torque_is_off():
    bench = Bench(servos={"current_limit": (0.3, 0.3)})
    bench.grasp(current=0.3, seconds=4.0)  # After the overload, the motors draw no current.
    assert bench.reading.alert == 0b11
    assert np.abs(bench.hand.current).max() < 1e-6
    assert bench.servos.torque_off(bench.reading)
    bench.clock.sleep_until(bench.clock.now() + 0.5)
    bench.servos.read(bench.reading)
    assert bench.reading.alert == 0


def test_goals_are_whole_counts():
    bench = Bench()
    bench.servos.connect()
    bench.servos.torque_on()
    bench.goal.q = [0.1003] * 2
    bench.goal.current = [0.3] * 2
    bench.run(1.0)

    goal_q, bound = bench.hand.plant.goals.q, bench.hand.plant.goals.current
    np.testing.assert_allclose(goal_q / RADIAN, np.round(0.1003 / RADIAN), rtol=1e-12)
    # The limit is rounded down, so that the servo never exceeds it.
    np.testing.assert_allclose(bound / CURRENT_UNIT, math.floor(0.3 / CURRENT_UNIT), rtol=1e-12)


def test_the_watchdog_turns_torque_off_only_without_exchanges():
    bench = Bench(servos={"watchdog": 0.1})
    bench.grasp(0.5, 1.0)
    assert bench.hand.force.min() > 5
    # An exchange every 90 ms keeps torque on.
    bench.run(1.8, period=0.09)
    assert bench.hand.force.min() > 5
    assert bench.servos.counters()["watchdog"] == 0
    # If communication stops, the plant turns torque off by itself.
    bench.hand.advance(bench.clock.now() + 0.099)
    assert np.abs(bench.hand.current).min() > 0.4
    bench.hand.advance(bench.clock.now() + 0.120)
    assert np.abs(bench.hand.current).max() < 1e-3
    bench.clock.sleep_until(bench.clock.now() + 0.5)
    bench.servos.read(bench.reading)
    assert bench.servos.counters()["watchdog"] == 1
    with pytest.raises(ServoError, match="bus watchdog stopped the simulated servos"):
        bench.run(0.3)
    assert np.abs(bench.hand.current).max() == pytest.approx(0, abs=1e-6)
    bench.servos.torque_on()
    bench.run(1.0)
    assert bench.hand.force.min() > 5
    without = Bench(servos={"watchdog": 0.0})
    without.grasp(0.5, 1.0)
    without.clock.sleep_until(without.clock.now() + 5.0)
    without.servos.read(without.reading)
    assert without.hand.force.min() > 5


# Tactile.


def test_a_tip_softer_than_the_settings_gives_less_pressure():
    sums = []
    for scale in (1.0, 0.7):
        bench = Bench(
            simulation={
                "modulus_scale": scale,
                "compression_speed": 0.02,
                "tactile_noise": 0.0,
            },
            servos={"backend": "none"},
        )
        sensor = bench.sensors[0]
        sensor.open()
        # The object moves by 18 mm at 20 mm/s onto the left tip.
        bench.clock.sleep_until(0.8)
        frame = sensor.latest()
        sums.append(float(frame.data.sum()) * 4.0 * bench.settings.tactile.pitch**2)
        d = 0.02 * frame.t_sample - 0.010
        assert sums[-1] == pytest.approx(scale * math.pi * 0.304e6 * d * d, rel=5e-3)
    assert sums[1] == pytest.approx(0.7 * sums[0], rel=1e-2)


def test_the_sample_is_available_after_a_long_delay():
    bench = Bench(tactile={"latency": 0.5}, simulation={"tactile_delay": 0.5})
    sensor = bench.sensors[0]
    sensor.open()
    for _ in range(100):
        bench.clock.sleep_until(bench.clock.now() + 0.0137)
        frame = sensor.latest()
        assert 0.5 - 1e-6 <= bench.clock.now() - frame.t_sample < 0.51 + 1e-6


def collect(arrivals, until, step=0.0005):
    """Poll every ``step`` [s]; return the number and the arrival time of each new frame."""
    found = []
    for k in range(round(until / step)):
        if arrivals.take(k * step):
            found.append((arrivals.number, arrivals.arrival))
    return found


def test_without_randomness_each_frame_arrives_after_its_delay():
    arrivals = Arrivals(1.0, 0.01, 0.004)
    assert not arrivals.take(1.0039)
    assert arrivals.take(1.004)
    assert (arrivals.number, arrivals.arrival) == (0, 1.004)
    assert arrivals.take(1.2)
    assert (arrivals.number, arrivals.missed) == (19, 0)


def test_dropped_frames_count_as_missed_once_a_later_one_arrives():
    arrivals = Arrivals(0.0, 0.01, 0.0, dropped=0.2, seed=(3,))
    found = collect(arrivals, 50.0, 0.01)
    numbers = np.array([number for number, _ in found])
    assert len(numbers) + arrivals.missed == arrivals.number + 1 == numbers[-1] + 1
    # The standard deviation is 0.0057.
    assert arrivals.missed / 5000 == pytest.approx(0.2, abs=0.025)
    assert np.diff(numbers).max() > 2


@pytest.mark.parametrize("jitter", [0.004, 0.03])
def test_late_frames_arrive_in_order_within_the_jitter(jitter):
    arrivals = Arrivals(0.0, 0.01, 0.005, jitter=jitter, seed=(5,))
    found = collect(arrivals, 20.0)
    lateness = np.array([arrival - number * 0.01 - 0.005 for number, arrival in found])
    assert lateness.min() >= -1e-12
    assert lateness.max() <= jitter
    assert np.all(np.diff([arrival for _, arrival in found]) >= 0.0)
    assert arrivals.missed == 0
    if jitter < 0.01:
        assert len(found) == arrivals.number + 1
        assert lateness.mean() == pytest.approx(jitter / 2, rel=0.1)


def test_the_polling_rate_does_not_affect_arrivals():
    often, seldom = (Arrivals(0.0, 0.01, 0.0, 0.3, 0.02, (7,)) for _ in range(2))
    times = dict(collect(often, 5.0, 0.001))
    for number, arrival in collect(seldom, 5.0, 0.083):
        assert times.get(number, arrival) == arrival
    for arrivals in (often, seldom):
        arrivals.take(5.0)
    assert (often.number, often.missed) == (seldom.number, seldom.missed)


def simulated(**simulation):
    simulation = {"compression_speed": 0.02, "tactile_noise": 0.0, **simulation}
    bench = Bench(servos={"backend": "none"}, simulation=simulation)
    return bench.sensors[0], bench.clock, bench.hand


def test_skipped_sequence_numbers_of_a_sensor_are_counted():
    sensor, clock, _ = simulated(tactile_dropped=0.3, tactile_jitter=0.006)
    sensor.open()
    frames = [sensor.latest()]
    for _ in range(1000):
        clock.sleep_until(clock.now() + 0.002)
        frame = sensor.latest()
        if frame is not frames[-1]:
            frames.append(frame)
            assert frame.valid
            assert frame.t_sample == pytest.approx((frame.seq - 1) * 0.01)
            assert frame.t_sample + 0.020 <= frame.t_arrival <= frame.t_sample + 0.026 + 1e-9
            assert frame.t_arrival <= clock.now() + 1e-8
    gaps = sum(b.seq - a.seq - 1 for a, b in pairwise(frames))
    counters = sensor.counters()
    assert counters["frames"] == len(frames)
    assert counters["missed"] == gaps + frames[0].seq - 1
    assert 30 < counters["missed"] < 90


def test_a_frame_whose_sample_is_no_longer_stored_counts_as_missed():
    sensor, clock, hand = simulated(tactile_dropped=0.9, seed=2)
    sensor.open()
    for _ in range(40):
        clock.sleep_until(clock.now() + 0.5)
        hand.advance(clock.now())
        frame = sensor.latest()
        assert frame is sensor.latest()
    counters = sensor.counters()
    arrivals = sensor._arrivals
    assert counters["frames"] + counters["missed"] == arrivals.number + 1
    assert counters["missed"] > arrivals.missed


def test_cells_with_creep_include_frames_that_were_not_read():
    def forces(step):
        sensor, clock, _ = simulated(tactile_creep=0.3, tactile_creep_time=0.2)
        sensor.open()
        for k in range(1, round(0.96 / step) + 1):
            clock.sleep_until(0.011 + k * step)
            frame = sensor.latest()
        return frame

    each, every_sixth = forces(0.01), forces(0.06)
    assert each.seq == every_sixth.seq
    assert each.data.any()
    np.testing.assert_array_equal(each.data, every_sixth.data)
