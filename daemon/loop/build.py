"""Build, connect and warm up a daemon from its settings.

Sockets are bound before any hardware is accessed, so a second daemon exits without disturbing the
first. All kernels are compiled before the loop is created, and therefore before torque can be
switched on.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from softfinger import __version__
from softfinger.daemon.backends import backend, needs_hand
from softfinger.daemon.clock import LoopClock, make_clock
from softfinger.daemon.errors import ServosSilent
from softfinger.daemon.gateway.bounds import Config
from softfinger.daemon.gateway.supervisor import Gateway
from softfinger.daemon.loop.loop import Loop
from softfinger.daemon.loop.warm_up import WantedScene, warm_up
from softfinger.daemon.perception.finger_model import FingerModel
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.profile.factory import make_table
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.base import Servos, make_servos
from softfinger.daemon.tactile.base import TactileSensor, make_sensor
from softfinger.daemon.types import EventSink, HandInfo
from softfinger.daemon.wire.command_server import CommandServer
from softfinger.daemon.wire.local_stop import LocalStop
from softfinger.daemon.wire.loop_link import Link
from softfinger.daemon.wire.publisher import GATEWAY_TOPICS, Publisher

_RETRY_INTERVAL = 0.2  # time between connection attempts [s]

if TYPE_CHECKING:
    from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand


def make_hand(settings: Settings, t: float) -> SimulatedHand | None:
    """Return the simulated hand at time ``t`` [s], or None if no backend requires one.

    The simulated tips use the material from the settings, even if a calibration defines another
    material.
    """
    if not needs_hand(settings.servos.backend, settings.tactile.backend):
        return None
    from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand

    table = make_table(settings)
    own = backend("servos", settings.servos.backend).hand
    made: SimulatedHand = (own if callable(own) else SimulatedHand)(settings, t, table)
    return made


class Daemon:
    """Daemon that is ready to run: ``with Daemon(settings) as daemon: daemon.loop.run()``.

    Raises
    ------
    SettingsError, AddressError, ServoError, TactileError
        If the hand cannot be prepared. AddressError also reports unusable keys. Resources that have
        already been opened are closed again.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        on_event: EventSink | None = None,
        wire: bool | Link = True,
        hand: Settings | None = None,
    ) -> None:
        """Build and connect the daemon.

        Parameters
        ----------
        on_event : function that receives the level, kind and text of each event
        wire : True to serve clients over ZeroMQ, or a `Link` whose owner exchanges the messages
        hand : settings of the simulated hand; None to use the daemon's settings
        """
        self.settings = settings
        self._hand_settings = settings if hand is None else hand
        self.clock: LoopClock = make_clock(settings)
        self._closers: list[Callable[[], None]] = []
        self.gateway: Gateway | None = None  # process that serves clients
        try:
            self._build(on_event, wire)
        except BaseException:
            self.close()
            raise

    def _build(self, on_event: EventSink | None, wire: bool | Link) -> None:
        settings = self.settings
        publisher, server = None, None
        if isinstance(wire, Link):
            publisher, server = Publisher(wire), CommandServer(wire, clock=self.clock.now)
        elif wire:
            publisher, server = self._bind()
        scene = WantedScene(settings, on_event)
        self.models = scene.models
        warm_up(scene)
        self.hand = make_hand(self._hand_settings, self.clock.now())
        self.servos = make_servos(settings, self.clock, self.hand)
        perception = Perception(settings, self._make_sensors(), self.models)
        if self.gateway is not None:
            self.gateway.wait()  # A second daemon exits here, before it accesses hardware.
        if self.servos is not None:
            self._closers.append(self.servos.close)
            self._connect(self.servos, on_event)
        for each in perception.fingers:
            self._closers.append(each.sensor.close)
            each.sensor.open()
        self.loop = Loop(
            settings, self.clock, self.servos, perception, publisher, server, on_event, self.hand
        )
        if publisher is not None:
            publisher.settings(
                self.clock.wall(), self.clock.now(), hand_info(settings, self.models)
            )

    def _connect(self, servos: Servos, on_event: EventSink | None) -> None:
        """Connect; if servos do not respond, retry for up to ``servos.open_timeout``."""
        patience = self.settings.servos.open_timeout
        began = time.monotonic()
        was_reported = False
        while True:
            try:
                return servos.connect()
            except ServosSilent as silent:
                if time.monotonic() - began >= patience:
                    text = f"{silent}; gave up after servos.open_timeout = {patience:g} s"
                    raise ServosSilent(text) from None
                if on_event is not None and not was_reported:
                    text = f"{silent}; waiting for up to servos.open_timeout = {patience:g} s"
                    on_event("warning", "servos", text)
                    was_reported = True
            time.sleep(_RETRY_INTERVAL)

    def _bind(self) -> tuple[Publisher, CommandServer]:
        stream, commands = self.settings.stream, self.settings.commands
        access = self.settings.access
        gateway = self.gateway = Gateway(
            Config(
                stream.address,
                commands.address,
                GATEWAY_TOPICS,
                stream.queue,
                commands.max_bytes,
                commands.per_second,
                int(access.ipc_mode, 8),
                access.keys,
                latest=stream.latest,
            )
        )
        self._closers.append(gateway.close)
        local = LocalStop(commands.address)
        self._closers.append(local.close)
        if local.notice:
            gateway.link.notices.append(local.notice)
        return Publisher(gateway.link), CommandServer(gateway.link, local)

    def _make_sensors(self) -> dict[int, TactileSensor]:
        made = {}
        for finger in self.settings.scene.indices:
            sensor = make_sensor(self.settings, self.clock, self.hand, finger)
            if sensor is not None:
                made[finger] = sensor
        return made

    def close(self) -> None:
        """Turn torque off and close everything in reverse order. Never raises."""
        while self._closers:
            closer = self._closers.pop()
            try:
                closer()
            # The remaining closers must still run, because one of them turns torque off.
            except Exception as error:
                logging.getLogger(__name__).error("closing: %s", error)

    def __enter__(self) -> Daemon:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def hand_info(settings: Settings, models: tuple[FingerModel, FingerModel]) -> HandInfo:
    """Return the settings, calibrations and table accuracies that each subscriber receives once."""
    calibrations = [
        "" if model.calibration is None else model.calibration.model_dump_json() for model in models
    ]
    tables = [
        json.dumps(
            {
                "form": model.table.form,
                "tolerance": model.table.tolerance,
                "certificate": model.table.certificate._asdict(),
            }
        )
        for model in models
    ]
    return HandInfo(__version__, settings.model_dump_json(), *calibrations, *tables)
