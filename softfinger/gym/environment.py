"""The simulated hand as an environment: the daemon's own loop on virtual time, step by step.

An action is a client's command, so that an agent can do nothing that a client can't, within the
same limits. Everything random follows from the seed, to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from softfinger.daemon.control.modes import Mode
from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.gym import STEP, TASKS
from softfinger.tools.processes.compile import build_kernels, print_event

Observation = dict[str, NDArray[Any]]

FORCE = 6.0  # N, of the grip that is wanted
REACH = 0.02  # rad that a joint's goal moves in a step at most
FORCES = 1.0, 12.0  # N, what an action of -1 and of 1 asks the grip for, …
ANGLE = 0.25  # rad, … and to what angle it turns the object
WHITE = 50e3  # Pa, at which an image is white
LOST = 0.03  # m off its first place: the object is lost
_DEEP = 0.004  # m, to which the joints alone press into the object when an episode begins with it
_PATIENCE = 3.0  # s
_MOST = 200.0  # of any observation: N, A, rad/s


class SoftFingerEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A hand and an object whose size, mass, friction and place are drawn for each episode.

    ``task``:

    - ``grasp``: the hand is open; hold the object with 6 N. A step's reward is 1 where both tips'
      forces are right, and falls to 1/e where they are 1 N off.
    - ``rotate``: the hand holds the object; turn it to ``goal`` [rad]. The reward is 1 at the goal
      and falls to 1/e at 0.05 rad off it.
    - ``push``: the hand holds the object, which is pushed with up to 3 N along the tips' faces for
      a while; the reward is 1 and falls to 1/e where it has slid by 2 mm.

    ``control``: ``joints``, an action [2] in −1 to 1 moves the left and the right joint's goal by
    up to 0.02 rad, positive closes; ``law``, it sets what the built-in law grips with (1 to 12 N)
    and turns to (−0.25 to 0.25 rad).

    Observation, float32 in SI units, counts uint16: ``joints`` [6], angles, velocities and
    currents, left before right; ``contacts`` [6], d, θ and force of each tip; ``pressure`` [2,
    rows, cols], uint16, the newest frames; ``goal`` [1], N or rad.

    ``shaped`` adds to each reward of ``grasp`` by how much a potential has grown: 10 for fingers
    that have closed as far as they go, 10 for both forces. What is best to do stays the same (Ng,
    Harada & Russell, 1999), and there is something to learn from before the first touch.

    An episode ends when the object is lost or the hand is in fault. ``profile`` is a profile of
    the simulated hand, ``changes`` are settings as ``--set`` takes them. ``info`` has ``truth``:
    the object's x, y [m] and angle [rad]; ``fault``; and ``refused``, why a command was.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        task: str = "grasp",
        control: str = "joints",
        profile: Path | str | None = None,
        changes: Sequence[str] = (),
        shaped: bool = False,
    ) -> None:
        if task not in TASKS:
            raise ValueError(f"task: found {task!r}, expected one of {', '.join(TASKS)}")
        if control not in ("joints", "law"):
            raise ValueError(f"control: found {control!r}, expected 'joints' or 'law'")
        # A joint's goal alone presses as hard as the law may.
        ours = ("loop.clock=virtual", "safety.current_move=1.2")
        file = None if profile is None else Path(profile)
        self._settings = load(file, changes=(*ours, *changes))
        build_kernels(self._settings, print_event)
        self._task, self._by_law = task, control == "law"
        self._shaped = shaped and task == "grasp"
        self._daemon: Daemon | None = None
        tactile = self._settings.tactile
        self.pascal_per_count = tactile.pascal_per_count
        cells = (2, tactile.rows, tactile.cols)
        self._empty = np.zeros(cells[1:], np.uint16)
        self.observation_space: Any = spaces.Dict(
            {
                "joints": spaces.Box(-_MOST, _MOST, (6,), np.float32),
                "contacts": spaces.Box(-_MOST, _MOST, (6,), np.float32),
                "pressure": spaces.Box(0, 65535, cells, np.uint16),
                "goal": spaces.Box(-_MOST, _MOST, (1,), np.float32),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """A new object, before the open hand or held by it. ``options`` has ``goal`` if wanted."""
        super().reset(seed=seed)
        self.close()
        daemon = Daemon(self._drawn(), wire=False)
        assert daemon.hand is not None
        self._daemon, self._hand, self._loop = daemon, daemon.hand, daemon.loop
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
        self._joints = list(self._loop.state.reading.q)
        self._first = self._hand.object_pose.copy()
        self._potential = self._closed()
        if self._task == "push":
            self._push = float(self.np_random.choice((-1.0, 1.0)) * self.np_random.uniform(1, 3))
            self._push_at = self._loop.state.t + float(self.np_random.uniform(0.2, 1.0))
            self._push_until = self._push_at + float(self.np_random.uniform(0.3, 1.5))
        return self._observation(), self._info()

    def _drawn(self) -> Settings:
        """The settings with an object of this episode."""
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
        """Hold the object, by the law or by the joints alone."""
        state = self._loop.state
        if self._by_law:
            self._command("grasp", force=FORCE)
            self._until(lambda: state.mode == Mode.HOLDING)
            return
        reach, q = self._settings.hand.q_max, list(state.reading.q)
        touching = [False, False]

        def held() -> bool:
            for i in range(2):
                touching[i] = touching[i] or state.contacts[i].d > _DEEP
                q[i] = min(q[i] + (0.0 if touching[i] else 0.25 * REACH), reach[i])
            self._command("move", left=q[0], right=q[1])
            return all(touching)

        self._until(held)

    def _until(self, condition: Callable[[], bool]) -> None:
        finish = self._loop.state.t + _PATIENCE
        while not condition() and self._loop.state.t < finish:
            self._loop.advance(STEP)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """0.02 s of the hand's time."""
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
                self._joints[i] = min(max(self._joints[i] + REACH * share, low[i]), high[i])
            self._command("move", left=self._joints[0], right=self._joints[1])
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
        """Return the potential: how far both fingers have closed, and what they press with."""
        q, most = self._loop.state.reading.q, self._settings.hand.q_max
        force = sum(min(float(each) / FORCE, 1.0) for each in self._hand.force)
        return 5.0 * (q[0] / most[0] + q[1] / most[1] + force)

    def _observation(self) -> Observation:
        state = self._loop.state
        reading = state.reading
        frames = [finger.sensor.latest() for finger in self._loop.perception.fingers]
        felt = [(c.d, c.theta, c.force) if c.contact else (0.0,) * 3 for c in state.contacts]
        return {
            "joints": np.array([*reading.q, *reading.dq, *reading.current], np.float32),
            "contacts": np.array([*felt[0], *felt[1]], np.float32),
            "pressure": np.stack([self._empty if each is None else each.data for each in frames]),
            "goal": np.array([self._goal], np.float32),
        }

    def _info(self) -> dict[str, Any]:
        return {
            "truth": self._hand.object_pose.copy(),
            "fault": self._loop.state.fault,
            "refused": self._refused,
        }

    def close(self) -> None:
        """Torque off; the hand is gone."""
        if self._daemon is not None:
            self._daemon.close()
            self._daemon = None


class Images(gymnasium.ObservationWrapper[Observation, NDArray[np.float32], Observation]):
    """``pressure`` as Stable-Baselines3 takes images: uint8 [2, rows, cols], 255 from 50 kPa on."""

    def __init__(self, env: gymnasium.Env[Observation, NDArray[np.float32]]) -> None:
        super().__init__(env)
        inner: Any = env.unwrapped
        self._full = WHITE / inner.pascal_per_count
        known = inner.observation_space
        image = spaces.Box(0, 255, known["pressure"].shape, np.uint8)
        self.observation_space: Any = spaces.Dict({**known.spaces, "pressure": image})

    def observation(self, observation: Observation) -> Observation:
        """Return it with the grids of 8 bits."""
        grey = np.minimum(observation["pressure"] * (255.0 / self._full), 255.0)
        return observation | {"pressure": grey.astype(np.uint8)}
