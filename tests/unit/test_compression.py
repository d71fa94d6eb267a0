"""Test that `calibrate law --compression` finds the laws of simulated compression tests."""

import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import CubicSpline

from softfinger.daemon.perception.calibration_file import load_calibration
from softfinger.kinematics.calibration import compression_fit
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.compression_fit import (
    CompressionFit,
    Run,
    compare_laws,
    fit_compression,
    loading,
)
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.tools.cli import main

ROOT = Path(__file__).parents[2]
E, A = 0.25e6, 0.020
LATE, LOAD = 1.35e-3, 0.21  # zero offsets of the test machine in d [m] and F [N]
UNIT = Material.constant(1.0)
Force = Callable[[float, float], float]  # force [N] as a function of d [m] and θ [rad]
WORDS = ["--config", "hil", "--no-plot"]


def springs(d: float, theta: float = 0.0) -> float:
    """Return the normal force on a sticking platen, which is the paper's F divided by cos θ."""
    return math.pi * E * d**2 / math.cos(theta) ** 2


def pressed(force, rng, noise, theta=0.0, deep=6e-3, above=0.6e-3, toe=0.0):
    """Return d and F during loading and unloading, with zero offsets, hysteresis and noise.

    Up to the depth ``toe``, the tip carries no load.
    """
    up = np.linspace(-above, deep, 140)
    depth = np.concatenate([up, up[::-2]])
    loss = np.where(np.arange(len(depth)) < len(up), 1.0, 0.9)
    made = [force(each, theta) if each > toe else 0.0 for each in depth.tolist()]
    pressed = np.array(made) * loss + LOAD + noise * rng.standard_normal(len(depth))
    return depth + LATE, pressed


def run_of(force, rng, noise, theta=0.0, **more) -> Run:
    return loading(*pressed(force, rng, noise, theta, **more), theta)


@pytest.mark.parametrize("above", [0.6e-3, 0.0], ids=["from above", "from the contact"])
def test_modulus_and_zeros_agree_with_their_standard_deviations(above):
    scores = []
    for seed in range(40):
        run = run_of(springs, np.random.default_rng(seed), 0.1, above=above)
        fit = fit_compression([run], Fingertip(A), UNIT)
        d, zero, d_std, zero_std = fit.zeros[0]
        scores.append([(fit.modulus / E - 1.0) / fit.std, (d - LATE) / d_std,
                       (zero - LOAD) / zero_std])  # fmt: skip
        assert fit.chi2 == pytest.approx(1.0, abs=0.3)
    assert fit.std < 0.006
    # The mean of the squares of 40 standard normal values is 1.0 ± 0.22.
    assert np.mean(np.square(scores), axis=0) == pytest.approx(1.0, abs=0.7)


def test_correlated_noise_increases_the_standard_deviation():
    def found(kernel) -> float:
        rng, errors = np.random.default_rng(0), []
        for _ in range(40):
            d, force = pressed(springs, rng, 0.0)
            force += 0.1 * np.convolve(rng.standard_normal(len(d) + 7), kernel, "valid")[: len(d)]
            fit = fit_compression([loading(d, force)], Fingertip(A), UNIT)
            errors.append((fit.modulus / E - 1.0) / fit.std)
        return float(np.mean(np.square(errors)))

    smooth = found(np.full(8, 8**-0.5))
    assert 0.3 < smooth < 3.0  # Without the correlation, it would be about 8.


def test_the_toe_region_is_excluded(monkeypatch):
    def found() -> CompressionFit:
        rng = np.random.default_rng(1)
        runs = [run_of(springs, rng, 0.02, math.radians(t), toe=4e-4) for t in (0.0, 15.0)]
        return compare_laws(runs, A, 0.49, Material.table_i())[0][0]

    best = found()
    assert (best.tip.physics, len(best.factors)) == ("springs", 1)
    assert best.law.is_linear
    assert best.modulus == pytest.approx(E, rel=0.01)
    monkeypatch.setattr(compression_fit, "TOE", 0.0)
    assert found().chi2 > 1.3 * best.chi2


