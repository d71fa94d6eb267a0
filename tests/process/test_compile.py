"""Test ahead-of-time compilation with `softfinger compile`, and a loop that never compiles."""

import contextlib
import json
import math
import os
import signal
import subprocess
import threading
from pathlib import Path
from typing import Any

import psutil
import pytest

from softfinger.daemon.loop.warm_up import named
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.processes import compile as kernels
from tests.conftest import until
from tests.harness.daemon_process import python, softfinger, started
from tests.harness.descendants import ending
from tests.harness.emulated import EmulatorProcess
from tests.harness.warm_scenes import CALIBRATED, SCENES, STAND_IN

BARE = ["--set", "servos.backend=dynamixel", "--set", "tactile.backend=none"]


def environment(folder: Path) -> dict[str, str]:
    """Return an environment with a separate, empty cache."""
    own = os.environ | {"XDG_CACHE_HOME": str(folder)}
    own.pop("NUMBA_CACHE_DIR", None)
    return own


def compiled(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run `softfinger compile` with a separate cache."""
    return softfinger("compile", *BARE, *words, env=environment(folder))


def steep(folder: Path) -> Path:
    """Return a profile with a material for which no contact table meets the tolerance."""
    strain = [0.1 * k for k in range(11)]
    stress = [1e5 * (math.exp(9.0 * each) - 1.0) for each in strain]
    file = folder / "steep.toml"
    file.write_text(f"[material]\nlaw = 'points'\n{strain = }\n{stress = }\n")
    return file


@pytest.mark.extended
def test_a_part_is_compiled_once_and_has_the_kernel_count_of_the_progress_bar(tmp_path):
    table = named("contact table")
    settings = Settings().model_dump_json()
    own = {"input": f"{settings}\n{table.name}\n", "env": environment(tmp_path)}
    done = python("-m", "softfinger.tools.processes.compile", **own)
    *kernels, last = done.stdout.splitlines()
    assert last == "done"
    # `table.kernels` is the count for the newest Numba version. The oldest supported version
    # reports a third fewer kernels.
    assert 0.6 * table.kernels <= len(kernels) <= 1.2 * table.kernels
    # Mark both sets of kernels as compiled.
    (mark,) = (tmp_path / "softfinger").glob("kernels-*/contact-table-springs.built")
    mark.with_name("joints-and-timing-springs.built").touch()
    again = compiled(tmp_path)
    assert (again.returncode, again.stdout, again.stderr) == (0, "all kernels are compiled\n", "")
    mark.unlink()
    rest = compiled(tmp_path)
    assert rest.returncode == 0
    first, part, last = rest.stderr.splitlines()
    assert first == "compiling kernels (only on the first start): contact table"
    assert part.startswith("contact table: ")
    assert last.startswith("compiled in ")
    # The output and the exit status report a failed compilation.
    mark.unlink()
    bad = compiled(tmp_path, "--config", str(steep(tmp_path)))
    assert bad.returncode == 1
    assert (
        "contact table was not compiled ahead of time: SettingsError: table.tolerance" in bad.stderr
    )


def test_kernels_that_cannot_be_stored_are_a_failure(tmp_path):
    file = tmp_path / "file"
    file.touch()
    done = softfinger("compile", env=os.environ | {"NUMBA_CACHE_DIR": str(file)})
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.splitlines()[-1].startswith("the kernels can't be stored, so each process")


def test_ctrl_c_before_a_compiler_thread_starts_is_passed_on(monkeypatch):
    def interrupted(_: threading.Thread) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(threading.Thread, "start", interrupted)
    monkeypatch.setattr(kernels, "is_built", lambda *_: False)
    with pytest.raises(KeyboardInterrupt):
        kernels.build_kernels(Settings(), lambda *_: None, bar=False)


def test_compilation_by_plain_numba_is_explained_in_one_line(monkeypatch):
    monkeypatch.setattr(kernels, "is_built", lambda *_: False)
    monkeypatch.setattr(kernels, "why_plain", "Numba 99.0 is new")
    monkeypatch.setattr(kernels._Build, "run", lambda _: None)
    told: list[str] = []
    kernels.build_kernels(Settings(), lambda *event: told.append(event[2]), bar=False)
    assert [text for text in told if "99.0" in text] == [
        "compiling with Numba alone, which takes twice as long: Numba 99.0 is new"
    ]


def test_kernels_are_compiled_where_the_available_memory_is_unknown(monkeypatch):
    monkeypatch.setattr(kernels, "_available", lambda: math.inf)
    monkeypatch.setattr(kernels._Build, "_build", lambda *_: "")
    assert kernels._Build(Settings(), [named("contact table")], lambda *_: None, False).run()


def test_ctrl_c_ends_every_compiler_process(tmp_path):
    with ending(started("compile", env=environment(tmp_path))) as process:
        assert process.stderr.readline().startswith("compiling kernels (only on the first start):")
        until(psutil.Process(process.pid).children)
        compilers = psutil.Process(process.pid).children()
        process.send_signal(signal.SIGINT)
        assert (process.wait(300.0), process.stderr.read()) == (130, "")
        assert psutil.wait_procs(compilers, timeout=300.0)[1] == []


@pytest.mark.parametrize(
    "names",
    [
        ["two fingers", CALIBRATED],
        pytest.param([*SCENES, CALIBRATED, STAND_IN], marks=pytest.mark.extended),
    ],
    ids=["two", "all"],
)
def test_no_kernel_is_compiled_or_loaded_in_a_running_loop(tmp_path, names):
    with contextlib.ExitStack() as stack:
        if STAND_IN in names:
            hand = stack.enter_context(EmulatorProcess("--dir", tmp_path, "--config", "hil"))
            hand.ready()
        done = python("-m", "tests.harness.warm_scenes", tmp_path, *names)
    told: dict[str, dict[str, Any]] = {}
    for line in done.stdout.splitlines():
        scene = json.loads(line)
        told[scene["scene"]] = scene
    assert set(told) == set(names)
    for name, scene in told.items():
        assert scene["before"] >= 5, f"{name}: the warm-up compilation was not observed"
        assert scene["in no part"] == [], f"{name}: the daemon would compile these itself"
        assert scene["after"] == [], name
        servos = name != "sensors without servos"
        blind = name in ("servos without sensors", "position mode")
        wanted = {"disarmed"} | ({"armed"} if servos else set())
        wanted |= {"grasping"} if servos and not blind else set()
        # On a busy machine, the real-time scene may not reach all modes.
        timely = name != STAND_IN
        wanted |= {"holding", "releasing"} if servos and not blind and timely else set()
        assert wanted <= set(scene["modes"]), (name, scene["faults"])
        assert not (scene["faults"] and timely), (name, scene["faults"])
