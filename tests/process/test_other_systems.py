"""Test that clients and tools work without Linux-only features, which macOS and Windows lack."""

import sys
from pathlib import Path

import pytest

from softfinger.tools.cli import main
from tests.harness.daemon_process import python

ROOT = Path(__file__).parents[2]
PORTABLE = (
    "softfinger",
    "softfinger.testing.checks",
    "softfinger.testing.plugin",
    "softfinger.daemon.client.asynchronous",
    "softfinger.gym.environment",
    "softfinger.kinematics.estimation.estimator",
    "softfinger.tools.recordings.analyse",
    "softfinger.tools.recordings.plot",
    "softfinger.tools.recordings.export",
    "softfinger.tools.recordings.record",
    "softfinger.tools.recordings.replay",
    "softfinger.tools.setup.envelope",
    "softfinger.tools.terminal.monitor",
    "softfinger.tools.terminal.send",
    "softfinger.tools.viewing.foxglove_server",
    "softfinger.tools.viewing.page",
    "softfinger.tools.viewing.view",
)

# Windows defines none of these names. macOS lacks `sched_*`, epoll and some of the flags.
ELSEWHERE = """
import importlib, os, select, signal, sys
import dynamixel_sdk, numba, pyarrow, zmq  # theirs is their own business

MODULES = {"fcntl", "termios", "resource", "grp", "pwd", "pty", "tty"}

class Ban:
    def find_spec(self, name, path=None, target=None):
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Ban())
for name in MODULES:
    sys.modules.pop(name, None)
for module, names in (
    (os, ("geteuid", "getuid", "getpriority", "O_NOFOLLOW", "O_DIRECTORY", "O_NONBLOCK")),
    (os, [name for name in dir(os) if name.startswith("sched_")]),
    (select, ("epoll", "poll")),
    (signal, ("SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGALRM")),
):
    for name in names:
        delattr(module, name)
"""
WORK = """
import gymnasium
from softfinger import read_recording
from softfinger.tools.stop_condition import StopCondition

from pathlib import Path

recorded = read_recording(Path(sys.argv[1]))
with StopCondition(0.0) as ending:
    ending.begin()
    assert ending.wait(60.0)
environment = gymnasium.make("softfinger.gym:SoftFinger-Grasp-v0")
environment.reset(seed=1)
_, _, terminated, _, _ = environment.step(environment.action_space.sample())
assert not terminated
environment.close()
"""


def elsewhere(script: str, *arguments: str) -> None:
    done = python("-c", ELSEWHERE + script, *arguments, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_modules_without_a_tick_import_without_linux():
    imports = "".join(f"importlib.import_module({name!r})\n" for name in PORTABLE)
    elsewhere(imports + WORK, str(ROOT / "tests" / "golden" / "grasp_and_turn.mcap"))


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_the_daemon_reports_that_it_needs_linux(system, monkeypatch, capsys):
    monkeypatch.setattr(sys, "platform", system)
    assert main(["run"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"run: found {system}, expected Linux")
    assert said.count("\n") == 1
