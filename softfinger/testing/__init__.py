"""Test kit for programs that control a hand or Dynamixel servos.

The pytest fixtures `emulated_hand`, `virtual_hand` and `recorded_hand` are available in all test
runs if softfinger is installed. The fixtures return objects of this package's classes. The classes
also work as context managers without pytest. The conformance checks are intended for authors of
backend plugins. Each name is imported when it is first accessed, so that test runs without this kit
do not load Numba.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softfinger.daemon.profile.load import load
    from softfinger.testing.checks import check_servos, check_shape, check_tactile
    from softfinger.testing.emulated import EmulatedBus, EmulatedHand
    from softfinger.testing.virtual import RecordedHand, VirtualHand

__all__ = [
    "EmulatedBus",
    "EmulatedHand",
    "RecordedHand",
    "VirtualHand",
    "check_servos",
    "check_shape",
    "check_tactile",
    "load",
]

_MODULES = {
    "EmulatedBus": "emulated",
    "EmulatedHand": "emulated",
    "RecordedHand": "virtual",
    "VirtualHand": "virtual",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'softfinger.testing' has no attribute {name!r}")
    module = import_module(f"softfinger.testing.{_MODULES.get(name, 'checks')}")
    value = globals()[name] = getattr(module, name)
    return value
