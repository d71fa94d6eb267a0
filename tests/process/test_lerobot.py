"""Test that the real LeRobot package can use the hand as a robot and as an environment."""

import math
import runpy
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softfinger import Refused
from softfinger.daemon.client.stream import read
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.schema import HandState, TactileFrame
from softfinger.testing import VirtualHand
from tests.conftest import Addresses
from tests.harness.daemon_process import PATIENT, pip_installed
from tests.harness.golden_wire import sample

PACKAGE = Path(__file__).parents[2] / "lerobot_robot_softfinger"


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install the package of the robot, and register the package as LeRobot's programs do."""
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    pytest.importorskip("lerobot")
    from lerobot.utils.import_utils import register_third_party_plugins

    monkeypatch.syspath_prepend(pip_installed(PACKAGE, tmp_path / "robot"))
    register_third_party_plugins()


@pytest.fixture
def make(tmp_path: Path, addresses: Addresses, plugin: None) -> Any:
    """Return a function that creates the robot as LeRobot's programs do."""
    from lerobot.robots import RobotConfig, make_robot_from_config

    def make(**options: Any) -> Any:
        kind = RobotConfig.get_choice_class("softfinger")
        config = kind(
            id="a",
            calibration_dir=tmp_path / "calibration",
            address=",".join(addresses),
            timeout=300,
            **options,
        )
        return make_robot_from_config(config)

    return make


def act_until(robot: Any, action: dict[str, float], done: Callable[[dict[str, Any]], Any]) -> Any:
    """Send an action repeatedly, as a policy does, until ``done`` accepts an observation."""
    for _ in range(20_000):
        robot.send_action(action)
        found = robot.get_observation()
        if done(found):
            return found
    raise AssertionError(f"not by {action}; the last: {found}")


