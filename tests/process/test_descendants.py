"""Test that all processes that a test has started, even orphans, end with the test."""

import subprocess
import sys

import psutil
import pytest

from tests.conftest import until
from tests.harness import descendants

PARENT = """
import subprocess, sys
child = subprocess.Popen(["sleep", "1000"], start_new_session=True)
print(child.pid, flush=True)
if sys.argv[1] == "waits":
    child.wait()
"""


@pytest.mark.parametrize("parent", ["waits", "ends"])
def test_all_descendants_of_a_test_are_ended(parent):
    before = descendants.running()
    words = [sys.executable, "-c", PARENT, parent]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    child = psutil.Process(int(process.stdout.readline()))
    process.stdout.close()
    if parent == "ends":
        assert process.wait(300.0) == 0
        assert child.is_running(), "this process must adopt the orphan"
    descendants.end(descendants.running() - before)
    assert not child.is_running()
    assert not descendants.running() - before


def test_children_of_a_killed_process_are_killed():
    code = f"from tests.harness import descendants\ndescendants.end_with_this_process()\n{PARENT}"
    words = [sys.executable, "-c", code, "waits"]
    with descendants.ending(subprocess.Popen(words, stdout=subprocess.PIPE, text=True)) as process:
        child = psutil.Process(int(process.stdout.readline()))
        assert child.is_running()
        process.kill()
        until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)
