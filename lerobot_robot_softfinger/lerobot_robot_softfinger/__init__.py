"""LeRobot plugin that adds ``--robot.type=softfinger`` and ``--env.type=softfinger``."""

from lerobot_robot_softfinger.config_environment import SoftfingerEnvConfig
from lerobot_robot_softfinger.config_softfinger import SoftfingerConfig
from lerobot_robot_softfinger.softfinger import Softfinger

__all__ = ["Softfinger", "SoftfingerConfig", "SoftfingerEnvConfig"]
