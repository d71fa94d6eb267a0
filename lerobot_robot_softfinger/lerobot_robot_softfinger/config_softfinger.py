"""Settings of the robot, set by ``--robot.NAME``."""

from dataclasses import dataclass
from pathlib import Path

from lerobot.robots import RobotConfig

from lerobot_robot_softfinger.features import FULL_SCALE


@RobotConfig.register_subclass("softfinger")
@dataclass(kw_only=True)
class SoftfingerConfig(RobotConfig):
    """Connection to a running ``softfinger``, and the meaning of actions.

    With ``control`` set to ``joints``, actions are joint goals. With ``law``, they are the force
    and the object angle of the built-in grip law.
    """

    address: str | None = None  # tcp://HOST or STREAM,COMMANDS; SOFTFINGER_ADDRESS if None
    keys: Path | None = None  # folder of this client's keys, if the daemon requires keys
    control: str = "joints"
    rows: int = 44  # size of the tactile grids
    cols: int = 44
    full_scale: float = FULL_SCALE  # Pa, pressure shown as white in an image
    least_force: float = 0.5  # N; a smaller `grip.force` opens the hand
    timeout: float = 5.0  # s, for a reply, a state or a frame
    start_timeout: float = 120.0  # s, for the first state; the daemon may still compile
    disarm_on_disconnect: bool = True  # switches the torque off; the hand drops the object

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.control not in ("joints", "law"):
            raise ValueError(f"control: found {self.control!r}, expected 'joints' or 'law'")
