"""Test that a release has a changelog section, and one version and date in all project files."""

import datetime
import importlib.util
import re
from pathlib import Path

import pytest

import softfinger

ROOT = Path(__file__).parents[2]
TODAY = datetime.date(2031, 2, 3)
LOG = """# Changelog

## [Unreleased]

### Added

- A second hand.

## [1.2.0] - 2030-01-01

### Fixed

- A sign.
"""


@pytest.fixture(scope="module")
def release():
    spec = importlib.util.spec_from_file_location("release", ROOT / ".ci" / "release.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_file_states_the_version_of_the_package_and_its_date(release):
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    values = release.stated(changelog, softfinger.__version__)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", values["date"])
    for name, quantity, pattern in release.RELEASE_LINES:
        (found,) = re.findall(pattern, (ROOT / name).read_text(encoding="utf-8"))
        assert found[1] == values[quantity], name


def test_the_bibtex_entry_matches_the_citation_file():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (entry,) = re.findall(r"(?ms)^```\n@software\{softfinger,\n(.*?)^\}\n```$", readme)
    for field, key in (("author", "  - name"), ("title", "title"), ("version", "version")):
        (cited,) = re.findall(rf"(?m)^{key}: (.*)$", citation)
        (found,) = re.findall(rf"(?m)^  {field} = \{{+(.*?)\}}+,$", entry)
        assert found == cited, field


def test_changelog_sections_are_short_and_start_with_unreleased(release):
    found = release.sections((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    versions = list(found)
    assert versions[0] == "Unreleased"
    assert versions[1] == softfinger.__version__
    for version, text in found.items():
        kinds = re.findall(r"(?m)^### (.*)$", text)
        assert len(kinds) == len(set(kinds)), version
        assert sum(bool(line) for line in text.splitlines()) < release.MAX_LINES, version


def test_unreleased_entries_move_below_the_version_and_its_date(release):
    after = release.dated(LOG, "1.3.0", TODAY)
    assert "## [Unreleased]\n\n## [1.3.0] - 2031-02-03\n\n### Added\n" in after
    assert release.sections(after) == {
        "Unreleased": "",
        "1.3.0": "### Added\n\n- A second hand.",
        "1.2.0": "### Fixed\n\n- A sign.",
    }
    assert release.dated(after, "1.3.0", datetime.date(2032, 1, 1)) == after


@pytest.mark.parametrize(
    ("log", "version", "message"),
    [
        (LOG, "1.3", r"VERSION: found '1\.3', expected three numbers"),
        (LOG, "1.2.0", r"entries below both Unreleased and 1\.2\.0"),
        (LOG, "1.1.9", r"VERSION: found 1\.1\.9, expected one above 1\.2\.0"),
        (LOG.replace("- A second hand.", "- A hand.\n" * 40), "1.3.0", r"found 42 lines for 1\.3"),
        (LOG.replace("### Added\n\n- A second hand.\n", ""), "1.3.0", r"no entries for 1\.3\.0"),
        (LOG.replace("## [Unreleased]\n", ""), "1.3.0", r"no heading '## \[Unreleased\]'"),
    ],
)
def test_a_release_that_contradicts_the_changelog_is_refused(release, log, version, message):
    with pytest.raises(release.ReleaseError, match=message):
        release.dated(log, version, TODAY)


def test_workflows_pin_actions_by_commit_and_hooks_use_the_ruff_of_make_lint():
    workflows = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
    used = [
        line
        for path in workflows
        for line in re.findall(r"(?m)uses: (.*)$", path.read_text(encoding="utf-8"))
    ]
    assert len(used) >= len(workflows) > 0
    assert [each for each in used if not re.fullmatch(r"\S+@[0-9a-f]{40} # v[\d.]+", each)] == []
    page = (ROOT / "docs" / "test-your-controller.md").read_text(encoding="utf-8")
    advised = re.findall(r"(?m)uses: (.*)$", page)
    assert len(advised) == 2
    assert set(advised) <= set(used)
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    assert re.findall(r"rev: v(\S+)", hooks) == re.findall(r"(?m)^ruff==(\S+)", pinned)
