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
