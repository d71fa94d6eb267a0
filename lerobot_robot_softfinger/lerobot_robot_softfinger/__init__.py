"""Provide the LeRobot plugin for the softfinger hand: ``--robot.type=softfinger``."""

from lerobot_robot_softfinger.config_softfinger import SoftfingerConfig
from lerobot_robot_softfinger.softfinger import Softfinger

__all__ = ["Softfinger", "SoftfingerConfig"]
