"""softfinger: real-time control of two rotational fingers with soft hemispherical tips.

The names below are the public ones; each is imported when it is first asked for, so that a program
that only talks to a running hand (`Hand`, `AsyncHand`) loads neither Numba nor the control loop.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softfinger.daemon.client.asynchronous import AsyncHand
    from softfinger.daemon.client.hand import Hand
    from softfinger.kinematics.contact.closed_form import Fingertip
    from softfinger.kinematics.contact.material import Material
    from softfinger.kinematics.contact.table import ContactTable
    from softfinger.kinematics.estimation.estimator import ContactEstimator
    from softfinger.kinematics.sensing.pressure_grid import SensorGrid

__version__ = "0.1.0"

_MODULES = {
    "AsyncHand": "softfinger.daemon.client.asynchronous",
    "ContactEstimator": "softfinger.kinematics.estimation.estimator",
    "ContactTable": "softfinger.kinematics.contact.table",
    "Fingertip": "softfinger.kinematics.contact.closed_form",
    "Hand": "softfinger.daemon.client.hand",
    "Material": "softfinger.kinematics.contact.material",
    "SensorGrid": "softfinger.kinematics.sensing.pressure_grid",
}

__all__ = [
    "AsyncHand",
    "ContactEstimator",
    "ContactTable",
    "Fingertip",
    "Hand",
    "Material",
    "SensorGrid",
    "SoftfingerError",
    "__version__",
]


class SoftfingerError(Exception):
    """The root of all exceptions of this package."""


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'softfinger' has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
