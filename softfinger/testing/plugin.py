"""Pytest fixtures of the test kit, with few imports because every pytest run loads this module."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from softfinger.testing import EmulatedHand, RecordedHand, VirtualHand

_MARKER = (
    "softfinger(**options): arguments of the fixtures emulated_hand (softfinger.testing."
    "EmulatedHand) and virtual_hand (VirtualHand), such as profile='small'"
)


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker that sets the options of a hand."""
    config.addinivalue_line("markers", _MARKER)


def _options(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Return the options of all markers on a test; markers closer to the test have priority."""
    markers = list(reversed(list(request.node.iter_markers("softfinger"))))
    for marker in markers:
        if marker.args:
            raise TypeError(
                f"marker softfinger: found {marker.args!r}, expected keywords such as "
                "profile='small'"
            )
    return {name: value for marker in markers for name, value in marker.kwargs.items()}


@pytest.fixture
def emulated_hand(request: pytest.FixtureRequest) -> Iterator[EmulatedHand]:
    """Emulated servos and tactile boards on serial ports: `softfinger.testing.EmulatedHand`."""
    from softfinger.testing import EmulatedHand

    with EmulatedHand(**_options(request)) as hand:
        yield hand


@pytest.fixture
def virtual_hand(request: pytest.FixtureRequest) -> Iterator[VirtualHand]:
    """Simulated hand with its daemon in virtual time: `softfinger.testing.VirtualHand`."""
    from softfinger.testing import VirtualHand

    with VirtualHand(**_options(request)) as hand:
        yield hand


@pytest.fixture
def recorded_hand(request: pytest.FixtureRequest) -> Iterator[Callable[..., RecordedHand]]:
    """Function that opens a recording: `softfinger.testing.RecordedHand`.

    A relative path is relative to the folder of the test file.
    """
    from softfinger.testing import RecordedHand

    with ExitStack() as opened:
        yield lambda path: opened.enter_context(RecordedHand(request.path.parent / Path(path)))
