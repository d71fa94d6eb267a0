"""Test subcommands with missing packages, Ctrl-C during imports, and shell completion."""

import signal
import subprocess

import pytest

from tests.harness.daemon_process import python
from tests.process.test_record import written


@pytest.mark.parametrize(
    ("missing", "words", "told"),
    [
        ("matplotlib", "plot run.mcap", "pip install 'softfinger[plot]'"),
        ("mcap", "record new.mcap", "pip install 'softfinger[record]'"),
        ("numba", "replay --recompute run.mcap", "does not contain hand/settings"),
        *(
            pytest.param(*each, marks=pytest.mark.extended)
            for each in (
                ("websockets", "view", "pip install 'softfinger[view]'"),
                (
                    "pyarrow",
                    "export run.mcap --format parquet",
                    "pip install 'softfinger[parquet]'",
                ),
                ("numba", "analyse run.mcap", "does not contain hand/settings"),
                ("numba", "plot none.mcap", "none.mcap: No such file"),
            )
        ),
    ],
)
def test_a_required_package_that_is_missing_is_named(tmp_path, missing, words, told):
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


# Program that sends itself Ctrl-C during the import of a module.
_AT = """
import builtins, os, signal, sys
from softfinger.tools import cli
really = builtins.__import__
def patched(name, *rest, **more):
    if name == sys.argv[1]:
        os.kill(os.getpid(), signal.SIGINT)
    return really(name, *rest, **more)
builtins.__import__ = patched
sys.exit(cli.main(sys.argv[2:]))
"""


@pytest.mark.parametrize(
    ("module", "words", "status"),
    [
        ("argparse", ["limits"], -signal.SIGINT),
        ("pydantic", ["run"], -signal.SIGINT),
        ("softfinger.tools.terminal.stream_state", ["monitor"], -signal.SIGINT),
        # While a subcommand is running, Ctrl-C raises KeyboardInterrupt.
        ("softfinger.daemon.safety.limits", ["limits"], 130),
    ],
)
def test_ctrl_c_during_import_ends_a_subcommand_like_any_process(module, words, status):
    done = python("-c", _AT, module, *words)
    assert (done.returncode, done.stderr) == (status, "")


_TAB = """
source "$1"; shift
COMP_WORDS=("$@") COMP_CWORD=$(($# - 1))
"$(complete -p softfinger | sed 's/.* -F \\([^ ]*\\) .*/\\1/')" softfinger "${@: -1}" "${@: -2:1}"
echo "${COMPREPLY[@]}"
"""


def test_tab_completion(inline, tmp_path):
    """Test the script that `softfinger completion bash` prints."""
    pytest.importorskip("shtab")
    script = tmp_path / "script"
    script.write_text(inline("completion", "bash").stdout, encoding="utf-8")
    (tmp_path / "my.toml").touch()
    for words, completed in (
        (("re",), "record replay"),
        (("send", "ro"), "rotate"),
        (("run", "--log-"), "--log-file"),
        (("run", "--log", ""), "plain json"),
        (("calibrate", "cu"), "curve"),
        (("run", "--config", "my"), "my.toml"),
    ):
        call = ["bash", "--norc", "-c", _TAB, "bash", script, "softfinger", *words]
        done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.stdout.strip() == completed
