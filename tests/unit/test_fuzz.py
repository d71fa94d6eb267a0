"""Run short fuzz tests with commands, profiles, calibration files and boards."""

import pytest

from tests.fuzz import tactile
from tests.fuzz.commands import fuzz


@pytest.mark.parametrize(
    ("name", "count"), [("commands", 5000), ("settings", 800), ("calibration", 1200)]
)
def test_random_commands_are_refused_or_executed_without_other_errors(name, count):
    counts = fuzz(name, count, seed=11)
    assert set(counts) == {"done", "refused"}
    assert sum(counts.values()) == count
    assert counts["done"] > 0.01 * count, "too few valid inputs"


@pytest.mark.parametrize("target", tactile.TARGETS)
def test_random_input_never_crashes_a_reader(target):
    report = tactile.fuzz(target, 4000, seed=7)
    assert report.wrong == []
    assert report.through > 300
    if target == "cobs":  # The CRC check accepts one of 65536 wrong packets.
        assert report.foreign <= 2
