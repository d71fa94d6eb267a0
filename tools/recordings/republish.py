"""Publishes a recording's messages on the stream's address, by a gateway as the daemon's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from softfinger.daemon.errors import AddressError, RecordingError
from softfinger.daemon.gateway.config import Config
from softfinger.daemon.gateway.supervisor import Gateway
from softfinger.daemon.profile.validation import address_problem
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.packer import pack
from softfinger.daemon.wire.publisher import GATEWAY_TOPICS

_QUEUE = 10_000  # messages that wait for a subscriber; it misses further ones
_PATIENCE = 1.0  # s for the gateway to take a message


class Wire:
    """A context that publishes on ``address``, with ``keys`` only to their holders.

    Raises RecordingError when the address can't be bound, or reaches other machines without keys.
    """

    def __init__(self, address: str, keys: Path | None = None) -> None:
        fault = address_problem(address, "" if keys is not None else "--keys")
        if fault:
            raise RecordingError(f"--address: {fault}")
        folder = "" if keys is None else str(keys)
        config = Config(address, "", GATEWAY_TOPICS, _QUEUE, keys=folder, stream_key="--address")
        self._gateway = Gateway(config)
        try:
            self._gateway.wait()
        except AddressError as error:
            self._gateway.close()
            raise RecordingError(str(error)) from None
        self._link = self._gateway.link
        self._link.begin_epoch()

    def subscribed(self, seconds: float) -> bool:
        """Wait so many seconds, or until the subscribers change; whether there are any."""
        self._link.wait(seconds)
        return bool(self._link.wanted)

    def send(self, topic: bytes, message: dict[str, Any]) -> None:
        """Publish one message, as soon as the gateway has room for it."""
        index = GATEWAY_TOPICS.names.index(topic.decode())
        packed = pack(message)
        if topic == schema.SETTINGS:
            self._link.publish_lasting(index, packed)
            return
        self._link.wait_for_room(_PATIENCE)
        self._link.publish(index, packed, keep=topic == schema.EVENT)

    def __enter__(self) -> Wire:
        return self

    def __exit__(self, *_: object) -> None:
        self._gateway.close()
