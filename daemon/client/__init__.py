"""The hand from a notebook or a program of one's own: its stream as typed records, its commands.

::

    from softfinger import Hand

    with Hand() as hand:
        hand.arm()
        hand.grasp(force=5.0)
        hand.wait_for(lambda state: state.mode == "holding")
        print(hand.state().left.force)
        for state in hand.stream():
            ...

`AsyncHand` is the same for asyncio. Nothing here needs more of a daemon than its two addresses.
Each name is imported when it is first asked for: who sends a command loads no asyncio and no NumPy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softfinger.daemon.client.asynchronous import AsyncHand
    from softfinger.daemon.client.command_client import NoAnswer
    from softfinger.daemon.client.hand import Hand
    from softfinger.daemon.client.records import to_columns
    from softfinger.daemon.errors import HandClosed, HandFault, NoStream, NotInTime, Refused
    from softfinger.daemon.wire.schema import (
        Event,
        FingerState,
        HandState,
        ObjectState,
        TactileFrame,
    )

_MODULES = {
    "client.asynchronous": ("AsyncHand",),
    "client.command_client": ("NoAnswer",),
    "client.hand": ("Hand",),
    "client.records": ("to_columns",),
    "errors": ("HandClosed", "HandFault", "NoStream", "NotInTime", "Refused"),
    "wire.schema": ("Event", "FingerState", "HandState", "ObjectState", "TactileFrame"),
}

__all__ = [
    "AsyncHand",
    "Event",
    "FingerState",
    "Hand",
    "HandClosed",
    "HandFault",
    "HandState",
    "NoAnswer",
    "NoStream",
    "NotInTime",
    "ObjectState",
    "Refused",
    "TactileFrame",
    "to_columns",
]


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            value = getattr(import_module(f"softfinger.daemon.{module}"), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
