"""A short run of the fuzzing of commands, profiles and calibration files."""

from __future__ import annotations

import pytest

from tests.fuzz.commands import fuzz, random_bytes_are_decoded_or_refused


@pytest.mark.parametrize(
    ("name", "count"), [("commands", 5000), ("settings", 800), ("calibration", 1200)]
)
def test_odd_input_is_refused_or_carried_out_and_nothing_else(name: str, count: int) -> None:
    counts = fuzz(name, count, seed=11)
    assert set(counts) == {"done", "refused"}
    assert sum(counts.values()) == count
    assert counts["done"] > 0.01 * count, "some of it must be sound, or nothing is tried"


def test_the_parser_takes_random_bytes() -> None:
    random_bytes_are_decoded_or_refused(20_000, seed=5)
