"""No kernel is compiled, nor loaded from the cache, in a running loop: all are warm before it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.harness.daemon_process import SOFTFINGER
from tests.harness.descendants import ending
from tests.harness.warm_scenes import HIL, SCENES


def test_no_kernel_is_compiled_or_loaded_in_a_running_loop(tmp_path: Path) -> None:
    emulate = [*SOFTFINGER, "emulate", "--dir", str(tmp_path), "--config", str(HIL)]
    with ending(subprocess.Popen(emulate, stdout=subprocess.PIPE, text=True)) as hand:
        assert hand.stdout is not None
        assert hand.stdout.readline() == "ready\n"
        done = subprocess.run(
            [sys.executable, "-m", "tests.harness.warm_scenes", str(tmp_path)],
            capture_output=True, text=True, check=True, timeout=290,
        )  # fmt: skip
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
