"""Run scenes of many kinds, and report each scene's compiled and loaded kernels.

``python -m tests.harness.warm_scenes FOLDER SCENE…`` prints one line of JSON per scene. A
calibration file is written to FOLDER. For the scene with an emulated hand, FOLDER must contain the
hand's ports. Each scene runs in a fork of a process that has not called any kernel yet. A scene
therefore cannot warm up kernels for other scenes.
"""

import contextlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from numba.core import event

from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.warm_up import WantedScene, warm_up
from softfinger.daemon.perception.calibration_file import (
    Calibration,
    TareStep,
    now,
    save_calibration,
    sensor_of,
)
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from tests.harness.daemon_process import PATIENCE

CALIBRATED, STAND_IN = "calibrated sensor", "stand-in hand"
SCENES: dict[str, dict[str, Any]] = {
    "two fingers": {},
    "left finger, constant modulus": {
        "scene": {"fingers": ("left",)},
        "material": {"law": "constant"},
    },
    "sensors without servos": {"servos": {"backend": "none"}},
    "servos without sensors": {"tactile": {"backend": "none"}},
    "imperfect sensors, current mode, upright grip": {
        "simulation": {"tactile_blur": 5e-4, "tactile_jitter": 0.004},
        "servos": {"mode": "current"},
        "control": {"law": "upright"},
    },
    "position mode": {"servos": {"mode": "position"}},
}
SCRIPT: list[tuple[float, dict[str, Any]]] = [
    (0.1, {"command": "arm"}),
    (0.1, {"command": "move", "left": 0.1, "right": 0.1}),
    (0.3, {"command": "grasp", "force": 6.0}),
    (1.3, {"command": "rotate", "angle": 0.05}),
    (0.7, {"command": "set", "compliance": 0.01}),
    (0.2, {"command": "release"}),
    (0.7, {"command": "tare"}),
    (0.2, {"command": "stop"}),
    (0.1, {"command": "clear"}),
    (0.1, {"command": "status"}),
]


class Watch(event.Listener):
    """Record when kernels are compiled or loaded from the cache, since both delay a tick."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    def on_start(self, event: Any) -> None:
        """Record the compiler's callers from the stack."""
        frame, names = sys._getframe(), []
        while frame is not None and len(names) < 40:
            if "/numba/" not in frame.f_code.co_filename:
                names.append(f"{Path(frame.f_code.co_filename).name}:{frame.f_code.co_name}")
            frame = frame.f_back
        self.heard.append(" < ".join(names[1:5]))

    def on_end(self, event: Any) -> None:
        """Ignore the end of a compilation."""


def run(settings: Settings) -> dict[str, Any]:
    """Run the script; report the kernels compiled before and during the script."""
    watch = Watch()
    modes, faults = [], []
    with event.install_listener("numba:compiler_lock", watch):
        warm_up(WantedScene(settings))
        parts = len(watch.heard)
        hand = Daemon(settings, wire=False)
        before = len(watch.heard)
    with event.install_listener("numba:compiler_lock", watch), hand:
        for wait, request in SCRIPT:
            hand.loop.advance(wait)
            for _ in range(300):  # The ticks may take long on a busy machine.
                if hand.loop.state.mode not in ("grasping", "rotating"):
                    break
                hand.loop.advance(0.1)
            fault = hand.loop.state.fault_name
            with contextlib.suppress(Refused):  # Not every scene supports every command.
                hand.loop.command(request)
            hand.loop.advance(hand.loop.period)
            modes.append(hand.loop.state.mode)
            faults += [fault] if fault else []
    unforeseen, after = watch.heard[parts:before], watch.heard[before:]
    heard = {"before": before, "in no part": unforeseen, "after": after}
    return {**heard, "modes": sorted(set(modes)), "faults": faults}


def calibrated(folder: Path) -> dict[str, Any]:
    """Return settings with a calibrated left sensor, whose frames contain pressures."""
    settings = Settings()
    cells = [[0.0] * settings.tactile.cols for _ in range(settings.tactile.rows)]
    tare = TareStep(date=now(), zero=cells, noise=1520.0, frames=16)
    path = folder / "left.json"
    calibration = Calibration(sensor=sensor_of(settings, 0), date=now(), tare=tare)
    save_calibration(path, calibration)
    return {"tactile": {"calibration": (str(path), "")}}


def main(folder: Path, names: list[str]) -> None:
    """Run each named scene in a fork."""
    sections = {**SCENES, CALIBRATED: calibrated(folder)}
    scenes = {
        name: Settings.model_validate({"loop": {"clock": "virtual"}, **scene})
        for name, scene in sections.items()
    }
    if STAND_IN in names:
        changes = [f"{key}={value}" for key, value in PATIENCE.items()]
        scenes[STAND_IN] = load(Path("hil"), folder, changes)
    for name in names:
        child = os.fork()
        if child == 0:
            print(json.dumps({"scene": name, **run(scenes[name])}), flush=True)
            os._exit(0)
        if os.waitpid(child, 0)[1]:
            sys.exit(f"{name}: failed")  # The child has already printed the reason.


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
