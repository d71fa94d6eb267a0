"""The Gymnasium environments: API checker, reproducible seeds, observations and rewards."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from softfinger.gym import TASKS
from softfinger.gym.__main__ import at_random, by_law, episode
from softfinger.gym.baseline import policy
from softfinger.gym.environment import Images, SoftFingerEnv

pytestmark = pytest.mark.filterwarnings("error")


@pytest.mark.parametrize(
    "task",
    [pytest.param(task, marks=[pytest.mark.extended] * (task != "grasp")) for task in TASKS],
)
def test_the_environment_passes_the_gymnasium_checker(task):
    env = gymnasium.make(f"SoftFinger-{task.capitalize()}-v0")
    check_env(env.unwrapped, skip_render_check=True)
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


def test_shaping_adds_the_increase_of_the_potential():
    plain, shaped = SoftFingerEnv("grasp"), SoftFingerEnv("grasp", shaped=True)
    sums = []
    for env in (plain, shaped):
        env.reset(seed=1)
        start = env._potential
        sums.append(sum(env.step(np.ones(2, np.float32))[1] for _ in range(20)))
    assert shaped._potential > start + 2.0  # closing increases the potential before first contact
    assert sums[1] - sums[0] == pytest.approx(shaped._potential - start)
    plain.close()
    shaped.close()


def test_images_have_8_bits_and_the_channel_first():
    env = Images(gymnasium.make("SoftFinger-Push-v0", control="law"))
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    pressure = observation["pressure"]
    assert (pressure.dtype, pressure.shape) == (np.uint8, (2, 44, 44))
    assert 100 < pressure.max() <= 255, "the hand holds"
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
