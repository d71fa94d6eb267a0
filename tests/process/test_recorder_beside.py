"""`run --record` when its recorder dies or its disk is full: told at once, and in the end."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from softfinger.daemon.client.hand import Hand
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.record import recover
from tests.conftest import until
from tests.harness.daemon_process import Running

Profile = Callable[[str], Path]


def recorder_of(daemon: Running) -> int:
    process = daemon.process.pid
    found = [
        int(child)
        for task in Path(f"/proc/{process}/task").iterdir()
        for child in (task / "children").read_text().split()
    ]
    [recorder] = [each for each in found if b"record" in Path(f"/proc/{each}/cmdline").read_bytes()]
    return recorder


def killed(recorder: int, _: Path) -> None:
    os.kill(recorder, signal.SIGKILL)


def disk_full(recorder: int, path: Path) -> None:
    most = path.stat().st_size + 1000
    resource.prlimit(recorder, resource.RLIMIT_FSIZE, (most, most))


@pytest.mark.parametrize(
    ("end", "why"),
    [
        (killed, "ended by SIGKILL; `softfinger record --recover"),
        (disk_full, "File too large; what was written until then can be read"),
    ],
    ids=["killed", "disk full"],
)
def test_a_recorder_that_ends_is_told_at_once_and_by_the_exit_status(
    start: Callable[..., Running],
    profile: Profile,
    addresses: tuple[str, str],
    tmp_path: Path,
    end: Callable[[int, Path], None],
    why: str,
) -> None:
    path = tmp_path / "run.mcap"
    daemon = start("--config", str(profile("")), "--record", str(path))
    recorder = recorder_of(daemon)
    until(lambda: path.stat().st_size > 10_000)
    with Hand(*addresses, timeout=60.0) as hand, hand.events(timeout=60.0) as events:
        hand.state()
        end(recorder, path)
        event = next(event for event in events if event.kind == "record")
        assert (event.level, why in event.text) == ("error", True), event.text
    assert daemon.end() == 1
    assert any("does not hold all of this run" in line for line in daemon.lines)
    assert Recording(path).total > 0
    assert recover(path)[0] > 0
