"""Test the text and pictures that display stream records at a prompt and in a notebook."""

import re
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from softfinger.daemon.client.stream import read
from softfinger.daemon.wire.schema import Event, FingerState, HandState, ObjectState, TactileFrame
from tests.harness import fake_daemon

LEFT = {"force": 8.0, "force_std": 0.6, "d": 4e-3, "d_std": 2e-5, "theta": 0.0035, "q": 0.42}
LEFT |= {"theta_std": 0.001, "contact": True, "valid": True, "current": -0.001, "temperature": 41.0}
HELD: dict[str, Any] = {
    "mode": "holding",
    "left": LEFT,
    "right": LEFT | {"force": 8.1},
    "object": {"valid": True, "angle": 0.0035, "width": 0.04},
}


def frame(cells: np.ndarray, **changes: Any) -> TactileFrame:
    rows, cols = cells.shape
    message = fake_daemon.frame(0.0, 0) | {"rows": rows, "cols": cols, "scale": 2.0} | changes
    return read(TactileFrame, message | {"data": cells.astype("<u2").tobytes()})


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({}, "holding, 8.1 N (8.0 ± 0.6, 8.1 ± 0.6), 0.2°, 40.0 mm"),
        ({"right": {"contact": False}, "object": {}}, "holding, 8.0 N (8.0 ± 0.6)"),
        ({"mode": "armed", "left": {}, "right": {}, "object": {}}, "armed"),
        ({"mode": "fault", "fault": "servo 1: overload"}, "fault, servo 1: overload"),
        (
            {"left": LEFT | {"contact": False, "invalid": "saturated"}, "object": {}},
            "holding, 8.1 N (8.1 ± 0.6), left not valid: saturated",
        ),
    ],
)
def test_a_state_is_a_line(changes, told):
    assert repr(read(HandState, HELD | changes)) == f"HandState: {told}"


def test_the_parts_of_a_state_are_lines():
    state = read(HandState, HELD)
    assert repr(state.left) == (
        "FingerState: 8.0 ± 0.6 N, d 4.00 ± 0.02 mm, θ 0.2 ± 0.1°, joint 24.1°"
    )
    assert repr(state.object) == "ObjectState: 0.2°, 40.0 mm"
    assert repr(read(FingerState, {"q": -1e-9})) == "FingerState: no contact, joint 0.0°"
    told = "FingerState: not valid: saturated, joint nan°"
    assert repr(read(FingerState, {"invalid": "saturated"})) == told
    assert repr(read(ObjectState, {})) == "ObjectState: not valid"
    event = read(Event, {"level": "warning", "kind": "grasp", "text": "a heavy object"})
    assert repr(event) == "Event: warning, grasp: a heavy object"


def test_a_frame_is_a_line():
    cells = np.zeros((3, 4))
    cells[1, 2] = 6000
    assert repr(frame(cells)) == "TactileFrame: left, 3 × 4 cells, 12.0 kPa at most"
    assert repr(frame(cells, valid=False)).endswith("12.0 kPa at most, the board is disconnected")


def test_a_state_is_a_table_in_a_notebook():
    table = ElementTree.fromstring(read(HandState, HELD | {"mode": "<holding>"})._repr_html_())
    assert table.findtext("caption").startswith("<holding>, 8.1 N")
    rows = {row.findtext("th"): [cell.text for cell in row.iter("td")] for row in table.iter("tr")}
    assert rows["force [N]"] == ["8.0 ± 0.6", "8.1 ± 0.6"]
    assert rows["d [mm]"] == ["4.00 ± 0.02", "4.00 ± 0.02"]
    assert rows["current [A]"] == ["0.00", "0.00"]
    free = ElementTree.fromstring(read(HandState, {})._repr_html_())
    assert [cell.text for cell in free.iter("td")][:2] == [None, None]


def drawn(found: TactileFrame) -> tuple[ElementTree.Element, np.ndarray]:
    """Return the picture of a frame, and the opacity of each cell; row 0 is at the bottom."""
    picture, _ = ElementTree.fromstring(f"<p>{found._repr_html_()}</p>")
    cells = np.zeros((found.rows, found.cols))
    for path in picture:
        for x, y, n in re.findall(r"M(\d+) (\d+)h(\d+)v1h-\3z", path.get("d")):
            run = cells[found.rows - 1 - int(y), int(x) : int(x) + int(n)]
            assert not run.any(), "a cell is drawn twice"
            run[:] = float(path.get("fill-opacity"))
    return picture, cells


def test_a_frame_is_a_picture_in_a_notebook():
    counts = np.zeros((20, 30))
    counts[5:9, 10:20] = 3000
    counts[6, 12] = 10000
    picture, cells = drawn(frame(counts))
    np.testing.assert_allclose(cells, np.rint(counts / 10000 * 12) / 12, atol=0.006)
    assert picture.get("viewBox") == "0 0 30 20"
    assert (picture.get("width"), picture.get("height")) == ("176", "117")
    assert len(frame(counts)._repr_html_()) < 1500


def test_noise_on_a_free_tip_stays_faint():
    noise = np.abs(np.random.default_rng(1).normal(0.0, 300.0, (44, 44)))
    assert drawn(frame(noise, scale=1.0))[1].max() < 0.2
    assert not drawn(frame(np.zeros((44, 44))))[1].any()


@pytest.mark.parametrize("pitch", [0.0, float("nan"), 1e300, -1.0])
def test_a_picture_of_an_implausible_grid_has_the_shape_of_its_cells(pitch):
    picture, _ = drawn(frame(np.ones((10, 20)), pitch=pitch, pitch_y=0.001))
    assert (picture.get("width"), picture.get("height")) == ("176", "88")
