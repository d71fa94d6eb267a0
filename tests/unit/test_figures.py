"""Test the values of figures against published and derived values; test the files and plots."""

import argparse
import csv
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.typing import NDArray
from scipy.integrate import dblquad

from softfinger.kinematics.contact.material import Material
from softfinger.tools import cli, style
from softfinger.tools.paper import experiment_pages, figures, validate
from softfinger.tools.paper.model_pages import double_integrals
from softfinger.tools.paper.validate import PublishedValue
from tests.harness.paper_tip import CHECKPOINTS, LINEAR

NUMBERS = ("fig3", "fig4a", "fig4b", "fig5a", "fig5b", "fig7", "fig10", "fig10_shear")


def read(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the columns of a CSV file by header; empty cells are NaN."""
    rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
    numbers = np.array([[float(cell or "nan") for cell in row] for row in rows[1:]])
    return dict(zip(rows[0], numbers.T, strict=True))


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Figure]]:
    """Return all figures, written by the command itself to a new folder."""
    path = tmp_path_factory.mktemp("figures") / "new" / "folder"
    kept, new = [], style.new_figure
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "new_figure", lambda *size: (kept.append(new(*size)), kept[-1])[1])
        assert cli.main(["figures", "--out", str(path)]) == 0
    return path, kept


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the values of the checked figures without Matplotlib; return their folder."""
    path = tmp_path_factory.mktemp("numbers")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib", None)
        assert cli.main(["figures", *NUMBERS, "--out", str(path)]) == 0
    return path


@pytest.mark.parametrize(("d", "theta", "force", "energy"), CHECKPOINTS)
def test_checkpoints_of_force_and_energy_versus_displacement(folder, d, theta, force, energy):
    for name, equation, unit, value in (("4b", 3, "N", force), ("5b", 10, "mJ", energy)):
        columns = read(folder / f"fig{name}.csv")
        (row,) = np.flatnonzero(columns["d [mm]"] == d)
        symbol = "F" if unit == "N" else "U"
        closed = columns[f"{symbol} at {theta} deg [{unit}]"][row]
        integral = columns[f"{symbol} by eq. {equation} at {theta} deg [{unit}]"][row]
        assert closed == pytest.approx(value, rel=1e-13)
        assert integral == pytest.approx(value, rel=1e-11)


def test_double_integrals_equal_the_one_dimensional_form() -> None:
    # The reference integrates eqs. 3 and 10 over y analytically, and over x by Gauss quadrature in
    # t. The tilt is close to the limit of 36.87°.
    a, d, theta, modulus = 0.02, 0.008, np.radians(34.0), 0.304e6
    points, weights = np.polynomial.legendre.leggauss(200)
    t = points * np.pi / 2
    s, c, h = np.sin(theta), np.cos(theta), a - d
    rho = np.sqrt(2 * a * d - d * d)
    x, b = h * s + rho * c * np.sin(t), rho * np.cos(t)
    dx = weights * np.pi / 2 * rho * c * np.cos(t)
    q, r2 = (h - x * s) / c, a * a - x * x
    angle = np.arcsin(b / np.sqrt(r2))
    force = modulus * np.sum((2 * b - 2 * q * angle) * dx)
    energy = 0.5 * modulus * np.sum(((r2 + 2 * q * q) * angle - 3 * q * b) * dx)
    got = double_integrals(a, modulus, d, theta)
    np.testing.assert_allclose(got, (force, energy), rtol=1e-9)


def by_quadrature(
    d: float, theta: float, shear: float = 0.0, law: Material = LINEAR
) -> tuple[float, float]:
    """Integrate F [N] and U [J] with SciPy; shear moves the ends of all springs along the face.

    Sheared springs have a constant modulus, and are equally stiff in all directions.
    """
    a, s, c = 0.020, np.sin(theta), np.cos(theta)
    h, rho = a - d, np.sqrt(d * (2.0 * a - d))

    def cell(share: float, angle: float, is_energy: bool) -> float:
        x, y = h * s + rho * c * share * np.cos(angle), rho * share * np.sin(angle)
        length = np.sqrt(a * a - x * x - y * y)
        strain = 1.0 - (h - x * s) / (c * length) + shear * s / length
        value = length * law.energy_density(strain) if is_energy else law.stress(strain)
        if is_energy:
            value += 0.5 * law.reference_modulus * (shear * c) ** 2 / length
        return float(value) * rho * rho * c * share

    found = (
        dblquad(cell, 0.0, np.pi, 0.0, 1.0, args=(each,), epsabs=0.0, epsrel=1e-7)[0]
        for each in (False, True)
    )
    return tuple(2.0 * each for each in found)


@pytest.mark.parametrize(("tilt", "name", "row"), [(0, "fig4b", 0), (30, "fig5b", 1)])
def test_exponents_of_both_material_laws(folder: Path, tilt: int, name: str, row: int) -> None:
    symbol, upright = "FU"[row], (2.0, 3.0)[row]
    columns, fitted = read(folder / f"{name}.csv"), read(folder / f"{name}_exponents.csv")
    assert columns[f"exponent at {tilt} deg [1]"][1:] == pytest.approx(upright, abs=1e-8)
    assert fitted["fitted exponent of d [1]"] == pytest.approx(upright, abs=1e-11)
    d, step = 0.006, 1e-3
    above, below = (
        by_quadrature(d * each, np.radians(tilt), law=Material.table_i())[row]
        for each in (1.0 + step, 1.0 - step)
    )
    local = np.log(above / below) / np.log((1.0 + step) / (1.0 - step))
    assert columns[f"exponent of Table I's law at {tilt} deg [1]"][60] == pytest.approx(
        local, abs=1e-5
    )
    assert local > upright + 0.04
    power = fitted["fitted exponent of d, Table I's law [1]"]
    assert (np.diff(power) > 0.0).all(), f"{symbol}: the exponent must increase with tilt"


def test_derivative_by_tilt(folder: Path) -> None:
    theta = np.radians(25.0)
    for name, head, row in (("fig4a", "dF/dtheta", 0), ("fig5a", "dU/dtheta", 1)):
        columns = read(folder / f"{name}_rate.csv")
        (rate,) = (each for key, each in columns.items() if key.startswith(head))
        d, step = columns["d [mm]"][-1] * 1e-3, 1e-3
        above, below = (by_quadrature(d, theta + each)[row] for each in (step, -step))
        scale = (1.0, 1e3)[row]
        assert rate[-1] == pytest.approx(scale * (above - below) / (2.0 * step), rel=1e-5)
        assert rate == pytest.approx(rate[0] * (columns["d [mm]"] / 2.0) ** (2 + row), rel=1e-6)


def test_with_shear_the_minimum_is_before_upright(folder: Path) -> None:
    minima = read(folder / "fig10_shear_minima.csv")
    felt = read(folder / "fig10_shear_plant_minima.csv")
    (row,) = np.flatnonzero((minima["d [mm]"] == 6.0) & (minima["share [%]"] == 5.0))
    start, d, near = np.radians(-11.5), 0.006, np.radians(0.5)
    for column, which in (("least F on the base [deg]", 0), ("least U [deg]", 1)):
        at = np.radians(minima[column][row])
        below, here, above = (
            by_quadrature(d, each, 0.05 * 0.014 * (each - start))[which]
            for each in (at - near, at, at + near)
        )
        assert here < min(below, above)
        assert below == pytest.approx(above, rel=2e-6), (
            "energy or force must be symmetric about the minimum"
        )
        assert minima[column][minima["share [%]"] == 0.0] == pytest.approx(0.0, abs=1e-6)
    assert felt["least U [deg]"] == pytest.approx(
        minima["least U [deg]"][minima["share [%]"] == 5.0], abs=0.01
    )
    # The plant's equilibrium includes the springs at the rim. These springs are sheared from their
    # first contact on.
    balance = felt["least N cos theta + T sin theta [deg]"]
    assert (balance < minima["least F on the base [deg]"][minima["share [%]"] == 5.0]).all()
    model, plant = read(folder / "fig10_shear.csv"), read(folder / "fig10_shear_plant.csv")
    assert plant["U [mJ]"] == pytest.approx(model["U, 5% [mJ]"], rel=1e-6)
    shear = 0.05 * 14.0 * np.radians(model["theta [deg]"] + 11.5)  # mm
    rim = np.pi * 0.304 * shear**2 * np.cos(np.radians(model["theta [deg]"]))
    assert plant["F on the base [N]"] == pytest.approx(
        model["F on the base, 5% [N]"] + rim, rel=1e-6
    )


def test_table_i_values(folder: Path) -> None:
    with (folder / "table_i.csv").open(encoding="utf-8") as file:
        entries, strains, papers, laws = zip(*list(csv.reader(file))[1:], strict=True)
    assert entries == ("Min", "20 %", "40 %", "60 %", "80 %", "100 %", "Max")
    printed = (0.135, 0.149, 0.182, 0.201, 0.207, 0.255, 0.304)
    assert [float(each) for each in papers] == pytest.approx(printed)
    assert [float(each) for each in laws[:-1]] == pytest.approx(printed[:-1], rel=1e-12)
    assert strains[-1] == laws[-1] == ""  # The strain exceeds the range of the law.
    curve = read(folder / "fig3.csv")
    slope = np.gradient(curve["stress [MPa]"], curve["strain [%]"] / 100.0)
    np.testing.assert_allclose(slope[1:-1], curve["modulus [MPa]"][1:-1], rtol=2e-3)
    assert curve["stress [MPa]"][0] == 0.0


def test_compression_with_the_sensor_model(folder: Path) -> None:
    columns = read(folder / "fig7.csv")
    d = columns["d [mm]"]
    assert (d[0], d[-1]) == (0.0, 8.0)
    for tilt in range(0, 31, 5):
        model = columns[f"F at {tilt} deg [N]"]
        sensed = columns[f"F through the sensor at {tilt} deg [N]"]
        law = columns[f"F of Table I's law at {tilt} deg [N]"]
        expected = np.pi * 0.304 * d**2 / np.cos(np.radians(tilt))
        np.testing.assert_allclose(model, expected, rtol=1e-12)
        # The sum over the cells is less accurate, but the paper states only three digits.
        np.testing.assert_allclose(sensed, model, rtol=1e-4)
        # Below full compression, the force is between the forces for the minimum and the maximum
        # modulus.
        assert np.all(law[1:] > 0.135 / 0.304 * model[1:])
        assert np.all(law[1:] < 0.255 / 0.304 * model[1:])


def test_path_of_rotation_and_rolling(folder: Path) -> None:
    rotation, rolling = read(folder / "fig10a.csv"), read(folder / "fig10b.csv")
    theta = rolling["theta [deg]"]
    assert (theta[0], theta[-1]) == (-11.5, 9.2)
    for d in (2, 4, 6, 8):
        ratio = rolling[f"F/F(0) at d = {d} mm [1]"]
        assert ratio[0] == pytest.approx(1.02048656931, rel=1e-11)
        assert ratio[-1] == pytest.approx(1.01303136698, rel=1e-11)
        law = rolling[f"F/F(0) of Table I's law at d = {d} mm [1]"]
        for curve in (ratio, law):
            assert theta[np.argmin(curve)] == 0.0
        # If the modulus increases with strain, the energy minimum is deeper.
        assert np.all(law[theta != 0.0] > ratio[theta != 0.0])
        # Springs that point towards the tip's centre produce no energy minimum.
        assert np.ptp(rolling[f"F of radial springs at d = {d} mm [N]"]) == 0.0
        # The rolling begins in the final state of the rotation.
        last = rotation[f"F, d up to {d} mm [N]"][-1]
        assert last == pytest.approx(rolling[f"F at d = {d} mm [N]"][0], rel=1e-12)
        assert rotation[f"d up to {d} mm [mm]"][0] == 0.0
        assert rotation[f"d up to {d} mm [mm]"][-1] == pytest.approx(d, rel=1e-12)


@pytest.mark.parametrize("of", [experiment_pages.printed_terms, experiment_pages.integrated_terms])
def test_checkpoints_of_the_appendix(of: Callable[..., experiment_pages.Terms]) -> None:
    a, d = 20.0, np.array(4.0)  # mm
    # Values of eqs. 16, 18 and 19.
    expected = (31.939525311496, 1.7671458676443, 0.098174770424681)
    np.testing.assert_allclose(of(a, d), expected, rtol=1e-13)
    assert experiment_pages.limits(a, d)[1] == pytest.approx(0.92729521800161, rel=1e-14)  # eq. 17
    assert sum(of(a, d).energies(a, 0.304, d)) == pytest.approx(20.374275556081, rel=1e-12)


@pytest.mark.extended
def test_every_plot_is_complete_and_lists_its_errata(drawn: tuple[Path, list[Figure]]) -> None:
    folder, kept = drawn
    with (folder / "errata.csv").open(encoding="utf-8") as file:
        errata = [(row["figure"], row["holds"]) for row in csv.DictReader(file)]
    for name, figure in zip(figures.NAMES, kept, strict=True):
        page, picture = figures.pages()[name], imread(folder / f"{name}.png")
        height, width = picture.shape[:2]
        assert (width / style.DPI, height / style.DPI) == pytest.approx(page.size, abs=0.01)
        # Every quarter of the picture contains dark pixels.
        dark = picture[..., :3].min(axis=-1) < 0.8
        for rows in (slice(None, height // 2), slice(height // 2, None)):
            for columns in (slice(None, width // 2), slice(width // 2, None)):
                assert dark[rows, columns].mean() > 0.01, name
        with style.settings():
            text = " ".join(figure.get_supxlabel().split())
            for erratum in page.errata:
                assert erratum.holds in text
                assert (name, erratum.holds) in errata
            # The label contains a unit.
            assert all("[" in axes.get_xlabel() for axes in figure.axes[-1:])
            # All text is within the page.
            box = figure.get_tightbbox()
            assert min(box.x0, box.y0) > -0.02
            assert max(box.x1 - page.size[0], box.y1 - page.size[1]) < 0.02


def test_only_the_named_figures_are_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["figures", "fig3", "--out", str(tmp_path)]) == 0
    written = {"fig3.csv", "table_i.csv", "errata.csv", "fig3.png"}
    assert {path.name for path in tmp_path.iterdir()} == written
    assert {Path(line).name for line in capsys.readouterr().out.splitlines()} == written


def test_without_matplotlib_only_the_values_are_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert cli.main(["figures", "fig4a", "--out", str(tmp_path)]) == 0
    written = {"fig4a.csv", "fig4a_rate.csv", "errata.csv"}
    assert {path.name for path in tmp_path.iterdir()} == written
    error = capsys.readouterr().err
    assert "only the CSV files were written" in error
    assert "pip install 'softfinger[plot]'" in error


@pytest.fixture(scope="module")
def rows() -> dict[str, PublishedValue]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validate, "_TRIALS", 1)  # Each trial takes 1 s.
        return {each.quantity: each for each in validate.comparisons()}


def test_every_row_has_source_and_verdict_and_every_disagreement_a_reason(rows):
    assert len(rows) >= 15
    for each in rows.values():
        assert each.source
        assert each.verdict in validate.FIGURES
        assert each.verdict == "agree" or each.why, each.quantity


def test_the_spring_model_is_stated_to_differ_from_rubber(rows: dict[str, PublishedValue]) -> None:
    springs = rows["ζ of F = C d^ζ, 1 to 7 mm: springs"]
    assert (springs.ours, springs.verdict) == ("2.00", "disagree")
    crossing = (4.0 / (3.0 * 0.75 * np.pi)) ** 2 * 20.0
    hertz = rows["depth at which springs and Hertz (ν ½) have the same force"]
    assert hertz.ours == f"{crossing:.1f} mm"
    assert hertz.verdict == "agree"


@pytest.mark.parametrize(
    ("ours", "verdict"), [(1.456, "agree"), (1.88, "agree"), (1.454, "disagree"), (2.0, "disagree")]
)
def test_a_value_agrees_within_the_published_digits(ours: float, verdict: str) -> None:
    assert validate.between("ζ", 1.46, 1.88, "a book", ours).verdict == verdict


def test_the_command_prints_all_rows_and_their_counts(rows, monkeypatch, capsys):
    monkeypatch.setattr(validate, "comparisons", lambda: iter(rows.values()))
    assert validate.run(argparse.Namespace()) == 0
    printed = capsys.readouterr().out
    assert printed.count("✗") == sum(each.verdict == "disagree" for each in rows.values())
    assert printed.splitlines()[-1].endswith("unknown")
