"""Test the API, seeds, observations and rewards of the Gymnasium environments."""

import os
import shutil
import subprocess
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from softfinger.gym import TASKS
from softfinger.gym.__main__ import at_random, by_law, episode
from softfinger.gym.baseline import policy
from softfinger.gym.environment import Images, SoftFingerEnv
from softfinger.tools.viewing.hand_drawing import COLOURS

pytestmark = pytest.mark.filterwarnings("error")


@pytest.mark.parametrize(
    "task",
    [pytest.param(task, marks=[pytest.mark.extended] * (task != "grasp")) for task in TASKS],
)
def test_the_environment_passes_the_gymnasium_checker(task, monkeypatch):
    # Rendering to a window needs a display and is tested separately.
    monkeypatch.setitem(SoftFingerEnv.metadata, "render_modes", ["rgb_array"])
    env = gymnasium.make(f"softfinger.gym:SoftFinger-{task.capitalize()}-v0")
    check_env(env.unwrapped)
    env.close()


def test_the_picture_shows_the_hand_and_its_pressure_maps():
    env = SoftFingerEnv("rotate", "law", render_mode="rgb_array")
    env.reset(seed=1)

    def found(image: np.ndarray, part: str) -> np.ndarray:
        """Return the mean row and column of the pixels that have a part's colour."""
        close = np.abs(image[:, :400].astype(int) - COLOURS[part]).max(axis=2) < 8
        assert close.any(), part
        return np.argwhere(close).mean(axis=0)

    before = env.render()
    assert (before.shape, before.dtype) == ((300, 550, 3), np.uint8)
    assert found(before, "left")[1] < found(before, "object")[1] < found(before, "right")[1]
    for _ in range(25):
        *_, info = env.step(np.array([0.0, 0.9], np.float32))
    after = env.render()
    # To turn the object counter-clockwise, both fingers lean clockwise, that is, to the right.
    assert info["truth"][2] > 0.1
    assert found(after, "left")[1] > found(before, "left")[1] + 2
    assert found(after, "right")[1] > found(before, "right")[1] + 2
    maps = after[:, 400:].astype(int).sum(axis=2)
    bright = [np.argwhere(half > half.max() - 60).mean(axis=0) for half in (maps[:150], maps[150:])]
    assert np.abs(np.array(bright) - 75).max() < 40  # Each map shows a footprint near its middle.
    assert env.render_mode == "rgb_array"
    env.close()
    assert env.render() is None


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    if shutil.which("Xvfb") is None:
        pytest.skip("needs Xvfb")
    read, write = os.pipe()
    words = ["Xvfb", "-displayfd", str(write), "-screen", "0", "800x600x24"]
    with subprocess.Popen(words, pass_fds=[write], stderr=subprocess.DEVNULL) as server:
        os.close(write)
        with os.fdopen(read) as told:
            monkeypatch.setenv("DISPLAY", f":{told.readline().strip()}")
        yield
        server.terminate()


def test_a_window_shows_each_step(display):
    env = SoftFingerEnv("grasp", render_mode="human")
    env.reset(seed=1)
    for _ in range(3):
        env.step(np.ones(2, np.float32))
    window = env._window
    shown = np.array([window._photo.get(x, 40) for x in range(0, 550, 5)])
    np.testing.assert_array_equal(shown, env._picture()[40, ::5])
    assert env.render() is None
    window.close()  # The user closes the window.
    env.step(np.ones(2, np.float32))
    env.close()


