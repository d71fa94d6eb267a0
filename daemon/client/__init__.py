"""Client library: control the hand and read its stream from a notebook or program.

::

    from softfinger import Hand

    with Hand() as hand:
        hand.arm()
        hand.grasp(force=5.0)
        hand.wait_for(lambda state: state.mode == "holding")
        print(hand.state().left.force)
        for state in hand.stream():
            ...

`AsyncHand` is the same for asyncio. A client needs only the two addresses of the daemon.
"""
