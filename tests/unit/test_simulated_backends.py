"""The in-process servos and tactile sensors of the simulated hand, on a virtual clock."""

import math

import numpy as np
import pytest

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.simulated import SimulatedServos
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.simulation.sensor.simulated_tactile import SimulatedTactile
from softfinger.daemon.types import Goal, Reading
from tests.harness.plant import PAPER

COUNT = 2 * math.pi / 4096
CURRENT_UNIT = 2.69e-3
SPEED_UNIT = 0.229 * 2 * math.pi / 60


class Bench:
    """A hand, its servos and its sensors on one virtual clock."""

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
        """Tick as the loop does: read, then write the goal."""
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


def test_goals_are_whole_counts_too():
    bench = Bench()
    bench.servos.connect()
    bench.servos.torque_on()
    bench.goal.q = [0.1003] * 2
    bench.goal.current = [0.3] * 2
    bench.run(1.0)

    goal_q, bound = bench.hand.plant.goals.q, bench.hand.plant.goals.current
    np.testing.assert_allclose(goal_q / COUNT, np.round(0.1003 / COUNT), rtol=1e-12)
    # A bound is rounded down, so that it stays one.
    np.testing.assert_allclose(bound / CURRENT_UNIT, math.floor(0.3 / CURRENT_UNIT), rtol=1e-12)


def test_watchdog_takes_torque_off_in_silence_only():
    bench = Bench(servos={"watchdog": 0.1})
    bench.grasp(0.5, 1.0)
    assert bench.hand.force.min() > 5
    # Exchanges every 90 ms keep it on.
    bench.run(1.8, period=0.09)
    assert bench.hand.force.min() > 5
    assert bench.servos.counters()["watchdog"] == 0
    # Silence: the hand opens by itself, whoever moves its time.
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


def test_a_softer_tip_than_the_settings_reads_less_pressure():
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
        # Onto the left tip: 18 mm of way at 20 mm/s.
        bench.clock.sleep_until(0.8)
        frame = sensor.latest()
        sums.append(float(frame.data.sum()) * 4.0 * bench.settings.tactile.pitch**2)
        d = 0.02 * frame.t_sample - 0.010
        assert sums[-1] == pytest.approx(scale * math.pi * 0.304e6 * d * d, rel=5e-3)
    assert sums[1] == pytest.approx(0.7 * sums[0], rel=1e-2)


def test_a_long_delay_still_finds_its_sample():
    bench = Bench(simulation={"tactile_delay": 0.5})
    sensor = bench.sensors[0]
    sensor.open()
    for _ in range(100):
        bench.clock.sleep_until(bench.clock.now() + 0.0137)
        frame = sensor.latest()
        assert 0.5 - 1e-6 <= bench.clock.now() - frame.t_sample < 0.51 + 1e-6
