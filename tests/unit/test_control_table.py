"""Models by name, and the mapping between counts and a joint's SI units."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.daemon.profile.settings import ServoSettings
from softfinger.daemon.servos.control_table import by_name, name_of
from softfinger.daemon.servos.joint import JointScale


def test_models_by_name_and_number() -> None:
    assert by_name("xl330-m288-t") is by_name("XL330-M288")
    assert name_of(1060) == "XL430-W250"
    assert name_of(1) == "model number 1"
    assert by_name("XL330-M288").highest_address(52) == 227
    assert by_name("XM430-W350").highest_address(48) == 661
    assert by_name("XL330-M288").baud_rates[-1] == 4_000_000
    with pytest.raises(KeyError, match="unknown servo model 'AX-12'; known: XM430-W350, "):
        by_name("AX-12")


@given(
    direction=st.sampled_from([-1, 1]),
    zero=st.integers(-5000, 5000),
    ratio=st.floats(0.1, 50.0),
    counts=st.integers(-100_000, 100_000),
)
def test_units_there_and_back(direction: int, zero: int, ratio: float, counts: int) -> None:
    servos = ServoSettings(direction=(direction, direction), zero=(zero, zero), gear_ratio=ratio)
    scale = JointScale.of(servos, 1)
    assert scale.position_counts(scale.angle(counts)) == counts
    assert scale.velocity_counts(scale.rate(counts)) == counts
    assert scale.current_counts(scale.amperes(counts)) == counts
    assert scale.angle(zero) == 0.0
    turn = scale.angle(zero + direction * 4096)
    assert turn == pytest.approx(2.0 * math.pi / ratio)
    assert scale.bound_counts(-5 * 2.69e-3) == 5
