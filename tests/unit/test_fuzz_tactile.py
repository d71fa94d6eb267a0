"""A little of the fuzzing of tests/fuzz/tactile.py."""

from __future__ import annotations

import pytest

from tests.fuzz.tactile import TARGETS, fuzz


@pytest.mark.parametrize("target", TARGETS)
def test_no_input_breaks_a_reader(target):
    report = fuzz(target, 4000, seed=7)
    assert report.wrong == []
    assert report.frames > 300
    if target == "cobs":  # the CRC lets one wrong packet in 65536 through
        assert report.foreign <= 2
