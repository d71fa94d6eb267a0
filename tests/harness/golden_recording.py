"""Generate the golden recording of a grasp, a turn, a refused command, a release and a stop.

Run ``python -m tests.harness.golden_recording`` after an intentional change to the hand's
behaviour. The JSON file next to the recording lists the machine and package versions used.
"""

import json
import os
import platform
from pathlib import Path

import llvmlite
import llvmlite.binding
import numba
import numpy as np

from tests.harness import arithmetic
from tests.harness.recorded_hand import record_hand

GOLDEN = Path(__file__).parents[1] / "golden"
RECORDING = GOLDEN / "grasp_and_turn.mcap"
MADE_ON = GOLDEN / "grasp_and_turn.json"

_COMMANDS = {
    50: {"command": "arm"},
    51: {"command": "grasp", "force": 6.0},
    500: {"command": "move", "left": 0.1},  # A hand that holds an object refuses this command.
    550: {"command": "rotate", "angle": 0.1},
    800: {"command": "release"},
    930: {"command": "stop"},
}
_SMALL_GRID = ("tactile.rows=20", "tactile.cols=20", "tactile.pitch=0.0029")


def machine_class() -> dict[str, str]:
    """Return the machine properties that affect the last bits of the results."""
    return {
        "processor": os.environ.get("NUMBA_CPU_NAME") or llvmlite.binding.get_host_cpu_name(),
        "chosen": " ".join(f"{name}={value}" for name, value in arithmetic.chosen().items()),
        "system": f"{platform.system()} {platform.machine()}",
        "llvmlite": llvmlite.__version__,
        "numba": numba.__version__,
        "numpy": np.__version__,
    }


if __name__ == "__main__":
    RECORDING.unlink(missing_ok=True)
    record_hand(RECORDING, _COMMANDS, 2.0, ("stream.state_rate=500", *_SMALL_GRID))
    MADE_ON.write_text(json.dumps(machine_class(), indent=1) + "\n", encoding="utf-8")
