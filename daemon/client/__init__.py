"""Control the hand and read its stream from a notebook or a program.

::

    from softfinger import Hand

    with Hand() as hand:
        hand.arm()
        hand.grasp(force=5.0)
        hand.wait_for(lambda state: state.mode == "holding")
        print(hand.state().left.force)
        for state in hand.stream():
            ...

`AsyncHand` is the asyncio version. To connect, a client needs only the daemon's stream address and
command address.
"""
