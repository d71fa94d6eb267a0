"""Provide a LeRobot `Robot` that controls a running ``softfinger`` daemon."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from lerobot.robots import Robot
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_robot_softfinger.config_softfinger import SoftfingerConfig
from lerobot_robot_softfinger.features import IMAGES, JOINTS, STATE, image, observation
from softfinger import Hand, NoStream
from softfinger.daemon.control.modes import GRIPPING_MODES, Mode
from softfinger.daemon.wire.schema import TactileFrame


class Softfinger(Robot):
    """LeRobot `Robot` implementation for the softfinger hand.

    Connecting does not switch on the torque or move the hand. The first action arms the hand. If
    the hand is later disarmed or enters a fault state, the next action raises Refused. It does not
    arm the hand again.
    """

    config_class = SoftfingerConfig
    name = "softfinger"

    def __init__(self, config: SoftfingerConfig) -> None:
        super().__init__(config)
        self.config = config
        # lerobot-record requires this attribute. The tactile grids do not count as cameras.
        self.cameras: dict[str, Any] = {}
        self._hand: Hand | None = None

    @property
    def observation_features(self) -> dict[str, Any]:
        shape = (self.config.rows, self.config.cols, 3)
        return dict.fromkeys(STATE, float) | dict.fromkeys(IMAGES.values(), shape)

    @property
    def action_features(self) -> dict[str, Any]:
        by_law = self.config.control == "law"
        return dict.fromkeys(("grip.force", "grip.angle") if by_law else JOINTS, float)

    @property
    def is_connected(self) -> bool:
        return self._hand is not None

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Connect to the daemon.

        Raises NoStream or NoAnswer if the daemon is not running. Raises ValueError if the grid size
        differs from the settings.
        """
        config = self.config
        hand = Hand(config.address, client="lerobot", timeout=config.timeout, keys=config.keys)
        try:
            # The first start of the daemon is slow, because the daemon compiles the kernels.
            hand.state(config.start_timeout)
            hand.status()
            self._waiting = hand.frames()
            self._frames: dict[str, TactileFrame] = {}
            while len(self._frames) < len(IMAGES):
                self._take(self._waiting.next(config.timeout))
            self._gripping = hand.state().mode in GRIPPING_MODES
        except BaseException:
            hand.close()
            raise
        self._hand, self._armed = hand, False

    def _take(self, frame: TactileFrame) -> None:
        size, expected = (frame.rows, frame.cols), (self.config.rows, self.config.cols)
        if size != expected:
            raise ValueError(
                "--robot.rows, --robot.cols: found {} × {}, expected the hand's {} × {}".format(
                    *expected, *size
                )
            )
        self._frames[frame.finger] = frame

    @property
    def is_calibrated(self) -> bool:
        """Always True, because the daemon manages the calibration (``softfinger calibrate``)."""
        return True

    @check_if_not_connected
    def calibrate(self) -> None:
        """Tare the tactile grids. Raises Refused if a tip is in contact."""
        self._hand.tare()

    def configure(self) -> None:
        """Do nothing, because the daemon reads its own settings."""

    @check_if_not_connected
    def get_observation(self) -> dict[str, Any]:
        """Wait for the next state; return the state and each finger's latest frame."""
        state = self._hand.state()
        with contextlib.suppress(NoStream):
            while True:
                self._take(self._waiting.next(0.0))
        images = {
            IMAGES[name]: image(frame.pressure, self.config.full_scale)
            for name, frame in self._frames.items()
        }
        return observation(state, self._frames) | images

    @check_if_not_connected
    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Command joint goals [rad], or the grip force [N] and object angle [rad].

        Returns the commanded values. While the hand opens, no force or angle is commanded, and both
        values are 0. Raises Refused if a value is outside the hand's limits.
        """
        numbers = {name: float(np.asarray(action[name]).item()) for name in self.action_features}
        if not self._armed:
            self._hand.arm()
            self._armed = True
        if self.config.control == "joints":
            left, right = (numbers[name] for name in JOINTS)
            self._hand.move(left, right)
            return numbers
        return self._grip(numbers["grip.force"], numbers["grip.angle"])

    def _grip(self, force: float, angle: float) -> dict[str, float]:
        if force < self.config.least_force:
            if self._gripping:
                self._hand.release()
            self._gripping = False
        elif self._gripping or self._hand.state().mode != Mode.RELEASING:
            self._hand.hold(force, angle)
            self._gripping = True
            return {"grip.force": force, "grip.angle": angle}
        return {"grip.force": 0.0, "grip.angle": 0.0}

    @check_if_not_connected
    def disconnect(self) -> None:
        hand, self._hand = self._hand, None
        try:
            if self._armed and self.config.disarm_on_disconnect:
                hand.disarm()
        finally:
            hand.close()
