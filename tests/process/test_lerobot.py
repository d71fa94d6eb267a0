"""The hand as a robot of LeRobot: found, driven and recorded by the real package."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softfinger import Refused
from softfinger.daemon.client.stream import read
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.schema import TactileFrame
from softfinger.tools.recordings.lerobot_dataset import image, observation, samples
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.record import RecordingWriter
from tests.conftest import Addresses, Inline
from tests.harness.daemon_process import PATIENT, pip_installed
from tests.harness.golden_wire import sample
from tests.process.test_record import frame

PACKAGE = Path(__file__).parents[2] / "lerobot_robot_softfinger"


@pytest.fixture
def make(tmp_path: Path, addresses: Addresses, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes the robot as LeRobot's programs do, of the installed package."""
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    pytest.importorskip("lerobot")
    from lerobot.robots import RobotConfig, make_robot_from_config
    from lerobot.utils.import_utils import register_third_party_plugins

    monkeypatch.syspath_prepend(pip_installed(PACKAGE, tmp_path / "robot"))
    register_third_party_plugins()

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
    """Give one action again and again, as a policy does, until an observation is as wanted."""
    for _ in range(20_000):
        robot.send_action(action)
        found = robot.get_observation()
        if done(found):
            return found
    raise AssertionError(f"not by {action}; the last: {found}")


def test_lerobot_drives_and_records_the_simulated_hand(make, start, profile, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils.errors import DeviceNotConnectedError

    start("--config", str(profile()), *PATIENT)
    robot = make()
    with pytest.raises(DeviceNotConnectedError):
        robot.get_observation()
    with pytest.raises(ValueError, match="found 10 × 44, the hand's grids have 44 × 44"):
        make(rows=10).connect()
    robot.connect()
    first = robot.get_observation()
    assert robot._hand.state().mode == "disarmed"  # connecting and looking left it as it was
    assert set(first) == set(robot.observation_features)
    robot.calibrate()

    goal = {name: first[name] + 0.02 for name in robot.action_features}
    moved = act_until(
        robot, goal, lambda found: all(abs(found[name] - goal[name]) < 5e-3 for name in goal)
    )
    record(LeRobotDataset, robot, first, goal, moved, tmp_path / "dataset")
    with pytest.raises(Refused, match=r"left: found 9 rad, expected"):
        robot.send_action({"left.pos": 9.0, "right.pos": 0.0})
    robot._hand.disarm()
    with pytest.raises(Refused, match="arm first"):  # who disarmed it is not overruled
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
    assert abs(held["left.touch_age"]) < 60.0  # a frame newer than the state may have come
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


def record(
    kind: Any,
    robot: Any,
    first: dict[str, Any],
    action: dict[str, float],
    moved: dict[str, Any],
    root: Path,
) -> None:
    """Two observations as LeRobot's own recorder writes them, and read again."""
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


RATE = 100


class Exported:
    """Two seconds of states, each fourth with a frame of both sensors before it, as a dataset."""

    def __init__(self, tmp_path: Path, inline: Inline) -> None:
        import pyarrow.parquet

        self.path, self.root = tmp_path / "a.mcap", tmp_path / "a.mcap.lerobot"
        self.states, self.frames = recorded(self.path)
        done = inline("export", self.path, "--lerobot", "--task", "grasp")
        assert done.returncode == 0, done.stderr
        self.info = json.loads((self.root / "meta/info.json").read_text())
        self.stats = json.loads((self.root / "meta/stats.json").read_text())
        table = pyarrow.parquet.read_table(self.root / "data/chunk-000/file-000.parquet")
        self.rows = table.to_pylist()
        self.names = self.info["features"]["observation.state"]["names"]


def test_a_recording_is_a_dataset_at_its_sensors_rate(tmp_path, inline):
    exported = Exported(tmp_path, inline)
    rows, names = exported.rows, exported.names
    assert (exported.info["fps"], exported.info["total_frames"], len(rows)) == (25, 51, 51)
    for row in rows:
        k = round(row["timestamp"] * RATE)
        state, found = exported.states[k], dict(zip(names, row["observation.state"], strict=True))
        assert found["left.pos"] == pytest.approx(state["left"]["q"])
        assert row["action"][1] == pytest.approx(state["right"]["goal_q"])
        assert found["left.touch_age"] == 0.0
    place = names.index("left.pos")
    mean = np.mean([row["observation.state"][place] for row in rows])
    assert exported.stats["observation.state"]["mean"][place] == pytest.approx(mean)


def test_other_rates_repeat_frames_with_their_age(tmp_path, inline):
    recorded(tmp_path / "a.mcap")
    rows = list(samples(Recording(tmp_path / "a.mcap"), 50, end=1.0))
    ages = [observation(*row)["right.touch_age"] for row in rows]
    assert ages == pytest.approx([0.0, 0.02] * 25 + [0.0])
    done = inline("export", tmp_path / "a.mcap", "--lerobot", "--topics", "state")
    assert (done.returncode, "leave out --topics" in done.stderr) == (1, True)


def test_lerobot_loads_the_dataset(tmp_path, inline, monkeypatch):
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    pytest.importorskip("lerobot")
    from lerobot.datasets.compute_stats import compute_episode_stats
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    exported = Exported(tmp_path, inline)
    rows, shift = exported.rows, {"action": [0.0, 0.04]}
    dataset = LeRobotDataset("a/b", root=exported.root, delta_timestamps=shift)
    assert len(dataset) == len(rows)
    for k in (0, 25, 49):
        item = dataset[k]
        assert item["task"] == "grasp"
        np.testing.assert_array_equal(item["observation.state"], rows[k]["observation.state"])
        np.testing.assert_array_equal(item["action"], [rows[k]["action"], rows[k + 1]["action"]])
        for name, frames in exported.frames.items():
            picture = item[f"observation.images.{name}_touch"].numpy() * 255.0
            expected = image(read(TactileFrame, frames[k])).transpose(2, 0, 1)
            assert expected.max() > 0
            np.testing.assert_allclose(picture, expected, atol=1e-3)
    told = {"observation.state": np.array([row["observation.state"] for row in rows])}
    own = compute_episode_stats(told, exported.info["features"])
    for name in ("min", "max", "mean", "std", "count"):
        mine = dataset.meta.stats["observation.state"][name]
        np.testing.assert_allclose(mine, own["observation.state"][name], rtol=1e-5, atol=1e-7)


def recorded(path: Path) -> tuple[list[dict[str, Any]], dict[str, list[dict[str, Any]]]]:
    """Two seconds of 100 states a second, each fourth with a frame of both sensors before it."""
    states: list[dict[str, Any]] = []
    frames: dict[str, list[dict[str, Any]]] = {"left": [], "right": []}
    writer = RecordingWriter(path)
    for k in range(2 * RATE + 1):
        t = {"timestamp": 1e9 + k / RATE, "mono_ns": k * 1_000_000_000 // RATE}
        if k % 4 == 0:
            for index, name in enumerate(frames):
                frames[name].append(frame(k / RATE, index) | t | {"scale": 100.0})
                writer.add(schema.TACTILE, dict(frames[name][-1]))
        state = sample(schema.STATE) | t | {"seq": k}
        state["left"] = state["left"] | {"q": k * 1e-3}
        state["right"] = state["right"] | {"goal_q": k * -2e-3}
        states.append(state)
        writer.add(schema.STATE, copy.deepcopy(state))
    writer.close()
    return states, frames
