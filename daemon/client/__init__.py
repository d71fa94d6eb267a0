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
"""

from softfinger.daemon.client.asynchronous import AsyncHand
from softfinger.daemon.client.command_client import NoAnswer
from softfinger.daemon.client.hand import Hand
from softfinger.daemon.client.records import to_columns
from softfinger.daemon.errors import HandClosed, HandFault, NoStream, NotInTime, Refused
from softfinger.daemon.wire.schema import Event, FingerState, HandState, ObjectState, TactileFrame

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
