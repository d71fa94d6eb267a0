"""The contact bench: it times what it says, its errors are true, its reports are whole."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softfinger.kinematics.contact.closed_form import closed_form
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools import cli
from softfinger.tools.benchmarks import contact, contact_kernels, contact_scipy, interleaved
from softfinger.tools.benchmarks.contact_report import ContactRow
from softfinger.tools.benchmarks.interleaved import Subject, interleave
from softfinger.tools.benchmarks.report import Row, row, table

LAW = Material.table_i()


@pytest.fixture(scope="module")
def rows() -> list[ContactRow | Row]:
    """The short form of the bench."""
    return contact.measure(contact.Effort(rounds=2, points=64, quick=True))


def own(rows: Iterable[ContactRow | Row]) -> list[ContactRow]:
    return [each for each in rows if isinstance(each, ContactRow)]


def plain(rows: Iterable[ContactRow | Row]) -> list[Row]:
    return [each for each in rows if isinstance(each, Row)]


def test_every_kind_is_measured(rows: list[ContactRow | Row]) -> None:
    found = {(each.name.split(",")[0].split(" to ")[0], each.outputs) for each in own(rows)}
    for name in ("closed form", "table", "RectBivariateSpline.ev"):
        assert {(name, 2), (name, 6)} <= found
    for name in ("dblquad", "RegularGridInterpolator", "map_coordinates"):
        assert (name, 2) in found
    assert ("direct quadrature", 6) in found
    for each in own(rows):
        assert each.timings
        assert each.max_error > 0.0
        for timing in each.timings.values():
            assert 0.0 < timing.min_ns <= timing.median_ns
            assert math.isfinite(timing.over_closed)
    compiled = [each for each in own(rows) if each.name.startswith(("table,", "closed form"))]
    assert all({"loop", "chain"} <= set(each.timings) for each in compiled)


def test_ratios_are_to_the_closed_form_of_the_same_run(rows: list[ContactRow | Row]) -> None:
    for each in own(rows):
        if each.name == "closed form":
            assert {timing.over_closed for timing in each.timings.values()} == {1.0}
            assert set(each.timings) == {"loop", "chain", "kernel", "python", "batch"}


def test_errors(rows: list[ContactRow | Row]) -> None:
    for each in own(rows):
        if each.name.startswith("table"):
            assert each.certificate is not None
            assert each.max_error <= max(each.certificate, 4e-15)
            assert each.nbytes is not None
            assert each.nbytes <= 256 * 1024
    errors = {(each.name, each.material, each.outputs): each.max_error for each in own(rows)}
    assert errors["closed form", "constant", 6] < 4e-15
    # A law that is not linear is no closed form: the bench would show if its errors were not real.
    assert errors["closed form at its first modulus", "table_i", 2] > 0.05
    assert errors["direct quadrature, 18 nodes a piece", "table_i", 6] < 1e-13
    assert errors["dblquad", "table_i", 2] < 1e-5
    assert errors["RectBivariateSpline.ev, ratio 64², degree 3", "table_i", 2] < 1e-7
    assert errors["RegularGridInterpolator, ratio 64², linear", "table_i", 2] < 1e-4


def test_aims(rows: list[ContactRow | Row]) -> None:
    aims = {each.name: each for each in plain(rows) if each.aim is not None}
    assert sorted(each.aim for each in aims.values() if each.unit == "×" and each.aim) == [
        1e-5, 0.01, 1.2, 1.2, 2.0, 2.0, 3.0, 3.0
    ]  # fmt: skip
    for tolerance in ("1e-09", "1e-12"):
        certified = aims[f"Table I, {tolerance}: certified error"]
        assert certified.aim == float(tolerance)
        assert 0.0 < certified.median <= certified.aim
        assert 0.0 < aims[f"Table I, {tolerance}: memory"].median <= 256.0
        assert aims[f"Table I, {tolerance}: build"].median > 0.0
    error = aims["constant E: largest error of the table"]
    assert 0.0 < error.median <= 4e-15


def test_points_cover_the_papers_range() -> None:
    d, theta = contact.points(512)
    assert np.all((d > 0.0) & (d <= 0.008))
    assert d.min() < 1e-5
    assert np.mean(d > 0.004) > 0.2
    assert np.abs(theta).max() == pytest.approx(math.radians(30.0), rel=0.02)
    np.testing.assert_array_equal(contact.points(512), (d, theta))


def test_references() -> None:
    d, theta = np.array([0.004, 0.008]), np.radians([15.0, 30.0])
    published = (
        (15.819751632242, 70.578560861082),
        (21.837082726484e-3, 217.32560593153e-3),
        (2 * 15.819751632242 / 0.004, 2 * 70.578560861082 / 0.008),
        15.819751632242 * math.tan(theta[0]),
        (16.377812044863, 81.497102224324),
        (11.702457363226e-3, 250.94599417274e-3),
    )
    got = contact.reference(Material.constant(0.304e6), d, theta).astype(float)
    for i in (0, 1, 2, 4, 5):
        np.testing.assert_allclose(got[i], published[i], rtol=1e-12)
    assert got[3, 0] == pytest.approx(published[3], rel=1e-12)
    np.testing.assert_allclose(
        contact.reference(LAW, d, theta), integrate(contact.TIP, LAW, d, theta), rtol=1e-13
    )


@pytest.mark.parametrize("way", ["loop", "chain"])
@pytest.mark.parametrize(("word", "count"), [("two", 2), ("six", 6)])
def test_compiled_loops_give_the_kernels_results(way: str, word: str, count: int) -> None:
    d, theta = contact.points(8)
    table = ContactTable.build(contact.TIP, LAW)
    for name, kernel, first in (
        ("closed", closed_form, LAW.reference_modulus),
        ("lookup", lookup, table.data),
    ):
        out = np.full((8, 6), np.nan)
        getattr(contact_kernels, f"{name}_{way}_{word}")(1, first, d, theta, out)
        expected = [kernel(first, d[i], theta[i])[:count] for i in range(8)]
        np.testing.assert_allclose(out[:, :count], expected, rtol=1e-15)
        assert np.all(np.isnan(out[:, count:]))


@pytest.fixture(scope="module")
def methods() -> list[contact_scipy.Method]:
    return list(contact_scipy.methods(contact.TIP, LAW, quick=False))


def test_scipy_methods_are_right_for_numbers_and_arrays(
    methods: list[contact_scipy.Method],
) -> None:
    d, theta = np.array([0.003, 0.0065]), np.array([-0.3, 0.4])
    expected = np.array(integrate(contact.TIP, LAW, d, theta))
    assert len({(each.name, each.outputs) for each in methods}) == len(methods) == 16
    for method in methods:
        rtol = 1e-7 if "Bivariate" in method.name or method.name == "dblquad" else 2e-5
        if "raw" in method.name:
            rtol = 1e-3
        for i in range(2):
            one = np.array([np.squeeze(v) for v in method.call(float(d[i]), float(theta[i]))])
            np.testing.assert_allclose(one, expected[: method.outputs, i], rtol=rtol)
        if method.batch:
            many = np.array(method.call(d, theta))
            np.testing.assert_allclose(many, expected[: method.outputs], rtol=rtol)
            assert method.nbytes
            assert method.build_s


def test_turns_and_times(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0]
    order: list[str] = []
    monkeypatch.setattr(interleaved.time, "perf_counter_ns", lambda: clock[0])

    def subject(name: str, cost: int, calls: int) -> Subject:
        def run(repeat: int) -> None:
            order.append(name)
            clock[0] += cost * calls * repeat

        return Subject(run, calls)

    times = interleave({"a": subject("a", 100, 5), "b": subject("b", 7_000_000, 1)}, rounds=3)
    assert order == ["a", "a", "b", "b"] + ["a", "b"] * 3
    np.testing.assert_array_equal(times["a"], [100.0] * 3)
    np.testing.assert_array_equal(times["b"], [7e6] * 3)


def test_table_of_the_rows(rows: list[ContactRow | Row]) -> None:
    lines = contact.table(own(rows)).splitlines()
    assert lines[0] == "contact model, material: constant"
    for each in own(rows):
        (line,) = [
            line
            for line in lines[lines.index(f"contact model, material: {each.material}") :]
            if line.startswith(f"{each.name:48} {each.outputs:3} ")
        ][:1]
        assert line.count("–") == 5 - len(each.timings)
    assert max(map(len, lines)) <= 150


def test_small_numbers_keep_their_digits_in_the_common_table() -> None:
    text = table([row("a", "×", [7.8e-6]), row("b", "s", [0.25]), row("c", "1", [0.0])])
    numbers = [line[58:].split()[0] for line in text.split("\n")[1:]]
    assert numbers == ["7.8e-06", "0.250", "0.000"]


def test_command_line_writes_json_and_picture(
    rows: list[ContactRow | Row],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from matplotlib.image import imread

    monkeypatch.setattr(contact, "measure", lambda: rows)
    out, picture = tmp_path / "bench.json", tmp_path / "bench.png"
    assert cli.main(["bench", "contact", "--json", str(out), "--plot", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "RectBivariateSpline.ev" in printed
    assert "aim" in printed
    report = json.loads(out.read_text(encoding="utf-8"))
    assert len(report["rows"]) == len(rows)
    assert {each["measurement"] for each in report["rows"]} == {"contact"}
    first = report["rows"][0]
    assert first["name"] == "closed form"
    assert first["timings"]["loop"]["over_closed"] == 1.0
    pixels = imread(picture)
    assert pixels.shape[:2] == (1480, 1600)
    assert (pixels[..., :3].min(axis=-1) < 0.8).mean() > 0.01


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert cli.main(["bench", *words]) == 2
    printed: Any = capsys.readouterr()
    assert "measuring" not in printed.err
    return str(printed.err)


def test_refusals_come_before_the_measurements(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "found 'contct', expected one of contact" in refused(["contct"], capsys)
    assert "none of the named" in refused(["tick", "--plot", "x.png"], capsys)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "pip install '.[plot]'" in refused(["contact", "--plot", "x.png"], capsys)


def test_without_scipy_its_rows_are_left_out(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "scipy", None)
    d, theta = contact.points(16)
    assert list(contact._scipy_cases(LAW, d, theta, quick=True)) == []
    assert "pip install '.[dev]'" in capsys.readouterr().err
