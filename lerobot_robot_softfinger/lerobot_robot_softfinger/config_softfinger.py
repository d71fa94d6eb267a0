"""What ``--robot.…`` sets."""

from dataclasses import dataclass
from pathlib import Path

from lerobot.robots import RobotConfig

from lerobot_robot_softfinger.features import FULL_SCALE


@RobotConfig.register_subclass("softfinger")
@dataclass(kw_only=True)
class SoftfingerConfig(RobotConfig):
    """How to reach a running ``softfinger``, and what an action is.

    ``control``: ``joints``, actions are the joints' goals; ``law``, the built-in law's force and
    the object's angle.
    """

    address: str | None = None  # tcp://HOST or STREAM,COMMANDS; SOFTFINGER_ADDRESS when None
    keys: Path | None = None  # folder of this client's keys, where the daemon wants some
    control: str = "joints"
    rows: int = 44  # of the tactile grids
    cols: int = 44
    full_scale: float = FULL_SCALE  # Pa at which a grid's image is white
    least_force: float = 0.5  # N; an action `grip.force` below it opens the hand
    timeout: float = 5.0  # s for an answer, a state or a frame
    start_timeout: float = 120.0  # s for a first state: the daemon may still compile
    disarm_on_disconnect: bool = True  # torque off; the hand drops what it holds

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.control not in ("joints", "law"):
            raise ValueError(f"control: found {self.control!r}, expected 'joints' or 'law'")
