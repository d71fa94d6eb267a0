"""Real-time control of two rotational fingers with soft hemispherical tips.

This module exports the public API. Each name is imported when it is first accessed. Client programs
that use only `Hand` or `AsyncHand` therefore do not load Numba or the control loop.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the same names as in `_PUBLIC`, for type checkers
    from softfinger.daemon.client.asynchronous import AsyncHand as AsyncHand
    from softfinger.daemon.client.asynchronous import AsyncSubscription as AsyncSubscription
    from softfinger.daemon.client.command_client import NoAnswer as NoAnswer
    from softfinger.daemon.client.hand import Hand as Hand
    from softfinger.daemon.client.hand import Subscription as Subscription
    from softfinger.daemon.client.stream import to_columns as to_columns
    from softfinger.daemon.errors import HandClosed as HandClosed
    from softfinger.daemon.errors import HandFault as HandFault
    from softfinger.daemon.errors import KeyFileError as KeyFileError
    from softfinger.daemon.errors import NoStream as NoStream
    from softfinger.daemon.errors import NotInTime as NotInTime
    from softfinger.daemon.errors import Reason as Reason
    from softfinger.daemon.errors import RecordingError as RecordingError
    from softfinger.daemon.errors import Refused as Refused
    from softfinger.daemon.errors import SettingsError as SettingsError
    from softfinger.daemon.errors import WrongThread as WrongThread
    from softfinger.daemon.wire.schema import AnsweredCommand as AnsweredCommand
    from softfinger.daemon.wire.schema import Event as Event
    from softfinger.daemon.wire.schema import FingerState as FingerState
    from softfinger.daemon.wire.schema import HandSettings as HandSettings
    from softfinger.daemon.wire.schema import HandState as HandState
    from softfinger.daemon.wire.schema import InputFinger as InputFinger
    from softfinger.daemon.wire.schema import InputReading as InputReading
    from softfinger.daemon.wire.schema import LoopStatistics as LoopStatistics
    from softfinger.daemon.wire.schema import ObjectState as ObjectState
    from softfinger.daemon.wire.schema import Rates as Rates
    from softfinger.daemon.wire.schema import Spread as Spread
    from softfinger.daemon.wire.schema import TactileFrame as TactileFrame
    from softfinger.daemon.wire.schema import TickInput as TickInput
    from softfinger.daemon.wire.schema import TrueFinger as TrueFinger
    from softfinger.daemon.wire.schema import TrueObject as TrueObject
    from softfinger.daemon.wire.schema import TrueState as TrueState
    from softfinger.kinematics.contact.closed_form import Fingertip as Fingertip
    from softfinger.kinematics.contact.material import Material as Material
    from softfinger.kinematics.contact.material_fit import MaterialError as MaterialError
    from softfinger.kinematics.contact.table import Certificate as Certificate
    from softfinger.kinematics.contact.table import ContactForces as ContactForces
    from softfinger.kinematics.contact.table import ContactTable as ContactTable
    from softfinger.kinematics.contact.table_record import TableError as TableError
    from softfinger.kinematics.estimation.error_budget import Uncertainty as Uncertainty
    from softfinger.kinematics.estimation.estimator import ContactEstimate as ContactEstimate
    from softfinger.kinematics.estimation.estimator import ContactEstimator as ContactEstimator
    from softfinger.kinematics.estimation.estimator import Readings as Readings
    from softfinger.kinematics.estimation.invalid import Invalid as Invalid
    from softfinger.kinematics.sensing.pressure_grid import SensorGrid as SensorGrid
    from softfinger.tools.recordings.reader import read_recording as read_recording

__version__ = "0.2.0"

# Public names of each module
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

__all__ = sorted([*_MODULES, "SoftfingerError", "__version__"])


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
