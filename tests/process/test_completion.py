"""Bash completes softfinger's words by the script that `softfinger completion bash` prints."""

from __future__ import annotations

import subprocess

import pytest

pytest.importorskip("shtab")

_TAB = """
source "$1"; shift
COMP_WORDS=("$@") COMP_CWORD=$(($# - 1))
"$(complete -p softfinger | sed 's/.* -F \\([^ ]*\\) .*/\\1/')" softfinger "${@: -1}" "${@: -2:1}"
echo "${COMPREPLY[@]}"
"""


def test_a_tab_completes(inline, tmp_path):
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
