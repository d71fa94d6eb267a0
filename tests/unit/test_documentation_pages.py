"""Test that the site's pages build, that links are valid, and that quoted messages are exact."""

import ast
import html
import importlib.util
import math
import re
from pathlib import Path
from types import ModuleType

import pytest
from scipy.integrate import quad

import softfinger
from softfinger import testing
from softfinger.tools.paper import validate

ROOT = Path(__file__).parents[2]
SOURCES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/*.md"))]
LINK = re.compile(r"\]\((?!https?:)([^)#\s]*)(?:#([^)]*))?\)")


@pytest.fixture(scope="module")
def site() -> tuple[ModuleType, dict[str, str]]:
    """Return the module docs/pages.py, and the text of each page as MkDocs receives it."""
    spec = importlib.util.spec_from_file_location("pages", ROOT / "docs" / "pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    texts = {name: make() for name, make in module.PAGES.items()}
    texts |= {path.name: path.read_text(encoding="utf-8") for path in ROOT.glob("docs/*.md")}
    row = validate.between("ζ", 1.46, 1.88, "a book", 2.0)
    with pytest.MonkeyPatch.context() as patch:  # `test_figures` checks the rows.
        patch.setattr(validate, "comparisons", lambda: iter(30 * [row]))
        return module, {name: module.on_page_markdown(text) for name, text in texts.items()}


def written(text: str) -> str:
    """Return the text without code blocks, in which brackets are not links."""
    return re.sub(r"(?ms)^ *```.*?^ *```$|`[^`\n]*`", "", text)


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings."""
    headings = re.findall(r"(?m)^#+ (.*)$", re.sub(r"(?ms)^ *```.*?^ *```$", "", text))
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}


def test_every_page_is_built(site):
    _, pages = site
    for name, text in pages.items():
        assert text.startswith("# ") or "\n# " in text, name
        assert len(text) > 500, name
    nav = set(re.findall(r": ([\w-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M))
    assert nav == set(pages)


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.name)
def test_stored_tables_are_up_to_date(site, source):
    text = source.read_text(encoding="utf-8")
    assert site[0].with_tables(text) == text, "run `python docs/pages.py`"


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.name)
def test_links_in_the_repository_are_valid(source):
    for target, anchor in LINK.findall(written(source.read_text(encoding="utf-8"))):
        path = (source.parent / target).resolve() if target else source
        assert path.exists(), target
        if anchor:
            assert anchor in anchors(path.read_text(encoding="utf-8")), f"{target}#{anchor}"


def test_links_on_the_site_are_valid(site):
    _, pages = site
    for name, text in pages.items():
        for target, anchor in LINK.findall(written(text)):
            assert target in pages or not target or (ROOT / "docs" / target).exists(), (
                f"{name}: {target}"
            )
            if anchor:
                assert anchor in anchors(pages[target or name]), f"{name}: {target}#{anchor}"


def test_every_setting_is_described(site):
    rows = re.findall(r"(?m)^\| `(\w+)` \|.*\| (.*?) ?\|$", site[1]["configuration.md"])
    assert len(rows) > 150
    assert [key for key, meaning in rows if not meaning] == []


def test_the_reference_has_every_public_name_once(site):
    named = re.findall(r"(?m)^::: softfinger\.([\w.]+)$", site[1]["api.md"])
    plain = [name for name in named if not name.startswith("testing.")]
    assert sorted([*plain, "__version__"]) == sorted(softfinger.__all__)
    kit = {name.rpartition(".")[2] for name in named if name not in plain}
    assert kit == {name for name in testing.__all__ if name[0].isupper()} | {"checks"}


def test_every_erratum_is_listed(site):
    from softfinger.tools.paper.figures import pages

    text = site[1]["model.md"].replace("\\|", "|")
    for page in pages().values():
        assert all(each.holds in text for each in page.errata)
    assert "15.8197516322" in text  # F at d = 4 mm and θ = 15°


def test_model_values_on_pages_are_computed(site):
    _, pages = site
    for name, row in (
        ("model.md", "| 6 | −0.9 | −0.8 | −1.8 | −1.8 | −2.8 | −3.2 | −1.8 |"),
        ("model.md", "| 30 | 2.000 | 2.066 | 3.000 | 3.040 |"),
        ("model.md", "| ∂F/∂θ at 25° [N/rad] | 1.97 | 7.86 | 17.7 | 31.4 |"),
        ("grasped-object.md", "| 4 | 10.079 | 15.401 | 1213.1 |"),
        ("local-minimum.md", "| 4.75 | 10.6 | 0.394 | −0.866 | 0.000 | 0.889 |"),
        ("local-minimum.md", "| springs, before sliding | 0.667 | 0.667 | 0.667 | 0.667 |"),
        ("tip-models.md", "| Maxwell, 1.4 s | 0.999 | 0.993 | 0.931 | 0.490 | 0.001 |"),
        ("which-model.md", "| 4 | 15.3 | 31.5 (31.6) | 24.2 (24.2) | 19.3 |"),
    ):
        assert row in pages[name], f"{name}: {row}"


FORMULA = re.compile(r"(?s)\$\$(.+?)\$\$|(?<![\\$\w])\$(?! )([^$\n]+?)(?<! )\$(?!\w)")


def test_every_formula_is_typeset(site):
    module, pages = site
    found = 0
    for name, text in pages.items():
        plain = written(text)
        assert plain.replace("$$", "").count("$") % 2 == 0, name
        for block, inline in FORMULA.findall(plain):
            tag, ends = ("div", "[]") if block else ("span", "()")
            tex = html.escape(block or inline, quote=False)
            marked = f'<{tag} class="arithmatex">\\{ends[0]}{tex}\\{ends[1]}</{tag}>'
            shown = module.on_page_content(marked)
            assert shown.startswith("<math"), f"{name}: {block or inline}"
            assert "\\" not in shown, f"{name}: {shown}: unknown command"
            found += 1
    assert found > 150


def test_a_function_is_spaced_from_its_factors(site):
    shown = site[0].on_page_content(r'<span class="arithmatex">\(d \sin\theta\)</span>')
    assert [each for each in ("d", "sin") if f"<mi>{each}</mi><mspace" not in shown] == []


def test_drawings_use_the_colours_of_the_page(site):
    shown = site[0].on_page_content('<p><img alt="x" src="pictures/axes.svg" /></p>')
    assert shown.startswith('<p><svg class="axes"')
    assert ".axes text{" in shown
    assert re.findall(r"(?m)^(?:text|line|path|rect)\b.*\{", shown) == []
    for path in ROOT.glob("docs/pictures/*.svg"):
        text = path.read_text(encoding="utf-8")
        assert "currentColor" in text
        assert "#222" not in text


ROW = re.compile(r"(?m)^\| ([^|]*) \|.*\|.*\|$")


def texts() -> set[str]:
    """Return all strings in the sources, with … in place of formatted values."""
    found = set()
    for path in [
        *ROOT.glob("daemon/**/*.py"),
        *ROOT.glob("tools/**/*.py"),
        *ROOT.glob("kinematics/**/*.py"),
    ]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value)
            elif isinstance(node, ast.JoinedStr):
                parts = node.values
                found.add("".join(p.value if isinstance(p, ast.Constant) else "…" for p in parts))
    return found