def test_human_rendering_without_a_display_is_rejected(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    env = SoftFingerEnv("grasp", render_mode="human")
    with pytest.raises(RuntimeError, match="found 'human', but no window can be opened"):
        env.reset(seed=1)
    env.close()
    with pytest.raises(ValueError, match="found 'ansi', expected None, 'human' or 'rgb_array'"):
        SoftFingerEnv("grasp", render_mode="ansi")


def test_success_is_reported_within_the_scale_of_the_reward():
    env = SoftFingerEnv("rotate", "law")
    observation, info = env.reset(seed=1, options={"goal": 0.2})
    assert not info["is_success"]
    for _ in range(60):
        observation, *_, info = env.step(by_law(observation))
    assert abs(info["truth"][2] - 0.2) < 0.05
    assert info["is_success"]
    env.close()


def test_equal_seeds_give_equal_bits_and_other_seeds_do_not():
    env = SoftFingerEnv("push")

    def seen(seed: int) -> list[bytes]:
        found = [env.reset(seed=seed)[0]]
        for k in range(20):
            found.append(env.step(np.array([0.3, 0.1 * (k % 3)], np.float32))[0])
        return [part.tobytes() for observation in found for part in observation.values()]

    first = seen(1)
    assert seen(1) == first
    assert seen(2) != first
    env.close()


@pytest.mark.extended
def test_the_built_in_control_turns_and_holds_but_a_random_agent_does_not():
    for task, least, most in (("rotate", 150.0, 150.0), ("grasp", 120.0, 20.0)):
        name = f"SoftFinger-{task.capitalize()}-v0"
        by_joints, law = gymnasium.make(name), gymnasium.make(name, control="law")
        random = [episode(by_joints, at_random(by_joints), seed) for seed in (0, 1)]
        assert min(episode(law, by_law, seed) for seed in (0, 1)) > least
        assert np.mean(random) < most
        by_joints.close()
        law.close()


def test_a_zero_action_keeps_the_initial_grip():
    env = SoftFingerEnv("rotate")
    env.reset(seed=1)
    goals = list(env._loop.state.goal.q)
    # The load bends the joints away from their goals.
    assert np.abs(np.subtract(goals, env._loop.state.reading.q)).min() > 0.02
    for _ in range(50):
        env.step(np.zeros(2, np.float32))
    assert env._loop.state.goal.q == pytest.approx(goals)
    assert min(env._hand.force) > 7.0
    env.close()


def test_shaping_adds_the_increase_of_the_potential():
    plain, shaped = SoftFingerEnv("grasp"), SoftFingerEnv("grasp", shaped=True)
    sums = []
    for env in (plain, shaped):
        env.reset(seed=1)
        start = env._potential
        sums.append(sum(env.step(np.ones(2, np.float32))[1] for _ in range(20)))
    assert shaped._potential > start + 2.0  # The potential also increases before contact.
    assert sums[1] - sums[0] == pytest.approx(shaped._potential - start)
    plain.close()
    shaped.close()


def test_images_have_8_bits_and_the_channel_first():
    env = Images(gymnasium.make("SoftFinger-Push-v0", control="law"))
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    pressure = observation["pressure"]
    assert (pressure.dtype, pressure.shape) == (np.uint8, (2, 44, 44))
    assert 100 < pressure.max() <= 255, "the hand must be holding"
    env.close()


def test_the_baseline_closes_each_finger_based_on_its_own_features():
    def act(d: float, force: float) -> list[float]:
        contacts = np.array([d, 0.0, force, 0.0, 0.0, 0.0], np.float32)
        observed = {"contacts": contacts, "joints": np.zeros(6), "goal": np.array([6.0])}
        return policy(np.array([0.0, 5.0, 0.0, 0.0, 0.0]))(observed).tolist()

    free, pressed = act(0.0, 0.0), act(0.003, 9.0)
    assert free[0] == free[1] > 0.7
    assert pressed[0] < -0.4
    assert pressed[1] == free[1]


@pytest.mark.parametrize(
    "changes",
    [
        ('scene.fingers=["left"]', "scene.object_model=false"),
        ("servos.backend=none",),
        ("tactile.backend=none",),
    ],
)
def test_a_hand_without_all_its_parts_is_refused(changes):
    with pytest.raises(ValueError, match="expected two fingers, servos and tactile sensors"):
        SoftFingerEnv("grasp", changes=changes)


@pytest.mark.parametrize(
    ("control", "reason"), [("joints", "joint has stalled|takes too long"), ("law", "at most 2.7")]
)
def test_a_reset_without_a_grip_is_an_error(control, reason):
    env = SoftFingerEnv("push", control, profile="small")
    with pytest.raises(RuntimeError, match=f"not hold the object .*({reason})"):
        env.reset(seed=2)
    env.close()


@pytest.mark.parametrize("control", ["joints", "law"])
def test_a_nan_action_is_refused_and_the_episode_continues(control):
    task = "grasp" if control == "joints" else "rotate"
    env = SoftFingerEnv(task, control)
    env.reset(seed=1)
    good, bad = np.array([0.3, 0.2], np.float32), np.array([np.nan, 0.2], np.float32)
    *_, info = env.step(bad)
    assert info["refused"].startswith("action: found [nan, ")
    for _ in range(3):
        observation, reward, ended, _, info = env.step(good)
    assert info["refused"] == info["fault"] == ""
    assert np.isfinite(observation["joints"]).all()
    assert np.isfinite(reward)
    assert not ended
    env.close()
