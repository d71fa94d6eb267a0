"""A short run of the fuzzing of commands, profiles, calibration files and boards."""

import pytest

from tests.fuzz import tactile
from tests.fuzz.commands import fuzz


@pytest.mark.parametrize(
    ("name", "count"), [("commands", 5000), ("settings", 800), ("calibration", 1200)]
)
def test_odd_input_is_refused_or_carried_out_and_nothing_else(name, count):
    counts = fuzz(name, count, seed=11)
    assert set(counts) == {"done", "refused"}
    assert sum(counts.values()) == count
    assert counts["done"] > 0.01 * count, "some of it must be sound, or nothing is tried"


@pytest.mark.parametrize("target", tactile.TARGETS)
def test_no_input_breaks_a_reader(target):
    report = tactile.fuzz(target, 4000, seed=7)
    assert report.wrong == []
    assert report.through > 300
    if target == "cobs":  # the CRC lets one wrong packet in 65536 through
        assert report.foreign <= 2
