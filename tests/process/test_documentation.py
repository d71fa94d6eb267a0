"""Run all shell, Python and profile blocks of the README and the docs unchanged.

Each page runs from top to bottom in its own folder, with one simulated hand. `harness.documented`
provides the `softfinger` command, which only checks the arguments of endless commands. A block with
a title is saved in a file with the title as its name, for use by later blocks. A mark above a block
defines an exception:

    <!-- not run: why -->                  the block cannot be run, with the reason
    <!-- not run without gymnasium -->     the block needs a package that is not installed here
    <!-- exits 1: why -->                  the last command of the block must fail

A comment after `softfinger status` contains the mode, force and angle that the test waits for.
"""

import contextlib
import importlib.util
import os
import re
import select
import shlex
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import pytest

from softfinger.daemon.client.command_client import HandClient, send
from softfinger.daemon.profile.load import find, load
from softfinger.kinematics.compiled.own_folder import user_cache
from tests.conftest import own_addresses
from tests.harness.daemon_process import Running, plugin_path
from tests.harness.documented import Softfinger, parse

ROOT = Path(__file__).parents[2]
SOURCES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/*.md"))]
PAGES = [page for page in SOURCES if re.search(r"(?m)^ *(```\w|<!--)", page.read_text("utf-8"))]
USUAL = ("tcp://127.0.0.1:9872", "tcp://127.0.0.1:9873")
# Pages with commands that take almost a minute.
LONG = ("tutorial.md", "recordings.md", "test-your-controller.md")
MARK = re.compile(r"^ *<!-- (?:not run|exits)\b.*-->$", re.M)
REASON = re.compile(r"not run: \S.*|not run without \w+|exits 1: \S.*")
FENCE = re.compile(
    r'(?ms)^(?P<indent> *)```(?P<language>\w*)(?: title="(?P<title>[^"\n]+)")?[^\n]*\n'
    r"(?P<text>.*?)^(?P=indent)```$"
)
# `softfinger status` with the expected output in a comment.
STATUS = re.compile(r"(?m)^(softfinger status) +(# .*)$")
PRINTS = 20  # number of output lines after which an endless program is stopped
PATIENCE = 300.0  # time limit for one code block [s]


class Block(NamedTuple):
    """Code block on a page; the mark is the comment above the block; the title is a file name."""

    line: int
    language: str
    text: str
    mark: str
    title: str


def blocks(page: Path) -> list[Block]:
    """Return a page's code blocks; check that every mark is valid and directly above a block."""
    text = page.read_text(encoding="utf-8")
    marks = {found.end() + 1: found[0].strip()[5:-4] for found in MARK.finditer(text)}
    found = []
    for fence in FENCE.finditer(text):
        mark = marks.pop(fence.start(), "")
        line = text.count("\n", 0, fence.start()) + 1
        if mark:
            assert REASON.fullmatch(mark), f"{page.name}:{line}: {mark!r}"
            assert fence["language"], f"{page.name}:{line}: mark on a block that is not run"
            for other in re.findall(r"tests/\S+", mark):
                assert (ROOT / other).exists(), f"{page.name}:{line}: {other}"
        if fence["language"]:
            code = textwrap.dedent(fence["text"])
            found.append(Block(line, fence["language"], code, mark, fence["title"] or ""))
    assert not marks, f"{page.name}: marks without a block: {[*marks.values()]}"
    return found


class Shell:
    """Shell that runs all blocks of a page, keeps their variables and reports failed commands."""

    def __init__(self, folder: Path, softfinger: Softfinger) -> None:
        self._folder, self._softfinger = folder, softfinger
        self.log = folder / "shell.log"
        self._told, self._tell = os.pipe()
        # The pages share the compiled kernels of this user.
        own = {"HOME": str(folder), "XDG_CACHE_HOME": str(user_cache().parent)}
        with self.log.open("w") as log:
            self._process = subprocess.Popen(
                ["bash", "--norc"], stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=folder,
                env=os.environ | own, pass_fds=[self._tell], text=True,
            )  # fmt: skip

    def run(self, text: str) -> str:
        """Run commands; return the exit status and text of each failed command."""
        (self._folder / "block.sh").write_text(text)
        print(
            "failed=; trap 'failed+=\"$? $BASH_COMMAND; \"' ERR; "
            f'. ./block.sh </dev/null {self._tell}>&-; echo "$failed" >&{self._tell}',
            file=self._process.stdin,
            flush=True,
        )
        while True:
            ready = select.select([self._told, self._softfinger.socket], [], [], PATIENCE)[0]
            assert ready, f"timeout: {text}"
            if self._told in ready:
                return os.read(self._told, 4096).decode().strip()
            self._softfinger.serve()

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()
        os.close(self._told)
        os.close(self._tell)
        self._softfinger.end()


class Shared(NamedTuple):
    """Resources shared by all pages."""

    addresses: tuple[str, str]
    softfinger: Softfinger


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    """Run a simulated hand; yield its addresses and the `softfinger` command."""
    place = tmp_path_factory.mktemp("hand")
    place.chmod(0o700)
    stream, commands = addresses = own_addresses()
    (place / "bin").mkdir()
    softfinger = Softfinger(place / "bin")
    with pytest.MonkeyPatch.context() as patch, softfinger.socket:
        patch.setenv("XDG_RUNTIME_DIR", str(place))
        patch.setenv("SOFTFINGER_ADDRESS", ",".join(addresses))
        patch.setenv("PATH", f"{place / 'bin'}:{os.environ['PATH']}")
        patch.setenv("PYTHONPATH", plugin_path(place / "site"))
        (place / "bin" / "pytest").write_text(
            f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m pytest "$@"\n'
        )
        (place / "bin" / "pytest").chmod(0o755)
        words = (f"stream.address={stream}", f"commands.address={commands}", "loop.rate=100")
        daemon = Running(*[word for each in words for word in ("--set", each)])
        yield Shared(addresses, softfinger)
        assert daemon.end() == 0


def run_python(text: str, addresses: tuple[str, str]) -> None:
    """Run the block in this process; stop an endless program after PRINTS lines."""
    for usual, own in zip(USUAL, addresses, strict=True):
        text = text.replace(usual, own)

    class Enough(Exception):
        pass

    lines = iter(range(PRINTS))

    def show(*_: object) -> None:
        if next(lines, None) is None:
            raise Enough

    with (
        contextlib.suppress(Enough),
        mock.patch.dict(HandClient.__init__.__kwdefaults__, timeout=PATIENCE),
    ):
        exec(compile(text, "block", "exec"), {"__name__": "__main__", "print": show})


@pytest.mark.waits
@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=[pytest.mark.extended] * (page.name in LONG)) for page in PAGES],
    ids=lambda page: page.name,
)
def test_code_blocks_run(page, shared, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my.toml").write_text(find(Path("hil")).read_text(encoding="utf-8"))
    shell = Shell(tmp_path, shared.softfinger)
    try:
        for block in blocks(page):
            at = f"{page.name}:{block.line}"
            missing = re.fullmatch(r"not run without (\w+)", block.mark)
            if missing:
                assert missing[1] in block.text, (
                    f"{at}: {block.mark}: the block does not use this module"
                )
            if block.mark.startswith("not run") and not (
                missing and importlib.util.find_spec(missing[1])
            ):
                parse_only(block, at)
            elif block.title:
                Path(block.title).parent.mkdir(parents=True, exist_ok=True)
                Path(block.title).write_text(block.text)
            elif block.language in ("sh", "bash"):
                failed = shell.run(STATUS.sub(lambda line: f"{line[1]} '{line[2]}'", block.text))
                status = 1 if block.mark else 0
                assert int(failed.split()[0] if failed else 0) == status, (
                    f"{at}: {failed}\n{shell.log.read_text()}"
                )
            elif block.language == "python":
                run_python(block.text, shared.addresses)
            else:
                assert block.language == "toml", f"{at}: {block.language}: unsupported language"
                Path("block.toml").write_text(block.text)
                load(Path("block.toml"))
    finally:
        shell.close()
        send(shared.addresses[1], {"command": "stop"}, timeout=120.0)


def parse_only(block: Block, at: str) -> None:
    """Check the commands and the syntax of a block that is not run."""
    if block.language == "python":
        compile(block.text, at, "exec")
    for line in block.text.replace("\\\n", "").splitlines():
        if line.startswith("softfinger "):
            words = shlex.split(line.partition(" | ")[0], comments=True)[1:]
            parse([word for word in words if not re.fullmatch(r"\$\w+", word)])
