"""No kernel is compiled, nor loaded from the cache, in a running loop: all are warm before it."""

from __future__ import annotations

import json
from typing import Any

from tests.harness.daemon_process import python
from tests.harness.emulated import EmulatorProcess
from tests.harness.warm_scenes import HIL, SCENES


def test_no_kernel_is_compiled_or_loaded_in_a_running_loop(tmp_path):
    with EmulatorProcess("--dir", tmp_path, "--config", HIL) as hand:
        hand.ready()
        done = python("-m", "tests.harness.warm_scenes", tmp_path)
    told: dict[str, dict[str, Any]] = {}
    for line in done.stdout.splitlines():
        scene = json.loads(line)
        told[scene["scene"]] = scene
    assert set(told) == {*SCENES, "calibrated sensor", "stand-in hand"}
    for name, scene in told.items():
        assert scene["before"] >= 5, f"{name}: the watch heard nothing of the warm-up"
        assert scene["in no part"] == [], f"{name}: the daemon itself would compile these"
        assert scene["after"] == [], name
        servos = name != "sensors without servos"
        blind = name in ("servos without sensors", "position mode")
        wanted = {"disarmed"} | ({"armed"} if servos else set())
        wanted |= {"grasping"} if servos and not blind else set()
        # A machine that is too busy for the real-time scene is no fault of its kernels.
        timely = name != "stand-in hand"
        wanted |= {"holding", "releasing"} if servos and not blind and timely else set()
        assert wanted <= set(scene["modes"]), (name, scene["faults"])
        assert not (scene["faults"] and timely), (name, scene["faults"])
