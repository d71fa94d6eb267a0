"""The measurements behind ``softfinger bench``: one module each, with ``measure() -> list[Table]``.

`report`, `interleaved`, `campaign`, `picture` and the rigs are what they share.
"""
