"""Gymnasium environment that runs the daemon's control loop in virtual time.

Each action is sent as a client command, so an agent has the same capabilities and limits as a
client. Episodes with the same seed are bit-for-bit identical.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import msgpack
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from softfinger.daemon.client.stream import read
from softfinger.daemon.control.modes import Mode
from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.publishing import parts
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire.publisher import packer
from softfinger.daemon.wire.schema import STATE, TRUTH, HandState
from softfinger.gym import STEP, TASKS
from softfinger.gym.picture import Image, Painter, Window
from softfinger.tools.processes.compile import build_kernels, print_event

__all__ = ["Images", "SoftFingerEnv"]

Observation = dict[str, NDArray[Any]]

FORCE = 6.0  # target grip force [N]
REACH = 0.02  # maximum change in a joint goal per step [rad]
FORCES = 1.0, 12.0  # grip forces for actions of −1 and 1 [N]
ANGLE = 0.25  # object angle for an action of 1 [rad]
WHITE = 50e3  # pressure shown as white (255) in images [Pa]
LOST = 0.03  # displacement at which the object counts as lost [m]
_START_D = 0.004  # tip displacement in the initial grip if actions are joint goals [m]
_GRIP_TIMEOUT = 3.0  # timeout for the initial grip [s]
_OBSERVATION_MAX = 200.0  # bound on every float observation, in SI units


class SoftFingerEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Two-fingered hand with an object of random size, mass, friction and position.

    Parameters
    ----------
    task
        - ``grasp``: The hand starts open and must hold the object with 6 N. The reward for each
          step is exp(−e/1 N), where e is the larger of the two tip force errors.
        - ``rotate``: The hand starts with the object in its grip and must rotate it to ``goal``
          [rad]. The reward is exp(−e/0.05 rad), where e is the angle error.
        - ``push``: The hand starts with the object in its grip. A force of up to 3 N then pushes
          the object along its faces for a limited time. The reward is exp(−s/2 mm), where s is the
          slip.
    control
        - ``joints``: An action [2] between −1 and 1 changes the left and right joint goals by up to
          0.02 rad. Positive values close the fingers.
        - ``law``: The action sets the force (1 to 12 N) and object angle (−0.25 to 0.25 rad) for
          the built-in grip control law.
    profile
        Profile of the simulated hand, or None for the default settings.
    changes
        Changes to settings, in the same form as for ``--set``. Each episode draws the object's
        width, mass, angle and x position, the tip friction and the seed, and ignores changes to
        these settings.
    shaped
        Add potential-based shaping [1]_ to the reward of ``grasp``: up to 10 for closing the
        fingers and up to 10 for both forces. Shaping rewards progress before the first touch. It
        may change the optimal policy, because the final potential remains in the return.
    render_mode
        ``rgb_array`` makes `render` return an image [300, 550, 3]; ``human`` shows each step in a
        window, at real-time speed or slower.

    Notes
    -----
    Observations are float32 in SI units unless noted otherwise. The left finger comes first:

    - ``joints`` [6]: angles, velocities and currents,
    - ``contacts`` [6]: displacement d, tilt θ and force of each tip,
    - ``pressure`` [2, rows, cols]: the latest frames, uint16 counts,
    - ``goal`` [1]: target in N, or in rad for ``rotate``.

    An episode terminates when the object is lost or the hand is in a fault state. ``info`` contains

    - ``truth``: the object's x, y [m] and angle [rad],
    - ``fault``: the daemon's fault, or an empty string,
    - ``refused``: the reason why the daemon refused a command, or an empty string,
    - ``is_success``: True if e (or s) is below 1 N, 0.05 rad or 2 mm, depending on the task.

    References
    ----------
    .. [1] Ng, Harada & Russell, "Policy invariance under reward transformations", ICML 1999.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": round(1.0 / STEP)}  # noqa: RUF012

    def __init__(
        self,
        task: str = "grasp",
        control: str = "joints",
        profile: Path | str | None = None,
        changes: Sequence[str] = (),
        shaped: bool = False,
        render_mode: str | None = None,
    ) -> None:
        if task not in TASKS:
            raise ValueError(f"task: found {task!r}, expected one of {', '.join(TASKS)}")
        if control not in ("joints", "law"):
            raise ValueError(f"control: found {control!r}, expected 'joints' or 'law'")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode: found {render_mode!r}, expected None, 'human' or 'rgb_array'"
            )
        self.render_mode = render_mode
        self._window: Window | None = None
        self._pack_state, self._pack_truth = packer(STATE), packer(TRUTH)
        # Joint goals may cause the same grip forces as the grip law.
        ours = ("loop.clock=virtual", "safety.current_move=1.2")
        file = None if profile is None else Path(profile)
        self._settings = load(file, changes=(*ours, *changes))
        scene, tactile = self._settings.scene, self._settings.tactile
        backends = self._settings.servos.backend, tactile.backend
        if len(scene.fingers) < 2 or "none" in backends:
            raise ValueError(
                f"profile: found scene.fingers = {scene.fingers}, servos.backend = {backends[0]!r} "
                f"and tactile.backend = {backends[1]!r}, expected two fingers, servos and tactile "
                "sensors; change these settings"
            )
        build_kernels(self._settings, print_event)
        self._task, self._by_law = task, control == "law"
        self._shaped = shaped and task == "grasp"
        self._daemon: Daemon | None = None
        self.pascal_per_count = tactile.pascal_per_count
        cells = (2, tactile.rows, tactile.cols)
        self._empty = np.zeros(cells[1:], np.uint16)
        self.observation_space: Any = spaces.Dict(
            {
                "joints": spaces.Box(-_OBSERVATION_MAX, _OBSERVATION_MAX, (6,), np.float32),
                "contacts": spaces.Box(-_OBSERVATION_MAX, _OBSERVATION_MAX, (6,), np.float32),
                "pressure": spaces.Box(0, 65535, cells, np.uint16),
                "goal": spaces.Box(-_OBSERVATION_MAX, _OBSERVATION_MAX, (1,), np.float32),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode with a new object; ``options`` may contain a ``goal``.

        Raises RuntimeError if the hand cannot grip the object for ``rotate`` or ``push``.
        """
        super().reset(seed=seed)
        self._end_episode()
        drawn = self._drawn()
        daemon = Daemon(drawn, wire=False)
        assert daemon.hand is not None
        self._daemon, self._hand, self._loop = daemon, daemon.hand, daemon.loop
        self._painter = Painter(drawn, WHITE / self.pascal_per_count)
        self._refused = ""
        goal = FORCE
        if self._task == "rotate":
            goal = float(self.np_random.uniform(-0.2, 0.2))
        self._goal = float((options or {}).get("goal", goal))
        self._push = 0.0
        self._loop.advance(0.1)
        self._command("arm")
        self._loop.advance(0.1)
        if self._task != "grasp":
            self._take_hold()
        self.goals = list(self._loop.state.goal.q)  # joint goals [rad]
        self._first = self._hand.object_pose.copy()
        self._potential = self._closed()
        if self._task == "push":
            self._push = float(self.np_random.choice((-1.0, 1.0)) * self.np_random.uniform(1, 3))
            self._push_at = self._loop.state.t + float(self.np_random.uniform(0.2, 1.0))
            self._push_until = self._push_at + float(self.np_random.uniform(0.3, 1.5))
        self._show()
        return self._observation(), self._info()

    def _drawn(self) -> Settings:
        """Return settings with random object properties."""
        draw = self.np_random.uniform
        simulation = self._settings.simulation
        drawn = {
            "seed": int(self.np_random.integers(2**31)),
            "object_width": draw(0.030, 0.050),
            "object_mass": draw(0.05, 0.2),
            "tip_friction": draw(0.4, 0.8),
            "object_angle": draw(-0.05, 0.05),
            "object_position": (draw(-0.003, 0.003), simulation.object_position[1]),
        }
        return self._settings.model_copy(update={"simulation": simulation.model_copy(update=drawn)})

    def _take_hold(self) -> None:
        """Grip the object, using either the grip control law or joint goals."""
        state = self._loop.state
        if self._by_law:
            self._command("grasp", force=FORCE)
            self._until(lambda: state.mode == Mode.HOLDING)
            return
        reach, q = self._settings.hand.q_max, list(state.reading.q)
        touching = [False, False]

        def held() -> bool:
            for i in range(2):
                touching[i] = touching[i] or state.contacts[i].d > _START_D
                q[i] = min(q[i] + (0.0 if touching[i] else 0.25 * REACH), reach[i])
            self._command("move", left=q[0], right=q[1])
            return all(touching)

        self._until(held)

    def _until(self, condition: Callable[[], bool]) -> None:
        finish = self._loop.state.t + _GRIP_TIMEOUT
        while not condition() or self._refused:
            if self._refused or self._loop.state.t >= finish:
                reason = self._loop.state.fault or self._refused or "the grip takes too long"
                raise RuntimeError(
                    f"reset: the hand does not hold the object ({reason}); change the profile, or "
                    "use the task 'grasp'"
                )
            self._loop.advance(STEP)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply an action and advance the simulation by 0.02 s."""
        self._act(np.clip(np.asarray(action, np.float64), -1.0, 1.0))
        if self._push:
            on = self._push_at <= self._loop.state.t < self._push_until
            self._hand.apply_load(0.0, self._push if on else 0.0)
        self._loop.advance(STEP)
        away = math.hypot(*(self._hand.object_pose[:2] - self._first[:2]))
        ended = bool(self._loop.state.mode == Mode.FAULT or away > LOST)
        reward, before = self._reward(), self._potential
        if self._shaped:
            self._potential = self._closed()
            reward += self._potential - before
        self._show()
        return self._observation(), reward, ended, False, self._info()

    def _act(self, action: NDArray[np.float64]) -> None:
        first, second = action.tolist()
        self._refused = ""
        if not np.isfinite(action).all():
            self._refused = f"action: found {[first, second]}, expected finite numbers"
            return
        if not self._by_law:
            low, high = self._settings.hand.q_min, self._settings.hand.q_max
            for i, share in enumerate((first, second)):
                self.goals[i] = min(max(self.goals[i] + REACH * share, low[i]), high[i])
            self._command("move", left=self.goals[0], right=self.goals[1])
            return
        least, most = FORCES
        force, angle = least + 0.5 * (first + 1.0) * (most - least), ANGLE * second
        self._command("hold", force=force, angle=angle)

    def _command(self, name: str, **numbers: float) -> None:
        try:
            self._loop.command({"command": name, **numbers})
        except Refused as refusal:
            self._refused = str(refusal)

    def _reward(self) -> float:
        if self._task == "push":
            return math.exp(-abs(float(self._hand.object_pose[1] - self._first[1])) / 0.002)
        if self._task == "rotate":
            return math.exp(-abs(float(self._hand.object_pose[2]) - self._goal) / 0.05)
        off = max(abs(float(force) - self._goal) for force in self._hand.force)
        return math.exp(-off)

    def _closed(self) -> float:
        """Return the shaping potential, which measures progress in joint angles and tip forces."""
        q, most = self._loop.state.reading.q, self._settings.hand.q_max
        force = sum(min(float(each) / FORCE, 1.0) for each in self._hand.force)
        return 5.0 * (q[0] / most[0] + q[1] / most[1] + force)

    def state(self) -> HandState:
        """Return the hand's state as clients receive it."""
        packed = self._pack_state(self._loop.state, parts(self._settings))
        return read(HandState, msgpack.unpackb(packed))

    def _pressure(self) -> NDArray[np.uint16]:
        frames = [finger.sensor.latest() for finger in self._loop.perception.fingers]
        return np.stack([self._empty if each is None else each.data for each in frames])

    def _observation(self) -> Observation:
        state = self._loop.state
        reading = state.reading
        felt = [(c.d, c.theta, c.force) if c.contact else (0.0,) * 3 for c in state.contacts]
        return {
            "joints": np.array([*reading.q, *reading.dq, *reading.current], np.float32),
            "contacts": np.array([*felt[0], *felt[1]], np.float32),
            "pressure": self._pressure(),
            "goal": np.array([self._goal], np.float32),
        }

    def _info(self) -> dict[str, Any]:
        return {
            "truth": self._hand.object_pose.copy(),
            "fault": self._loop.state.fault,
            "refused": self._refused,
            "is_success": self._reward() > math.exp(-1.0),
        }

    def render(self) -> Image | None:
        """Return the image of the last step if the render mode is ``rgb_array``, otherwise None."""
        if self.render_mode != "rgb_array" or self._daemon is None:
            return None
        return self._picture()

    def _picture(self) -> Image:
        truth = msgpack.unpackb(self._pack_truth(self._loop.state, self._hand))
        return self._painter(self.state(), truth, self._pressure())

    def _show(self) -> None:
        if self.render_mode != "human":
            return
        if self._window is None:
            self._window = Window(f"softfinger: {self._task}")
        self._window.show(self._picture(), STEP)

    def close(self) -> None:
        """Switch the torque off, discard the simulated hand and close the window."""
        self._end_episode()
        if self._window is not None:
            self._window.close()
            self._window = None

    def _end_episode(self) -> None:
        if self._daemon is not None:
            self._daemon.close()
            self._daemon = None


class Images(gymnasium.ObservationWrapper[Observation, NDArray[np.float32], Observation]):
    """Convert ``pressure`` to images for Stable-Baselines3.

    The images are uint8 [2, rows, cols]. Pressures of 50 kPa or more become 255.
    """

    def __init__(self, env: gymnasium.Env[Observation, NDArray[np.float32]]) -> None:
        super().__init__(env)
        inner: Any = env.unwrapped
        self._full = WHITE / inner.pascal_per_count
        known = inner.observation_space
        image = spaces.Box(0, 255, known["pressure"].shape, np.uint8)
        self.observation_space: Any = spaces.Dict({**known.spaces, "pressure": image})

    def observation(self, observation: Observation) -> Observation:
        """Replace the ``pressure`` entry of the observation with 8-bit images."""
        grey = np.minimum(observation["pressure"] * (255.0 / self._full), 255.0)
        return observation | {"pressure": grey.astype(np.uint8)}