def test_a_strain_dependent_modulus_is_found_from_the_force():
    table = np.polynomial.Polynomial([float(c) for c in (0, *Material.table_i().coefficients)])

    def force(d: float, _: float) -> float:
        h = A - d
        return 2.0 * math.pi * h**2 * quad(lambda e: table(e) / (1.0 - e) ** 3, 0.0, d / A)[0]

    run = run_of(force, np.random.default_rng(2), 0.02, deep=10e-3)
    constant, law = (fit_compression([run], Fingertip(A), each) for each in (UNIT, None))
    known, _ = compare_laws([run], A, 0.49, Material.table_i())
    assert known[0].law.name == "table_i"
    assert known[0].modulus == pytest.approx(0.135e6, rel=3 * known[0].std)
    strain = np.linspace(0.15, 0.5, 8)
    assert law.stress(strain) == pytest.approx(table(strain), rel=4 * law.std)
    assert law.std < 0.02
    assert law.score < constant.score
    assert constant.chi2 > 2.0


def rubber(base: str) -> Force:
    """Return the force on solid rubber, interpolated between finite element results."""
    with np.load(ROOT / "tests" / "golden" / "solid_frames.npz") as file:
        used = (file["base"] == base) & (file["theta"] == 0.0)
        d, push = file["d"][used], file["push"][used]
    # In the limit d → 0, the contact becomes a Hertz contact.
    curve = CubicSpline([0.0, *np.sqrt(d)], [4.0 / 3.0 / (1.0 - 0.49**2), *(push / d**1.5)])
    return lambda d, _: E * A**2 * float(curve(math.sqrt(d / A))) * (d / A) ** 1.5


@pytest.mark.parametrize("base", ["bonded", "lying"])
def test_solid_rubber_computed_with_independent_finite_elements(base):
    run = run_of(rubber(base), np.random.default_rng(3), 0.05)
    fits, _ = compare_laws([run], A, 0.49, Material.table_i())
    best = next(fit for fit in fits if fit.tip.physics == "solid")
    assert best.tip.base == base
    assert best.modulus == pytest.approx(E, rel=0.02)


@pytest.mark.parametrize(
    ("force", "physics", "other"),
    [
        (rubber("bonded"), "springs", "solid, bonded, frictionless, ν 0.490"),
        (springs, "solid", "springs, constant E"),
        (springs, "springs", ""),
    ],
    ids=["solid as springs", "springs as solid", "springs as springs"],
)
def test_another_model_that_fits_much_better_is_named(tmp_path, capsys, force, physics, other):
    d, load = pressed(force, np.random.default_rng(13), 0.02)
    rows = [f"{1e3 * x:.4f},{f:.4f}" for x, f in zip(d.tolist(), load.tolist(), strict=True)]
    file, out = written(tmp_path / "a.csv", "d [mm],F [N]", rows), tmp_path / "left.json"
    words = [*WORDS, "--set", f"tip.physics={physics}", "--set", "material.law=constant"]
    words += ["--set", "safety.d_max=0.008", "--compression", str(file)]
    assert main(["calibrate", "law", str(out), *words]) == 0
    found = re.findall(r"(?m)^  (.*) fits better, ", capsys.readouterr().out)
    assert found == [other] * bool(other)
    assert load_calibration(out).wants["physics"] == physics


def test_the_last_full_cycle_is_used():
    rng = np.random.default_rng(4)
    parts = [pressed(lambda d, t: 1.3 * springs(d, t), rng, 0.05), pressed(springs, rng, 0.05),
             pressed(springs, rng, 0.05, deep=2e-3)]  # fmt: skip
    d, force = (np.concatenate(each) for each in zip(*parts, strict=True))
    run = loading(d, force)
    assert run.cycles == 2
    assert run.d.max() == pytest.approx(6e-3 + LATE)
    assert fit_compression([run], Fingertip(A), UNIT).modulus == pytest.approx(E, rel=0.01)


def test_a_hold_at_the_full_depth_is_excluded():
    d, force = pressed(springs, np.random.default_rng(5), 0.02)
    rng = np.random.default_rng(12)
    hold = d.max() + 1e-5 * rng.standard_normal(200)  # Add encoder noise.
    relaxed = np.linspace(force.max(), 0.7 * force.max(), 200)
    peak = int(np.argmax(d)) + 1
    run = loading(np.insert(d, peak, hold), np.insert(force, peak, relaxed))
    assert len(run.d) == peak
    assert fit_compression([run], Fingertip(A), UNIT).modulus == pytest.approx(E, rel=0.005)


