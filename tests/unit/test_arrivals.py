"""When simulated frames arrive, and what the sensors and boards over them count."""

from itertools import pairwise

import numpy as np
import pytest

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.simulation.sensor.simulated_tactile import Arrivals, SimulatedTactile
from tests.harness.plant import PAPER


def collect(arrivals, until, step=0.0005):
    """(number, arrival) of each newest frame, asked for every ``step`` [s]."""
    found = []
    for k in range(round(until / step)):
        if arrivals.take(k * step):
            found.append((arrivals.number, arrivals.arrival))
    return found


def test_without_chance_each_frame_comes_after_its_delay():
    arrivals = Arrivals(1.0, 0.01, 0.004)
    assert not arrivals.take(1.0039)
    assert arrivals.take(1.004)
    assert (arrivals.number, arrivals.arrival) == (0, 1.004)
    assert arrivals.take(1.2)
    assert arrivals.number == 19
    assert (arrivals.arrived, arrivals.missed) == (20, 0)


def test_dropped_frames_are_missed_once_a_later_one_came():
    arrivals = Arrivals(0.0, 0.01, 0.0, dropped=0.2, seed=(3,))
    found = collect(arrivals, 50.0, 0.01)
    numbers = np.array([number for number, _ in found])
    assert len(numbers) == arrivals.arrived
    assert arrivals.arrived + arrivals.missed == numbers[-1] + 1
    assert arrivals.missed / 5000 == pytest.approx(0.2, abs=0.02)
    assert np.diff(numbers).max() > 2


@pytest.mark.parametrize("jitter", [0.004, 0.03])
def test_late_frames_come_in_order_within_the_jitter(jitter):
    arrivals = Arrivals(0.0, 0.01, 0.005, jitter=jitter, seed=(5,))
    found = collect(arrivals, 20.0)
    lateness = np.array([arrival - number * 0.01 - 0.005 for number, arrival in found])
    assert lateness.min() >= -1e-12
    assert lateness.max() <= jitter
    assert np.all(np.diff([arrival for _, arrival in found]) >= 0.0)
    assert arrivals.missed == 0
    assert arrivals.arrived == arrivals.number + 1
    if jitter < 0.01:
        assert len(found) == arrivals.arrived
        assert lateness.mean() == pytest.approx(jitter / 2, rel=0.1)


def test_who_asks_how_often_makes_no_difference():
    often, seldom = (Arrivals(0.0, 0.01, 0.0, 0.3, 0.02, (7,)) for _ in range(2))
    times = dict(collect(often, 5.0, 0.001))
    for number, arrival in collect(seldom, 5.0, 0.083):
        assert times.get(number, arrival) == arrival
    for arrivals in (often, seldom):
        arrivals.take(5.0)
    assert (often.number, often.arrived, often.missed) == (
        seldom.number,
        seldom.arrived,
        seldom.missed,
    )


def simulated(simulation, tactile=None):
    settings = Settings.model_validate(
        {
            "material": {"law": "constant"},
            "servos": {"backend": "none"},
            "simulation": {"compression_speed": 0.02, "tactile_noise": 0.0, **simulation},
            "tactile": tactile or {},
        }
    )
    clock = VirtualClock()
    hand = SimulatedHand(settings, table=PAPER)
    return SimulatedTactile(settings, hand, clock, 0), clock, hand


def test_the_sensor_skips_sequence_numbers_and_counts_them():
    sensor, clock, _ = simulated({"tactile_dropped": 0.3, "tactile_jitter": 0.006})
    sensor.open()
    frames = [sensor.latest()]
    for _ in range(1000):
        clock.sleep_until(clock.now() + 0.002)
        frame = sensor.latest()
        if frame is not frames[-1]:
            frames.append(frame)
            assert frame.valid
            assert frame.t_sample == pytest.approx((frame.seq - 1) * 0.01)
            assert frame.t_sample + 0.010 <= frame.t_arrival <= frame.t_sample + 0.016 + 1e-9
            assert frame.t_arrival <= clock.now() + 1e-8
    gaps = sum(b.seq - a.seq - 1 for a, b in pairwise(frames))
    counters = sensor.counters()
    assert counters["frames"] == len(frames)
    assert counters["missed"] == gaps + frames[0].seq - 1
    assert 30 < counters["missed"] < 90


def test_a_frame_whose_instant_the_plant_forgot_is_missed_not_made_up():
    sensor, clock, hand = simulated({"tactile_dropped": 0.9, "seed": 2})
    sensor.open()
    for _ in range(40):
        clock.sleep_until(clock.now() + 0.5)
        hand.advance(clock.now())
        frame = sensor.latest()
        assert frame is sensor.latest()
    counters = sensor.counters()
    arrivals = sensor._arrivals
    assert counters["frames"] + counters["missed"] == arrivals.number + 1
    assert counters["frames"] < arrivals.arrived


def test_cells_with_a_memory_feel_frames_that_nobody_asked_for():
    def forces(step):
        sensor, clock, _ = simulated({"tactile_creep": 0.3, "tactile_creep_time": 0.2})
        sensor.open()
        for k in range(1, round(0.96 / step) + 1):
            clock.sleep_until(0.011 + k * step)
            frame = sensor.latest()
        return frame

    each, every_sixth = forces(0.01), forces(0.06)
    assert each.seq == every_sixth.seq
    assert each.data.any()
    np.testing.assert_array_equal(each.data, every_sixth.data)