@pytest.mark.extended
def test_lerobot_drives_and_records_the_simulated_hand(make, start, profile, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils.errors import DeviceNotConnectedError

    start("--config", str(profile()), *PATIENT)
    robot = make()
    with pytest.raises(DeviceNotConnectedError):
        robot.get_observation()
    with pytest.raises(ValueError, match="found 10 × 44, expected the hand's 44 × 44"):
        make(rows=10).connect()
    robot.connect()
    first = robot.get_observation()
    assert robot._hand.state().mode == "disarmed"  # Connecting and reading do not arm the hand.
    assert set(first) == set(robot.observation_features)
    robot.calibrate()

    goal = {name: first[name] + 0.02 for name in robot.action_features}
    moved = act_until(
        robot, goal, lambda found: all(abs(found[name] - goal[name]) < 5e-3 for name in goal)
    )
    record(LeRobotDataset, robot, first, goal, moved, tmp_path / "dataset")
    with pytest.raises(Refused, match=r"left: found 515.7° \(9 rad\), expected"):
        robot.send_action({"left.pos": 9.0, "right.pos": 0.0})
    robot._hand.disarm()
    # If another client has disarmed the hand, the robot does not arm the hand again.
    with pytest.raises(Refused, match="arm first"):
        robot.send_action(goal)
    robot.disconnect()
    assert not robot.is_connected

    robot = make(control="law")
    robot.connect()
    grip = {"grip.force": 5.0, "grip.angle": 0.0}
    held = act_until(
        robot, grip, lambda found: min(found["left.force"], found["right.force"]) > 4.5
    )
    assert held["left_touch"].max() > first["left_touch"].max()
    assert robot.send_action(grip)["grip.force"] == 5.0
    # The age is negative if the frame is newer than the state.
    assert abs(held["left.touch_age"]) < 60.0
    act_until(
        robot,
        {"grip.force": 5.0, "grip.angle": 0.1},
        lambda found: abs(found["object.angle"] - 0.1) < 0.02,
    )
    act_until(
        robot, {"grip.force": 0.0, "grip.angle": 0.0}, lambda found: not found["left.contact"]
    )
    hand = robot._hand
    assert hand.status()["torque"]
    robot.disconnect()
    again = make()
    again.connect()
    assert not again._hand.status()["torque"]
    again.disconnect()


@pytest.mark.extended
def test_the_environment_has_the_features_and_actions_of_the_robot(plugin):
    from lerobot.envs.configs import EnvConfig
    from lerobot.envs.factory import make_env
    from lerobot.envs.utils import env_to_policy_features, preprocess_observation

    kind = EnvConfig.get_choice_class("softfinger")

    def made(**options: Any) -> Any:
        return make_env(kind(**options), n_envs=1)["softfinger"][0]

    env = made(task="Rotate-v0")
    seen, _ = env.reset(seed=[1])
    goal = float(seen["environment_state"][0, 0])
    for _ in range(100):  # The action consists of a force [N] and an angle [rad].
        seen, reward, *_, info = env.step(np.array([[6.0, goal]], np.float32))
    observed = preprocess_observation(seen)
    for name, feature in env_to_policy_features(kind()).items():
        if name != "action":
            assert tuple(observed[name].shape[1:]) == feature.shape, name
    state = dict(zip(STATE, observed["observation.state"][0].tolist(), strict=True))
    assert state["object.angle"] == pytest.approx(goal, abs=0.02)
    assert state["left.force"] == pytest.approx(6.0, abs=0.5)
    assert 0.0 <= state["left.touch_age"] < 0.06
    assert reward[0] > 0.7
    assert info["is_success"][0]
    assert env.call("_max_episode_steps") == (200,)
    assert env.call("task_description") == ("turn the held object to the goal",)
    assert env.call("render")[0].shape == (300, 550, 3)
    env.close()

    env = made(task="Grasp-v0", control="joints")
    seen, _ = env.reset(seed=[1])
    at = seen["agent_pos"][0, [STATE.index(f"{each}.pos") for each in ("left", "right")]]
    for _ in range(20):
        seen, *_, info = env.step((at + 0.1)[None])
    after = seen["agent_pos"][0, [STATE.index(f"{each}.pos") for each in ("left", "right")]]
    np.testing.assert_allclose(after, at + 0.1, atol=0.01)
    assert not info["is_success"][0]
    env.close()


def record(kind, robot, first, action, moved, root):
    """Write two observations with LeRobot's own recorder and read them back."""
    try:
        from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features
    except ImportError:  # LeRobot 0.4 has another module name.
        from lerobot.datasets.utils import build_dataset_frame, hw_to_dataset_features
    features = hw_to_dataset_features(robot.action_features, "action", False)
    features |= hw_to_dataset_features(robot.observation_features, "observation", False)
    dataset = kind.create("a/b", 10, features, root=root, robot_type=robot.name, use_videos=False)
    for each in (first, moved):
        frame = build_dataset_frame(features, each, "observation")
        frame |= build_dataset_frame(features, action, "action")
        dataset.add_frame(frame | {"task": "move"})
    dataset.save_episode()
    dataset.finalize()
    item = kind("a/b", root=root)[1]
    names = features["observation.state"]["names"]
    np.testing.assert_allclose(
        item["observation.state"].numpy(), [moved[name] for name in names], rtol=1e-6
    )
    assert tuple(item["observation.images.left_touch"].shape) == (3, 44, 44)
    picture = item["observation.images.left_touch"].numpy()[0] * 255.0
    np.testing.assert_allclose(picture, moved["left_touch"][:, :, 0], atol=1e-3)


# Run the module by its path, because importing the package would import LeRobot.
MODULES = PACKAGE / "lerobot_robot_softfinger"
features = runpy.run_path(str(MODULES / "features.py"))
STATE, image, observation = (features[name] for name in ("STATE", "image", "observation"))


def frame(counts: list[list[int]], t: float, scale: float = 1000.0) -> TactileFrame:
    data = np.array(counts, "<u2")
    message = dict(zip(("rows", "cols"), data.shape, strict=True)) | {"data": data.tobytes()}
    given = {**sample(schema.TACTILE), **message, "scale": scale, "mono_ns": round(t * 1e9)}
    return read(TactileFrame, given)


def test_unknown_values_and_values_without_contact_are_zero():
    state = read(HandState, sample(schema.STATE))
    left = replace(state.left, q=0.1, contact=True, d=1e-3, theta=math.nan, force=2.0)
    right = replace(state.right, q=-0.2, contact=False, d=2e-3, force=3.0)
    unknown = replace(state.object, valid=False, angle=0.3)
    state = replace(state, left=left, right=right, object=unknown, mono_ns=5_000_000_000)
    given = {"left": frame([[0]], 4.99), "right": frame([[0]], 4.75)}
    found = observation(state, given)
    assert tuple(found) == STATE
    expected = {
        "left.pos": 0.1,
        "left.contact": 1.0,
        "left.d": 1e-3,
        "left.theta": 0.0,
        "left.force": 2.0,
        "left.touch_age": 0.01,
        "right.pos": -0.2,
        "right.contact": 0.0,
        "right.d": 0.0,
        "right.force": 0.0,
        "right.touch_age": 0.25,
        "object.angle": 0.0,
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected)


def test_an_image_is_linear_and_saturates_at_full_scale():
    found = image(frame([[0, 1, 50], [100, 101, 65535]], 0.0).pressure, full_scale=100e3)
    assert found.dtype == np.uint8
    assert found.shape == (2, 3, 3)
    for channel in range(3):
        np.testing.assert_array_equal(found[:, :, channel], [[0, 3, 128], [255, 255, 255]])


def test_a_robot_opens_a_grip_that_it_found_and_returns_the_sent_actions(monkeypatch):
    robot = type("Robot", (), {"__init__": lambda self, config: None})
    unchecked = dict.fromkeys(("check_if_already_connected", "check_if_not_connected"), lambda f: f)
    # Replace the parts of LeRobot that the robot needs, because LeRobot may not be installed.
    for name, contents in {
        "lerobot.robots": {"Robot": robot},
        "lerobot.utils.decorators": unchecked,
        "lerobot_robot_softfinger.config_softfinger": {"SoftfingerConfig": object},
        "lerobot_robot_softfinger.features": features,
    }.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**contents))
    times = dict.fromkeys(("timeout", "start_timeout"), 5.0)
    config = SimpleNamespace(
        control="law", least_force=0.5, rows=44, cols=44, address=None, keys=None, **times
    )
    with VirtualHand() as hand:
        monkeypatch.setattr("softfinger.Hand", lambda *_, **__: hand)
        made = runpy.run_path(str(MODULES / "softfinger.py"))["Softfinger"](config)
        hand.arm()
        hand.grasp(force=5.0)
        hand.wait_for(lambda state: state.mode == "holding")
        made.connect()
        grip = {"grip.force": 5.0, "grip.angle": 0.1}
        opened = {"grip.force": 0.0, "grip.angle": 0.0}
        assert made.send_action({"grip.force": 0.4, "grip.angle": 0.1}) == opened
        assert hand.state().mode == "releasing"
        assert made.send_action(grip) == opened  # The hand first opens completely.
        hand.wait_for(lambda state: state.mode == "armed")
        assert made.send_action(grip) == grip
        assert hand.state().mode == "grasping"
