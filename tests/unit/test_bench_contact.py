"""`bench contact`: its errors are true, its kernels and SciPy's ways compute what they should."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from softfinger.kinematics.contact.closed_form import closed_form
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.contact.quadrature import integrate
from softfinger.kinematics.contact.table import ContactTable
from softfinger.tools.benchmarks import contact, contact_scipy
from softfinger.tools.benchmarks.contact import CONSTANT, ERROR, LAW, MODES, TIP
from softfinger.tools.benchmarks.framework.report import Report, draw


@pytest.fixture(scope="module")
def tables() -> list[Report]:
    """The short form of the bench."""
    return contact.measure(brief=True, rounds=1, count=32)


def test_errors_are_those_of_each_representation(tables: list[Report]) -> None:
    errors = {row["name"]: row[ERROR] for table in tables[:-1] for row in table.rows}
    assert errors["closed form, constant E"] < 4e-15
    assert errors["table to 1e-09"] <= 1e-9
    assert errors["table to 1e-12: whole domain"] <= 1e-12
    assert errors["quadrature: 18 nodes a piece"] < 1e-13
    assert errors["dblquad, F and U"] < 1e-5
    assert 1e-12 < errors["RectBivariateSpline.ev: 64², degree 3, F and U"] < 1e-7


def test_every_way_of_calling_has_a_table_and_the_page_its_rows(tables: list[Report]) -> None:
    assert [table.title for table in tables[:-1]] == list(MODES.values())
    for title, names in contact.PAGE.items():
        (table,) = (table for table in tables if table.title == title)
        for name in names:
            assert any(row["name"].startswith(name) for row in table.rows), name
    for row in tables[-1].rows:
        assert row["aim ≤"] is not None
        if row["unit"] in ("1", "KiB"):
            assert 0.0 < row["median"] <= row["aim ≤"]


def test_the_picture_is_drawn(tables: list[Report], tmp_path: Path) -> None:
    from matplotlib.image import imread

    draw(tables[3:4], tmp_path / "bench.png")
    pixels = imread(tmp_path / "bench.png")
    assert (pixels[..., :3].min(axis=-1) < 0.8).mean() > 0.01


def test_points_cover_the_papers_range() -> None:
    d, theta = contact.points(512)
    assert np.all((d > 0.0) & (d <= 0.008))
    assert d.min() < 1e-5
    assert np.mean(d > 0.004) > 0.2
    assert np.abs(theta).max() == pytest.approx(math.radians(30.0), rel=0.02)


def test_the_reference_of_the_closed_form() -> None:
    d, theta = np.array([0.004, 0.008]), np.radians([15.0, 30.0])
    got = contact.reference(CONSTANT, d, theta).astype(float)
    np.testing.assert_allclose(got[0], (15.819751632242, 70.578560861082), rtol=1e-12)
    np.testing.assert_allclose(got[1], (21.837082726484e-3, 217.32560593153e-3), rtol=1e-12)
    assert got[3, 0] == pytest.approx(got[0, 0] * math.tan(theta[0]), rel=1e-12)


@pytest.mark.parametrize("mode", ["loop", "chain"])
def test_compiled_loops_compute_what_they_time(mode: str) -> None:
    d, theta = contact.points(16)
    table = ContactTable.build(TIP, LAW, 1e-9)
    out = np.zeros((16, 6))
    contact.LOOKUP_KERNELS[mode](2, table.data, d, theta, out)
    expected = [lookup(table.data, *point)[:6] for point in zip(d, theta, strict=True)]
    np.testing.assert_allclose(out, expected, rtol=1e-15)
    contact.CLOSED_KERNELS[mode](2, contact.MODULUS, d, theta, out)
    points = zip(d, theta, strict=True)
    expected = [closed_form(contact.MODULUS, *point)[:6] for point in points]
    np.testing.assert_allclose(out, expected, rtol=1e-15)


def test_scipy_methods_are_right_for_numbers_and_arrays() -> None:
    d, theta = np.array([0.003, 0.0065]), np.array([-0.3, 0.4])
    expected = np.array(integrate(TIP, LAW, d, theta))
    for method in contact_scipy.methods(TIP, LAW):
        one = [np.squeeze(value) for value in method.call(float(d[1]), float(theta[1]))]
        np.testing.assert_allclose(one, expected[: len(one), 1], rtol=2e-5)
        if method.batch:
            many = np.array(method.call(d, theta))
            np.testing.assert_allclose(many, expected[: len(many)], rtol=2e-5)


def test_without_scipy_its_rows_are_left_out(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "scipy", None)
    d, theta = contact.points(16)
    assert list(contact._scipy(d, theta, contact.reference(LAW, d, theta))) == []
    assert "pip install '.[dev]'" in capsys.readouterr().err
