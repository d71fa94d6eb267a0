"""Control the hand and read its stream from a notebook or a program; see ``docs/programs.md``.

`Hand` is the blocking client, and `AsyncHand` is the asyncio version. To connect, a client needs
only the daemon's stream address and command address.
"""
