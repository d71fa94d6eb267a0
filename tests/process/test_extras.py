"""A subcommand without a package: what to install, in one line, or that it is not needed yet."""

from __future__ import annotations

import pytest

from tests.harness.daemon_process import python
from tests.process.test_record import written


@pytest.mark.parametrize(
    ("missing", "words", "told"),
    [
        ("matplotlib", "plot run.mcap", "pip install 'softfinger[plot]'"),
        ("mcap", "record new.mcap", "pip install 'softfinger[record]'"),
        ("starlette", "view", "pip install 'softfinger[view]'"),
        ("foxglove", "view --foxglove", "pip install 'softfinger[foxglove]'"),
        ("numba", "replay --recompute run.mcap", "no hand/settings in it"),
        ("numba", "analyse run.mcap", "no hand/settings in it"),
        ("numba", "plot none.mcap", "none.mcap: No such file"),
    ],
)
def test_a_missing_package_is_named_if_it_is_needed(tmp_path, missing, words, told):
    written(tmp_path / "run.mcap", 20)
    code = (
        f"import sys; sys.modules[{missing!r}] = None\n"
        "from softfinger.tools.cli import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    done = python("-c", code, *words.split(), cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1
    assert told in done.stderr
    assert not (tmp_path / "new.mcap").exists()
