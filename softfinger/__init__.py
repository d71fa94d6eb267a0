"""Real-time control of two rotational fingers with soft hemispherical tips.

This module exports the public API. Each name is imported on first access. A client program that
uses only `Hand` or `AsyncHand` therefore does not load Numba or the control loop.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softfinger.daemon.client.asynchronous import AsyncHand
    from softfinger.daemon.client.command_client import NoAnswer
    from softfinger.daemon.client.hand import Hand
    from softfinger.daemon.errors import HandClosed, HandFault, NoStream, NotInTime, Refused
    from softfinger.daemon.wire.schema import HandState
    from softfinger.kinematics.contact.closed_form import Fingertip
    from softfinger.kinematics.contact.material import Material
    from softfinger.kinematics.contact.table import ContactTable
    from softfinger.kinematics.estimation.estimator import ContactEstimator
    from softfinger.kinematics.sensing.pressure_grid import SensorGrid
    from softfinger.tools.recordings.reader import read_recording

__version__ = "0.2.0"

__all__ = [
    "AsyncHand",
    "ContactEstimator",
    "ContactTable",
    "Fingertip",
    "Hand",
    "HandClosed",
    "HandFault",
    "HandState",
    "Material",
    "NoAnswer",
    "NoStream",
    "NotInTime",
    "Refused",
    "SensorGrid",
    "SoftfingerError",
    "__version__",
    "read_recording",
]

_MODULES = {
    "AsyncHand": "daemon.client.asynchronous",
    "Hand": "daemon.client.hand",
    "HandState": "daemon.wire.schema",
    "NoAnswer": "daemon.client.command_client",
    "ContactEstimator": "kinematics.estimation.estimator",
    "ContactTable": "kinematics.contact.table",
    "Fingertip": "kinematics.contact.closed_form",
    "Material": "kinematics.contact.material",
    "SensorGrid": "kinematics.sensing.pressure_grid",
    "read_recording": "tools.recordings.reader",
}


class SoftfingerError(Exception):
    """Base class of all exceptions that this package raises."""


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'softfinger' has no attribute {name!r}")
    module = import_module(f"softfinger.{_MODULES.get(name, 'daemon.errors')}")
    value = globals()[name] = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
