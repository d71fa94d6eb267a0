"""Real-time control of two rotational fingers with soft hemispherical tips.

This module exports the public API. Each name is imported when it is first accessed. Client programs
that use only `Hand` or `AsyncHand` therefore do not load Numba or the control loop.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softfinger.daemon.client.asynchronous import AsyncHand, AsyncSubscription
    from softfinger.daemon.client.command_client import NoAnswer
    from softfinger.daemon.client.hand import Hand, Subscription
    from softfinger.daemon.client.stream import to_columns
    from softfinger.daemon.errors import (
        HandClosed,
        HandFault,
        KeyFileError,
        NoStream,
        NotInTime,
        Reason,
        RecordingError,
        Refused,
        SettingsError,
        WrongThread,
    )
    from softfinger.daemon.wire.schema import (
        AnsweredCommand,
        Event,
        FingerState,
        HandSettings,
        HandState,
        InputFinger,
        InputReading,
        LoopStatistics,
        ObjectState,
        Rates,
        Spread,
        TactileFrame,
        TickInput,
        TrueFinger,
        TrueObject,
        TrueState,
    )
    from softfinger.kinematics.contact.closed_form import Fingertip
    from softfinger.kinematics.contact.material import Material
    from softfinger.kinematics.contact.material_fit import MaterialError
    from softfinger.kinematics.contact.table import Certificate, ContactForces, ContactTable
    from softfinger.kinematics.contact.table_record import TableError
    from softfinger.kinematics.estimation.error_budget import Uncertainty
    from softfinger.kinematics.estimation.estimator import (
        ContactEstimate,
        ContactEstimator,
        Readings,
    )
    from softfinger.kinematics.estimation.invalid import Invalid
    from softfinger.kinematics.sensing.pressure_grid import SensorGrid
    from softfinger.tools.recordings.reader import read_recording

__version__ = "0.2.0"

__all__ = [
    "AnsweredCommand",
    "AsyncHand",
    "AsyncSubscription",
    "Certificate",
    "ContactEstimate",
    "ContactEstimator",
    "ContactForces",
    "ContactTable",
    "Event",
    "FingerState",
    "Fingertip",
    "Hand",
    "HandClosed",
    "HandFault",
    "HandSettings",
    "HandState",
    "InputFinger",
    "InputReading",
    "Invalid",
    "KeyFileError",
    "LoopStatistics",
    "Material",
    "MaterialError",
    "NoAnswer",
    "NoStream",
    "NotInTime",
    "ObjectState",
    "Rates",
    "Readings",
    "Reason",
    "RecordingError",
    "Refused",
    "SensorGrid",
    "SettingsError",
    "SoftfingerError",
    "Spread",
    "Subscription",
    "TableError",
    "TactileFrame",
    "TickInput",
    "TrueFinger",
    "TrueObject",
    "TrueState",
    "Uncertainty",
    "WrongThread",
    "__version__",
    "read_recording",
    "to_columns",
]

# Public names of each module. The imports above declare the same names for type checkers.
_PUBLIC = {
    "daemon.client.asynchronous": "AsyncHand AsyncSubscription",
    "daemon.client.command_client": "NoAnswer",
    "daemon.client.hand": "Hand Subscription",
    "daemon.client.stream": "to_columns",
    "daemon.errors": "HandClosed HandFault KeyFileError NoStream NotInTime Reason "
    "RecordingError Refused SettingsError WrongThread",
    "daemon.wire.schema": "AnsweredCommand Event FingerState HandSettings HandState InputFinger "
    "InputReading LoopStatistics ObjectState Rates Spread TactileFrame TickInput TrueFinger "
    "TrueObject TrueState",
    "kinematics.contact.closed_form": "Fingertip",
    "kinematics.contact.material": "Material",
    "kinematics.contact.material_fit": "MaterialError",
    "kinematics.contact.table": "Certificate ContactForces ContactTable",
    "kinematics.contact.table_record": "TableError",
    "kinematics.estimation.error_budget": "Uncertainty",
    "kinematics.estimation.estimator": "ContactEstimate ContactEstimator Readings",
    "kinematics.estimation.invalid": "Invalid",
    "kinematics.sensing.pressure_grid": "SensorGrid",
    "tools.recordings.reader": "read_recording",
}
_MODULES = {name: module for module, names in _PUBLIC.items() for name in names.split()}


class SoftfingerError(Exception):
    """Base class of all exceptions that this package raises."""


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'softfinger' has no attribute {name!r}")
    module = import_module(f"softfinger.{_MODULES[name]}")
    value = globals()[name] = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