def shuffled(d, force):
    order = np.random.default_rng(6).permutation(len(d))
    return d[order], force[order]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (shuffled, "times in 210 rows, expected rows in measurement order"),
        (lambda d, force: (d[140:], force[140:]), "d only decreases"),
        (lambda d, force: (0 * d, force), "the same displacement"),
        (lambda d, force: (d, 0.003 * force + 0.2), "tip was loaded"),
        (lambda d, force: (d, -force), "expected positive d and F"),
        (lambda d, force: (d[:140:20], force[:140:20]), "expected at least 6"),
    ],
)
def test_unsuitable_data_are_rejected_with_the_reason(change, told):
    d, force = change(*pressed(springs, np.random.default_rng(7), 0.05))
    rng = np.random.default_rng(8)
    with pytest.raises(CalibrationError, match=told):
        loading(d, force + 0.05 * rng.standard_normal(len(d)))


def test_a_run_that_starts_in_contact_is_rejected():
    d, force = pressed(springs, np.random.default_rng(7), 0.05)
    run = loading(d[110:140], force[110:140])
    with pytest.raises(CalibrationError, match="must include the onset of contact"):
        fit_compression([run], Fingertip(A), UNIT)


def test_a_fit_in_which_the_tip_hardly_touches_is_rejected():
    d = np.linspace(0.0, 7e-3, 12)
    run = loading(d, math.pi * E * d**1.5)
    with pytest.raises(CalibrationError, match="must include the onset of contact"):
        fit_compression([run], Fingertip(A, "solid"), UNIT)


def written(path: Path, header: str, rows: list[str]) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def machine(header: str, form: str, **more) -> list[str]:
    d, force = pressed(springs, np.random.default_rng(9), 0.05, **more)
    return [form.format(1e3 * x, f) for x, f in zip(d.tolist(), force.tolist(), strict=True)]


@pytest.mark.parametrize(
    ("header", "form"),
    [
        ("# machine 3\nd [mm],F [N]", "{0:.4f},{1:.4f}"),
        ("Time;Compressive displacement;Standard force\ns;mm;N", "0;{0:.4f};{1:.4f}"),
        ("displacement/mm\tforce/N", "{0:.4f}\t{1:.4f}"),
        ("d_mm,F_N", "{0:.4f},{1:.4f}"),
        ("Extension [mm],Load [N],Strain [%]", "{0:.4f},{1:.4f},5"),
        ("d [mm],F [N],note", '{0:.4f},{1:.4f},"first'),
    ],
)
def test_file_formats_of_testing_machines_are_read(tmp_path, capsys, header, form):
    rows = machine(header, form)
    if ";" in header:  # The file has decimal commas.
        rows = [row.replace(".", ",") for row in rows]
    file = written(tmp_path / "a.csv", header, rows)
    out = tmp_path / "left.json"
    assert main(["calibrate", "law", str(out), *WORDS, "--compression", str(file)]) == 0
    step = load_calibration(out).modulus
    assert step.modulus == pytest.approx(E, rel=0.01)
    assert step.offset == pytest.approx(LATE, abs=5e-5)
    told = capsys.readouterr().out
    assert "70 rows of the unloading" in told
    assert f"material.modulus = {round(step.modulus, -1)}" in told


@pytest.mark.parametrize(
    ("header", "row", "told"),
    [
        ("d [mm],F [lbs]", "1,2", "'F [lbs]': found the unit 'lbs', expected one of N, mN, kN"),
        ("d,F", "1,2", "'d': found no unit, expected one of mm"),
        ("x [mm],y [N]", "1,2", "found the columns 'x [mm]', 'y [N]', expected `d [mm],F [N]"),
        (
            "d [mm],F [N],force [N]",
            "1,2,3",
            "found the columns 'F [N]' and 'force [N]', expected one column with force",
        ),
        ("d [mm],F [N]", "1,2\n1.1,many", "line 3: force: found 'many', expected a number"),
        ("d [mm],F [N]", "1,2\n1.1", "line 3: force: found '', expected a number"),
        ('"d\n[mm]",F [N]', "1,2", "'d': found the unit 'mm]\"', expected one of mm"),
        ("strain [kPa],stress [kPa]", "1,2", "'strain [kPa]': found the unit 'kPa'"),
        ("d [mm],F [N]", f'1,"{200_000 * "2"}', "field larger than field limit (131072): check"),
    ],
)
def test_an_unreadable_file_is_rejected_and_nothing_is_written(tmp_path, capsys, header, row, told):
    file, out = written(tmp_path / "a.csv", header, [row]), tmp_path / "left.json"
    assert main(["calibrate", "law", str(out), *WORDS, "--compression", str(file)]) == 1
    assert f"a.csv: {told}" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--theta", "0", "15"], "--theta: found 2 values for 1 files"),
        (
            ["--set", "tip.physics=measured", "--set", 'tactile.calibration=["a","b"]'],
            "measured curves require frames",
        ),
    ],
)
def test_contradictory_arguments_are_rejected(tmp_path, capsys, words, told):
    file = written(tmp_path / "a.csv", "d [mm],F [N]", machine("", "{0:.4f},{1:.4f}"))
    out = tmp_path / "left.json"
    words = [*WORDS, "--compression", str(file), *words]
    assert main(["calibrate", "law", str(out), *words]) == 1
    assert told in capsys.readouterr().err
    assert main(["calibrate", "modulus", str(out), *words]) == 1
    assert "--compression: found the `modulus` step, but only the" in capsys.readouterr().err


