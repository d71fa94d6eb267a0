"""With a Numba that the compiler was not tested with, Numba alone compiles the same kernels."""

from __future__ import annotations

import os
from pathlib import Path

from tests.harness.daemon_process import python

# All kernels of the default scene: the recording runs the estimator, the filter and the grip, the
# loop the simulated hand and its sensors.
SCRIPT = """
import sys
import numba
import pytest

numba.__version__ = "99.0"
from softfinger.kinematics.compiled.kernel import why_plain

assert why_plain.startswith("Numba 99.0 is not one of 0.63")
tests = "golden_recording", "kernels", "loop"
files = [f"tests/unit/test_{name}.py" for name in tests]
sys.exit(pytest.main(["-q", "-n0", "-p", "no:cacheprovider", *files]))
"""


def test_tests_of_the_loop_and_its_kernels_pass_with_numba_alone(request):
    kept = str(request.config.cache.mkdir("plain-numba"))  # apart: those of others are in use
    environment = os.environ | {"NUMBA_CACHE_DIR": kept}
    done = python("-c", SCRIPT, cwd=Path(__file__).parents[2], env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
