"""Test that one process, a pool, and a cluster that loses a worker give bit-identical results."""

import multiprocessing
from functools import partial

import numpy as np
import psutil
import pytest

from softfinger.tools import sweep
from softfinger.tools.cli import main
from softfinger.tools.sweep import Sweep, SweepError
from tests.conftest import until
from tests.harness import sweep_cases
from tests.harness.sweep_cases import CASES, EXPECTED, dies, dies_once, drawn, run_hanging_sweep


def test_results_do_not_depend_on_the_number_of_processes_or_a_crash(tmp_path):
    assert list(Sweep("drawn", drawn, CASES).run(1)) == EXPECTED
    assert list(Sweep("drawn", partial(dies_once, tmp_path), CASES).run(2)) == EXPECTED
    assert (tmp_path / "died").exists()


def test_the_workers_exit_if_the_sweep_is_killed(tmp_path):
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=run_hanging_sweep, args=(tmp_path,))
    process.start()
    try:
        until(lambda: len(list(tmp_path.iterdir())) == 2)
        workers = [psutil.Process(int(each.name)) for each in tmp_path.iterdir()]
    finally:
        process.kill()
        process.join()
    _, alive = psutil.wait_procs(workers, timeout=150.0)
    assert not alive


@pytest.mark.extended
def test_a_case_that_kills_each_worker_ends_the_sweep():
    with pytest.raises(SweepError, match="all worker processes exited during 5"):
        list(Sweep("drawn", dies, CASES).run(2))


@pytest.mark.extended
def test_a_cluster_gives_the_same_results_despite_a_killed_worker(tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, protocol="tcp://"
    ) as cluster:
        address = cluster.scheduler_address
        assert list(Sweep("drawn", drawn, CASES).run(scheduler=address)) == EXPECTED
        work = partial(dies_once, tmp_path)
        assert list(Sweep("drawn", work, CASES).run(scheduler=address)) == EXPECTED
    assert (tmp_path / "died").exists()


def test_a_missing_scheduler_is_reported(monkeypatch, capsys):
    pytest.importorskip("distributed")
    monkeypatch.setattr("softfinger.tools.sweep._CONNECT_TIMEOUT", 0.2)
    words = ["--size", "40", "--mass", "1", "--friction", "0.6", "--shape", "disc"]
    assert main(["envelope", *words, "--scheduler", "tcp://127.0.0.1:9"]) == 1
    assert "tcp://127.0.0.1:9: no Dask scheduler responds" in capsys.readouterr().err


def test_an_interrupted_sweep_continues_from_its_journal(tmp_path):
    journal = tmp_path / "map.toml.part"
    first = Sweep("drawn", drawn, CASES, journal).run(1)
    assert [next(first) for _ in range(4)] == EXPECTED[:4]
    first.close()
    with journal.open("a", encoding="utf-8") as file:
        file.write("[4, 0.")  # The last line is truncated.
    sweep_cases.drawn_cases.clear()
    assert list(Sweep("drawn", drawn, CASES, journal).run(1)) == EXPECTED
    assert sweep_cases.drawn_cases == CASES[4:]


def test_a_journal_of_another_sweep_or_of_other_code_is_refused(tmp_path, monkeypatch):
    journal, code = tmp_path / "map.toml.part", tmp_path / "code"
    code.mkdir()
    monkeypatch.setattr(sweep, "_SOURCES", (code,))
    next(Sweep("drawn", drawn, CASES, journal).run(1))
    assert list(Sweep("drawn", drawn, CASES, journal).run(1)) == EXPECTED
    refused = r"map\.toml\.part: belongs to another sweep or to another version"
    with pytest.raises(SweepError, match=refused):
        list(Sweep("drawn", drawn, CASES[1:], journal).run(1))
    (code / "new.py").write_text("x = 1\n", encoding="utf-8")
    with pytest.raises(SweepError, match=refused):
        list(Sweep("drawn", drawn, CASES, journal).run(1))


ENVELOPE = "envelope --shape rectangle --size 3 40 --mass 1 --friction 0.6 --keep"


@pytest.mark.extended
def test_a_tool_gives_the_same_results_in_one_and_two_processes(tmp_path):
    for processes in ("1", "2"):
        words = [*ENVELOPE.split(), str(tmp_path / processes), "--processes", processes]
        assert main(words) == 0
    one, two = ((tmp_path / each).read_text(encoding="utf-8") for each in ("1", "2"))
    assert one == two
    assert sorted(each.name for each in tmp_path.iterdir()) == ["1", "2"]


@pytest.mark.extended
def test_many_recordings_give_the_same_results_as_single_ones(tmp_path, capsys):
    files = [tmp_path / f"{name}.npy" for name in "abc"]
    rng = np.random.default_rng(1)
    for file in files[:2]:
        np.save(file, rng.integers(0, 900, (3, 44, 44), np.uint16))
    files[2].write_bytes(b"no frames")
    words = ["--config", "paper"]
    together = []
    for file in files[:2]:
        assert main(["analyse", str(file), *words]) == 0
        table = file.with_name(f"{file.name}.contacts.csv")
        together.append(table.read_text(encoding="utf-8"))
        table.unlink()
    assert main(["analyse", *map(str, files), *words, "--processes", "2"]) == 1
    assert f"analyse: {files[2]}: " in capsys.readouterr().err
    tables = sorted(tmp_path.glob("*.csv"))
    assert [each.read_text(encoding="utf-8") for each in tables] == together
    assert main(["analyse", *map(str, files), *words, "--csv", "x.csv"]) == 2
