"""Test that Numba's own compiler, used for untested Numba versions, gives the same results."""

import os
from pathlib import Path

import numpy as np
import pytest

from softfinger import ContactTable
from tests.harness.daemon_process import python
from tests.harness.golden_recording import machine_class
from tests.harness.paper_tip import MEASURED, TIP

# The script tests each kind of kernel. The tables use SIMD lanes and selected callees. The
# estimator uses reorderable sums and inlined loops over the cells of a frame. The grip uses nested
# records.
SCRIPT = """
import sys
import numba
import pytest

numba.__version__ = "99.0"
from softfinger.kinematics.compiled.kernel import why_plain

assert why_plain.startswith("Numba 99.0 has not been tested")
tests = "kernels", "pressure_grid"
files = [f"tests/unit/test_{name}.py" for name in tests]
files.append("tests/unit/test_estimator_kernels.py::test_activity_matches_plain_numpy")
files.append("tests/unit/test_table.py::test_tolerance_holds_over_the_whole_domain")
files.append("tests/unit/test_grip_loads.py::test_one_finger_alone_presses_with_the_requested_force")
failed = pytest.main(["-q", "-n0", "-p", "no:cacheprovider", *files])
from tests.process.test_plain_numba import figures

print(figures())
sys.exit(failed)
"""


# On this processor, both compilers produce bit-identical results. On other processors, the two
# compilers may differ in which multiplications and additions they fuse.
SAME_BITS = "znver3"


def figures() -> str:
    """Return a table's values as text that is exact to the last bit."""
    d = np.linspace(0.0, 8e-3, 200)
    found = ContactTable.build(TIP, MEASURED, 1e-9)(d, 40.0 * d)
    return " ".join(float(each).hex() for each in np.array(found[:6]).ravel())


@pytest.mark.extended
def test_plain_numba_passes_tests_of_every_kind_of_kernel_with_the_same_results(request):
    # Use a separate cache, because other tests use the shared cache.
    kept = str(request.config.cache.mkdir("plain-numba"))
    environment = os.environ | {"NUMBA_CACHE_DIR": kept}
    done = python("-c", SCRIPT, cwd=Path(__file__).parents[2], env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    alone, own = done.stdout.splitlines()[-1], figures()
    if machine_class()["processor"] == SAME_BITS:
        assert alone == own
    numbers = [[float.fromhex(each) for each in text.split()] for text in (alone, own)]
    np.testing.assert_allclose(*numbers, rtol=1e-12)
