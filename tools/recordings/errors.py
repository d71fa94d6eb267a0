"""What can be wrong with a recording."""

from __future__ import annotations

from softfinger.daemon.errors import RecordingError


class NoMcap(RecordingError):
    """The packages for recordings are not installed. The message says what to install."""

    def __init__(self) -> None:
        super().__init__(
            "recordings need mcap, orjson and zstandard, the extra 'record'; from the "
            "project's folder: pip install '.[record]'"
        )


def require_packages() -> None:
    """Raises NoMcap unless what recordings are written and read with is here."""
    try:
        import mcap  # noqa: F401
        import orjson  # noqa: F401
        import zstandard  # noqa: F401
    except ImportError:
        raise NoMcap from None
