"""Test the plate that presses on an emulated tip, with valid and invalid input."""

import math

import pytest

from softfinger import ContactTable, Material
from softfinger.daemon.simulation.emulator.plate import Plate, PlateError, parse_presses
from softfinger.daemon.simulation.simulated_tactile import StageTouch
from tests.harness.paper_tip import TIP

TABLE = ContactTable.build(TIP, Material.constant(0.3e6))
FORCE = math.pi * 0.3e6 * 0.004**2  # force at 4 mm [N]


def test_presses_are_parsed():
    words = (
        "tip=left depth=4mm tilt=10deg speed=2mm/s hold=500ms, force=5N, tip=right pressure=2kPa"
    )
    both = parse_presses(words, TABLE, 1.0)
    first, second = both["left"]
    assert (first.d, first.speed, first.hold) == pytest.approx((0.004, 0.002, 0.5))
    assert first.theta == pytest.approx(math.radians(10.0))
    assert first.force == pytest.approx(FORCE / math.cos(first.theta))
    assert (second.force, second.hold) == pytest.approx((5.0, 1.0), rel=1e-4)
    assert second.d == pytest.approx(math.sqrt(5.0 / (math.pi * 0.3e6)), rel=1e-4)
    assert [each.pressure for each in both["right"]] == [0.0, 2e3]
    assert both["right"][-1].hold == math.inf
    stiffer = parse_presses("depth=4mm", TABLE, 1.3)["left"][0]
    assert stiffer.force == pytest.approx(1.3 * FORCE)
    assert str(stiffer) == "4.000 mm at 0.00°, 19.604 N"


def test_a_plate_descends_holds_and_lifts_off():
    plate = Plate()
    assert plate(5.0) == (-0.001, 0.0, 0.0)
    plate.go(parse_presses("depth=4mm tilt=-10deg speed=5mm/s hold=1s", TABLE, 1.0)["left"], 10.0)
    assert plate.arrives == pytest.approx(11.0)  # The plate starts 1 mm above the tip.
    tilt = -math.radians(10.0)
    assert plate(10.5) == pytest.approx((0.0015, tilt, 0.0))
    assert plate.reached(10.99) is None
    assert plate(11.5) == pytest.approx((0.004, tilt, 0.0))
    reached = plate.reached(11.5)
    assert reached.d == 0.004
    assert plate.reached(11.9) is None  # The plate has already returned.
    assert plate(12.125) == pytest.approx((0.0015, tilt, 0.0))
    assert plate(12.5).d == -0.001
    assert plate(1e4) == (-0.001, 0.0, 0.0)
    assert plate.reached(1e4) is None


def test_a_plate_lifts_off_before_tilting_and_the_last_press_remains():
    plate = Plate()
    plate.go(parse_presses("depth=4mm", TABLE, 1.0)["left"], 0.0)
    assert plate(1e4) == (0.004, 0.0, 0.0)
    plate.go(parse_presses("depth=2mm tilt=20deg speed=3mm/s", TABLE, 1.0)["left"], 20.0)
    assert plate(20.1) == pytest.approx((0.002, 0.0, 0.0))
    assert plate(20.26).d < 0.0
    assert plate(21.25) == pytest.approx((0.002, math.radians(20.0), 0.0))
    plate.go(parse_presses("pressure=3kPa", TABLE, 1.0)["left"], 30.0)
    assert plate(plate.arrives + 1.0) == StageTouch(-0.001, 0.0, 3e3)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("depth=4", "expected a number in mm or m"),
        ("depth=4deg", "expected a number in mm or m"),
        ("depth=-1mm", "expected a number in mm or m"),
        ("tilt=10deg", "expected exactly one of depth, force, pressure"),
        ("depth=1mm force=2N", "expected exactly one of depth, force, pressure"),
        ("depht=4mm", "found 'depht'"),
        ("tip=thumb depth=1mm", "found 'tip'"),
        ("depth=40mm", "expected at most 15.00 mm or 212.1 N"),
        ("force=1e5N", "expected at most"),
        ("depth=1mm tilt=90deg", "expected at most 0.00 mm"),
        ("depth=1mm speed=0mm/s", "expected a number above 0"),
    ],
)
def test_impossible_presses_are_refused(words, told):
    with pytest.raises(PlateError, match=told):
        parse_presses(words, TABLE, 1.0)
