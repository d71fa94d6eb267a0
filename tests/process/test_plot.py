"""Test the pages that ``softfinger plot`` makes of complete and incomplete recordings."""

import math
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Text

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.wire import schema
from softfinger.tools import style
from softfinger.tools.recordings import plot
from softfinger.tools.recordings.plot import RecordedRun
from softfinger.tools.recordings.reader import Recording
from tests.harness.recorded_hand import record_hand, write_recording

DUE = {
    50: {"command": "arm"},
    60: {"command": "grasp", "force": 6.0},
    700: {"command": "rotate", "angle": 0.1},
    1100: {"command": "grasp", "force": 4.0},
    1450: {"command": "release"},
}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    record_hand(path, DUE, 3.4)
    return path


def loaded(path: Path) -> RecordedRun:
    recording = Recording(path)
    return RecordedRun(recording, recording.states())


@pytest.fixture(scope="module")
def run(path: Path) -> RecordedRun:
    return loaded(path)


def drawn(run: RecordedRun, page: str) -> Figure:
    with style.settings():
        return plot.PAGES[page](run)


def texts(figure: Figure) -> str:
    return "\n".join(each.get_text() for each in figure.findobj(Text))


def lines(figure: Figure, label: str) -> list[np.ndarray]:
    return [
        np.array(line.get_data(), float)
        for axes in figure.axes
        for line in axes.lines
        if line.get_label() == label and len(line.get_xdata()) > 0
    ]


@pytest.mark.extended
def test_command_line_writes_every_page_in_print_quality(path, inline):
    done = inline("plot", path)
    assert (done.returncode, done.stderr) == (0, "")
    folder = path.with_name("run.mcap.plots")
    names = [f"{page}.png" for page in plot.PAGES]
    assert [Path(line).name for line in done.stdout.splitlines()] == names
    for name in names:
        pixels = imread(folder / name)
        assert pixels.shape[1] >= 1400  # The picture is 7 inches wide at 200 dpi.
        ink = (pixels[..., :3].min(axis=2) < 0.9).mean()
        assert 0.01 < ink < 0.7


def test_time_page_shows_every_value_and_its_goal(run):
    figure = drawn(run, "time")
    force, angle, d, theta = figure.axes
    for panel, field, factor in ((force, "force", 1.0), (d, "d", 1e3), (theta, "theta", 57.29578)):
        for line, name in zip(panel.lines[:2], ("left", "right"), strict=True):
            assert line.get_label() == name
            assert np.asarray(line.get_ydata()) == pytest.approx(
                factor * run.states[f"{name}.{field}"], nan_ok=True
            )
    assert np.nanmax(force.lines[2].get_ydata()) == 6.0
    assert np.nanmax(angle.lines[1].get_ydata()) == pytest.approx(math.degrees(0.1), abs=0.2)
    assert angle.get_xlim()[1] > 3.0
    empty = replace(
        run, states={name: values[:0] for name, values in run.states.items()}, where=" x"
    )
    with pytest.raises(RecordingError, match=r"mcap: the recording does not contain hand/state x"):
        plot.PAGES["time"](empty)


def test_model_page_has_points_near_the_model_curves(run):
    figure = drawn(run, "angle")
    assert "measured over" in texts(figure)
    force = figure.axes[1]
    points = np.concatenate([np.asarray(each.get_offsets()) for each in force.collections])
    depths = np.concatenate([np.asarray(each.get_array()) for each in force.collections])
    model = run.models[0].table(depths * 1e-3, np.radians(points[:, 0])).force
    firm = points[:, 1] > 1.0
    assert firm.sum() > 100
    # The error of the modulus factor limits the accuracy.
    assert np.median(np.abs(points[firm, 1] / model[firm] - 1.0)) < 0.06


def test_landscape_shows_the_local_minimum_and_the_path(run):
    figure = drawn(run, "landscape")
    (theta, d) = lines(figure, "local minimum over θ")[0]
    assert np.abs(theta).max() < 0.2  # According to the paper, the minimum is at θ = 0.
    assert d.max() > 3.0
    (angle, depth) = lines(figure, "left finger")[0]
    known = np.isfinite(depth)
    assert depth[known] == pytest.approx(run.states["left.d"][run.touching("left")] * 1e3)
    over = lines(figure, "left")[0][1]
    assert np.nanmin(over) > -1e-9
    assert np.nanmax(over) > 0.1
    assert angle[known].max() > 5.0


@pytest.mark.extended
def test_pages_are_written_as_svg_or_an_error_is_one_line(path, tmp_path, inline):
    words = ("--format", "svg", "--from", 1, "--to", 2)
    done = inline("plot", path, *words, "--out", tmp_path / "a" / "b")
    assert (done.returncode, done.stderr) == (0, "")
    files = sorted((tmp_path / "a" / "b").iterdir())
    assert [each.name for each in files] == ["angle.svg", "landscape.svg", "time.svg"]
    assert ElementTree.parse(files[0]).getroot().tag.endswith("svg")
    done = inline("plot", path, "--to", "0.2", "--out", tmp_path / "none")
    assert done.returncode == 1
    where = "the recording does not contain a contact between --from and --to"
    assert f"plot: {path}: {where}\n" in done.stderr
    write_recording(tmp_path / "nothing.mcap")
    done = inline("plot", tmp_path / "nothing.mcap", "--out", tmp_path / "none")
    assert done.returncode == 1
    assert "nothing.mcap: the recording does not contain hand/state\n" in done.stderr


def test_without_settings_no_model_is_drawn(path, tmp_path):
    write_recording(tmp_path / "bare.mcap", Recording(path).messages([schema.STATE]))
    bare = loaded(tmp_path / "bare.mcap")
    for page in ("angle", "landscape"):
        with pytest.raises(RecordingError, match=r"bare\.mcap: .* does not contain hand/settings"):
            plot.PAGES[page](bare)


@pytest.mark.extended
def test_a_recording_of_one_finger_is_drawn(tmp_path):
    path = tmp_path / "one.mcap"
    due = {50: {"command": "arm"}, 60: {"command": "grasp", "force": 2.0}}
    one = ('scene.fingers=["left"]', "scene.object_model=false")
    record_hand(path, due, 2.5, one)
    run = loaded(path)
    assert run.fingers == ("left",)
    for page in plot.PAGES:
        figure = drawn(run, page)
        assert "right" not in texts(figure).split("\n"), page


@pytest.mark.extended
def test_a_truncated_recording_is_drawn(tmp_path, path, inline):
    whole = path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    done = inline("plot", tmp_path / "cut.mcap", "--out", tmp_path / "cut")
    assert done.returncode == 0
    assert "cut short" in done.stderr
    assert (tmp_path / "cut" / "angle.png").exists()
