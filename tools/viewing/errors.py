"""What can keep the viewer from showing."""

from __future__ import annotations

from softfinger.daemon.errors import SoftfingerError


class ViewError(SoftfingerError):
    """Nothing can be shown. The message says why, and what to do."""


class NoRerun(ViewError):
    """The viewer's package is not installed. The message says what to install."""

    def __init__(self) -> None:
        super().__init__(
            "the viewer needs rerun-sdk, the extra 'view'; from the project's folder: "
            "pip install '.[view]'"
        )
