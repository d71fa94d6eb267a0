"""A subcommand whose optional package is missing says in one line what to install."""

from __future__ import annotations

import pytest

from tests.harness.daemon_process import python
from tests.process.test_record import written


@pytest.mark.parametrize(
    ("missing", "words", "extra"),
    [
        ("matplotlib", "plot run.mcap", "plot"),
        ("mcap", "record new.mcap", "record"),
        ("starlette", "view", "view"),
        ("foxglove", "view --foxglove", "foxglove"),
        ("pyarrow", "export run.mcap --format parquet", "parquet"),
    ],
)
def test_a_missing_extra_is_named(tmp_path, missing, words, extra):
    written(tmp_path / "run.mcap", 20)
    code = (
        f"import sys; sys.modules[{missing!r}] = None\n"
        "from softfinger.tools.cli import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    done = python("-c", code, *words.split(), cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1
    assert f"pip install 'softfinger[{extra}]'" in done.stderr
    assert not (tmp_path / "new.mcap").exists()