def test_every_quoted_message_exists_in_the_program():
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    quoted = [text for row in ROW.findall(page) for text in re.findall(r"`([^`]+)`", row)]
    assert len(quoted) > 45
    known = "\n".join(texts())
    unknown = []
    for message in quoted:
        words = r"[^\n]*".join(map(re.escape, filter(None, re.split(r" ?… ?", message.strip()))))
        if not re.search(words, known):
            unknown.append(message)
    assert unknown == []


def test_the_torsion_moments_match_the_integrated_pressure(site):
    rows = re.findall(r"(?m)^\| (\d) \| (\S+) \| (\S+) \| (\S+) \| (\S+) \|$", site[0].torsion())
    assert len(rows) == 4
    a, modulus = 20.0, 0.304
    for d, normal, radius, moment, share in (map(float, row) for row in rows):
        reach = math.sqrt(a * a - (a - d) ** 2)

        def load(r: float, power: int, h: float = a - d) -> float:
            strain = 1.0 - h / math.sqrt(a * a - r * r)
            return 2.0 * math.pi * modulus * strain * r**power

        found = [quad(load, 0.0, reach, power)[0] for power in (1, 2)]
        assert radius == pytest.approx(reach, abs=0.005)
        assert normal == pytest.approx(found[0], rel=1e-3)
        assert moment == pytest.approx(found[1], abs=0.06)
        assert share == pytest.approx(found[1] / (found[0] * reach), abs=6e-4)
        assert share < 3.0 * math.pi / 16.0
