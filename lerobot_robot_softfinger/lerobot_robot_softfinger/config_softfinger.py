"""Define the robot's settings (``--robot.NAME``)."""

from dataclasses import dataclass
from pathlib import Path

from lerobot.robots import RobotConfig

from lerobot_robot_softfinger.features import FULL_SCALE


@RobotConfig.register_subclass("softfinger")
@dataclass(kw_only=True)
class SoftfingerConfig(RobotConfig):
    """Settings for actions and for the connection to a running ``softfinger`` daemon.

    If ``control`` is ``joints``, actions are joint goals. If ``control`` is ``law``, actions are
    the force and object angle for the built-in grip control law.
    """

    address: str | None = None  # tcp://HOST or STREAM,COMMANDS; default: SOFTFINGER_ADDRESS
    keys: Path | None = None  # folder with this client's keys, if the daemon requires keys
    control: str = "joints"
    rows: int = 44  # number of rows of each tactile grid
    cols: int = 44  # number of columns of each tactile grid
    full_scale: float = FULL_SCALE  # pressure shown as white in images [Pa]
    least_force: float = 0.5  # minimum grip force [N]; a smaller `grip.force` opens the hand
    timeout: float = 5.0  # timeout for a reply, a state or a frame [s]
    start_timeout: float = 120.0  # timeout for the first state [s], including compilation
    disarm_on_disconnect: bool = True  # True if disconnecting disarms the hand and drops the object

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.control not in ("joints", "law"):
            raise ValueError(f"control: found {self.control!r}, expected 'joints' or 'law'")
