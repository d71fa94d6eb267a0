"""What a gateway is given when it is started."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from softfinger.daemon.wire.loop_link import Topics


@dataclass(frozen=True, slots=True)
class Config:
    """Addresses (an empty one is not bound), bounds, and the stream's topics."""

    stream: str
    commands: str
    topics: Topics
    queue: int  # messages that wait for a subscriber
    max_bytes: int = 4096  # of a request
    per_second: float = 200.0  # requests of a client
    ipc_mode: int = 0o600  # rights of an ipc address's file
    keys: str = ""  # folder of `softfinger keys`
    stream_key: str = "stream.address"  # what errors call the stream's address

    def to_json(self) -> str:
        """As a text."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Config:
        """From that text."""
        fields = json.loads(text)
        return cls(**fields | {"topics": Topics(**fields["topics"])})
