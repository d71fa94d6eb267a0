"""The measurements behind ``softfinger bench``, one module each, with ``measure() -> rows``."""
