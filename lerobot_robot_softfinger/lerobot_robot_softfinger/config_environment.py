"""Define the settings (``--env.NAME``) of the environment; register the environment with Gymnasium.

``--env.type=softfinger`` selects the simulated hand, which is loaded when the environment is
created.
"""

from dataclasses import dataclass, field
from typing import Any

import gymnasium
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_robot_softfinger.features import IMAGES, STATE
from softfinger.gym import SECONDS, STEP, TASKS


@EnvConfig.register_subclass("softfinger")
@dataclass
class SoftfingerEnvConfig(EnvConfig):
    """Simulated hand: ``task`` is Grasp-v0, Rotate-v0 or Push-v0.

    If ``control`` is ``law``, actions are the force [N] and the object angle [rad] for the built-in
    grip law. If ``control`` is ``joints``, actions are joint goals [rad].
    """

    task: str | None = "Grasp-v0"
    fps: int = round(1.0 / STEP)
    control: str = "law"
    profile: str | None = None  # profile of the simulated hand; None selects the default settings
    rows: int = 44  # number of rows and columns of the profile's grids
    cols: int = 44
    render_mode: str = "rgb_array"
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        image = PolicyFeature(FeatureType.VISUAL, (self.rows, self.cols, 3))
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (2,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(STATE),)),
            "environment_state": PolicyFeature(FeatureType.ENV, (1,)),
            **{f"pixels/{name}": image for name in IMAGES.values()},
        }
        self.features_map = {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
            **{f"pixels/{name}": f"{OBS_IMAGES}.{name}" for name in IMAGES.values()},
        }

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {
            "control": self.control,
            "profile": self.profile,
            "render_mode": self.render_mode,
        }


for _task in TASKS:
    gymnasium.register(
        f"gym_softfinger/{_task.capitalize()}-v0",
        "lerobot_robot_softfinger.environment:LeRobotHand",
        kwargs={"task": _task},
        max_episode_steps=round(SECONDS / STEP),
    )