def test_a_depth_dependent_modulus_is_stored_as_points(tmp_path, capsys):
    def force(d: float, _: float) -> float:
        return springs(d) * (1.0 + 80.0 * d)

    d, load = pressed(force, np.random.default_rng(10), 0.02)
    rows = [f"{1e3 * x:.4f},{f:.4f}" for x, f in zip(d.tolist(), load.tolist(), strict=True)]
    file, out = written(tmp_path / "a.csv", "d [mm],F [N]", rows), tmp_path / "left.json"
    assert main(["calibrate", "law", str(out), *WORDS, "--compression", str(file)]) == 0
    step = load_calibration(out).modulus
    law = step.material()
    # Compute F by integrating the stored law over the strain.
    deep = 5e-3
    found = 2.0 * math.pi * (A - deep) ** 2
    found *= quad(lambda e: float(law.stress(e)) / (1.0 - e) ** 3, 0.0, deep / A)[0]
    assert found == pytest.approx(force(deep, 0.0), rel=0.01)
    told = capsys.readouterr().out
    assert 'material.law = "points"' in told
    points = re.search(r"material.strain = (\[.*?\])", told)
    assert json.loads(points[1]) == step.strain


def test_stress_and_strain_are_stored_as_points(tmp_path, capsys):
    law = Material.table_i()
    strain = np.concatenate([np.linspace(0.0, 0.5, 300), np.linspace(0.5, 0.0, 100)])
    noise = 50.0 * np.random.default_rng(11).standard_normal(len(strain))
    stress = law.stress(strain) * np.where(np.arange(400) < 300, 1.0, 0.9) + noise
    rows = [f"{100 * x:.4f},{s:.3f}" for x, s in zip(strain, stress * 1e-3, strict=True)]
    file = written(tmp_path / "a.csv", "strain [%],stress [kPa]", rows)
    out = tmp_path / "left.json"
    words = ["calibrate", "law", str(out), *WORDS, "--compression"]
    assert main([*words, str(file)]) == 0
    assert re.search(r"10\d unloading rows were excluded", capsys.readouterr().out)
    step = load_calibration(out).modulus
    at = np.linspace(0.05, 0.45, 9)
    assert step.material().stress(at) == pytest.approx(law.stress(at), rel=0.01)

    shifted = [f"{100 * x + 4:.4f},{s:.3f}" for x, s in zip(strain, stress * 1e-3, strict=True)]
    assert main([*words, str(written(file, "strain [%],stress [kPa]", shifted))]) == 1
    assert "a toe region or a zero offset" in capsys.readouterr().err


def test_the_documented_example_has_the_documented_output(tmp_path, capsys, monkeypatch):
    page = (ROOT / "docs" / "compression-test.md").read_text(encoding="utf-8")
    command, shown = re.search(r"```sh\nsoftfinger (.*)\n```\n\n```\n(.*?)```", page, re.S).groups()
    (tmp_path / "compression.csv").write_bytes((ROOT / "docs" / "compression.csv").read_bytes())
    monkeypatch.chdir(tmp_path)
    assert main(command.split()) == 0
    assert capsys.readouterr().out == shown
    assert Path("left.law.png").exists()
    quoted = re.findall(r"(?m)^(.*\].*)\n(0,.*)\n", page)
    assert "\n".join(quoted[0]) in (ROOT / "docs" / "compression.csv").read_text()
