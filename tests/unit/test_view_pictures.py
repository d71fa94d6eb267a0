"""Test the viewer's drawings of footprints, hand and landscape against the model."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger.daemon.client.stream import read
from softfinger.daemon.control.modes import Mode
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire.schema import FingerState, HandState, TactileFrame
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.tools.terminal.heatmap import LEVELS
from softfinger.tools.viewing import pictures
from softfinger.tools.viewing.hand_drawing import (
    finger_part,
    footprint,
    grid_of,
    held_outline,
    on_picture,
    tip_circle,
)
from softfinger.tools.viewing.landscape import HEIGHT, THETA_END, WIDTH, landscape, read_settings
from tests.harness.reference_hand import ReferenceHand

TIP = Fingertip(radius=0.020)
GRIDS = (
    SensorGrid(44, 44, 0.058 / 44),
    SensorGrid(30, 50, (0.0012, 0.0019), (0.002, -0.001), 0.4),
)


def area(outline: NDArray[np.float64]) -> float:
    x, y = outline.T
    return 0.5 * abs(float(x[:-1] @ y[1:] - x[1:] @ y[:-1]))


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("contact", [(0.004, 0.3, 0.0), (0.002, -0.2, 0.35), (0.006, 0.0, 0.0)])
def test_the_footprint_matches_the_forward_model(grid, contact):
    pressure = grid.pressure(TIP, Material.constant(0.304e6), *contact)
    shown = footprint(grid, TIP.radius, *contact)
    assert shown is not None
    rows, cols = np.indices(grid.shape) + 0.5
    centroid = (pressure * cols).sum(), (pressure * rows).sum()
    outline, middle = shown
    assert middle == pytest.approx(np.array(centroid) / pressure.sum(), abs=0.05)
    # The outline overlaps every loaded cell, and the cells at the ends of the outline are loaded.
    pressed = np.column_stack((cols[pressure > 0.0], rows[pressure > 0.0]))
    low, high = outline.min(axis=0), outline.max(axis=0)
    assert (pressed >= low - 0.5).all()
    assert (pressed <= high + 0.5).all()
    assert pressed.min(axis=0) == pytest.approx(low, abs=0.51)
    assert pressed.max(axis=0) == pytest.approx(high, abs=0.51)
    d, tilt_x, tilt_y = contact
    cosine = math.sqrt(1.0 - math.sin(tilt_x) ** 2 - math.sin(tilt_y) ** 2)
    cell = grid.pitches[0] * grid.pitches[1]
    expected = math.pi * (2.0 * TIP.radius * d - d * d) * cosine
    assert area(outline) * cell == pytest.approx(expected, rel=0.003)


def test_the_grid_is_read_from_the_frame() -> None:
    def told(rows: int, cols: int, **fields: float) -> TactileFrame:
        message = {"rows": rows, "cols": cols, "data": bytes(2 * rows * cols), **fields}
        return read(TactileFrame, message)

    placed = {"centre_x": 0.002, "centre_y": -0.001, "rotation": 0.4}
    assert grid_of(told(30, 50, pitch=0.0012, pitch_y=0.0019, **placed)) == GRIDS[1]
    square = grid_of(told(44, 44, pitch=0.058 / 44))
    assert square is not None
    assert square.pitches == GRIDS[0].pitches
    assert grid_of(told(44, 44)) is None
    rim = tip_circle(GRIDS[0], TIP.radius)
    assert rim.max(axis=0) == pytest.approx([22.0 + 0.020 / GRIDS[0].pitches[0]] * 2)
    assert on_picture(GRIDS[1], np.zeros((1, 2)))[0] == pytest.approx(
        [25 + 0.002 / 0.0012, 15 - 0.001 / 0.0019]
    )


# Colours


def contrast(*colours: str) -> float:
    """Return the contrast ratio of two colours as defined in WCAG 2."""

    def luminance(colour: str) -> float:
        parts = (int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
        linear = [p / 12.92 if p < 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return float(np.dot((0.2126, 0.7152, 0.0722), linear))

    low, high = sorted(map(luminance, colours))
    return (high + 0.05) / (low + 0.05)


_TEXTS = ("text", "muted", "warning", "error", "goal", "late", "left", "right", "object")


def test_texts_and_mode_strips_have_the_contrast_of_wcag_aa() -> None:
    css = (Path(pictures.__file__).parent / "web" / "page.css").read_text("utf-8")
    light, dark = (
        dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", theme))
        for theme in re.findall(r"(?ms)^:root.*?\}", css)
    )
    for theme in (light, light | dark):
        for name in _TEXTS:
            assert contrast(theme[name], theme["card"]) >= 4.5, name
        for mode in Mode:
            assert contrast(theme[mode.value], theme["card"]) >= 3.0, mode
            assert contrast(theme[mode.value], "#ffffff") >= 4.5, mode
        assert contrast(theme["text"], theme["button"]) >= 4.5


# The planar hand

HAND = ReferenceHand(0.1, 0.08, 0.005, 0.02)
POSE = np.array([0.003, 0.081, 0.12])
WIDTH_M = 0.043
Q = (0.14, 0.10)


def held() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    contacts = HAND.contacts(Q, POSE, WIDTH_M)
    assert (contacts.d > 0.0).all()
    return contacts.d, contacts.theta


@pytest.mark.parametrize("finger", [0, 1])
def test_an_indented_tip_ends_at_the_face_of_the_object(finger: int) -> None:
    d, theta = held()
    fields = {"contact": True, "q": Q[finger], "d": d[finger], "theta": theta[finger], "force": 8.0}
    part = finger_part(HAND, finger, read(FingerState, fields))
    _, base, skin, face, arrow = (points for _, _, points in part.lines)
    n = np.array([math.cos(POSE[2]), math.sin(POSE[2])])
    outwards = -n if finger == 0 else n  # outward normal of the object's face

    def beyond(points: NDArray[np.float64]) -> NDArray[np.float64]:
        distance: NDArray[np.float64] = (points - POSE[:2]) @ outwards - 0.5 * WIDTH_M
        return distance

    assert beyond(face) == pytest.approx([0.0, 0.0], abs=1e-12)
    assert beyond(arrow[:1]) == pytest.approx([0.0], abs=1e-12)
    assert beyond(skin).min() == pytest.approx(0.0, abs=1e-6)
    middle, out = face.mean(axis=0), (arrow[1] - arrow[0]) / np.linalg.norm(arrow[1] - arrow[0])
    centre = HAND.tips(Q)[finger]
    assert -outwards @ out == pytest.approx(math.cos(theta[finger]))
    assert (middle - centre) @ outwards == pytest.approx(-(0.02 - d[finger]))
    # The drawn force arrow starts on the face, directly above the pressure centroid on the base.
    along = (base[1] - base[0]) / 0.04
    assert -outwards @ along == pytest.approx(math.sin(theta[finger]))
    foot = (arrow[0] - centre) @ along
    assert foot == pytest.approx((0.02 - d[finger] / 3.0) * math.sin(theta[finger]))


def test_the_held_object_is_drawn_with_its_width_and_height() -> None:
    fingers = {
        name: {"contact": True, "q": q, "d": d, "theta": theta}
        for name, q, d, theta in zip(FINGERS, Q, *held(), strict=True)
    }
    state = read(HandState, fingers | {"object": {"valid": True, "width": WIDTH_M}})
    (outline,) = held_outline(HAND, state, 0.06)
    n = np.array([math.cos(POSE[2]), math.sin(POSE[2])])
    across = (outline - POSE[:2]) @ n
    assert [across.min(), across.max()] == pytest.approx([-0.5 * WIDTH_M, 0.5 * WIDTH_M])
    assert np.ptp(outline @ np.array([-n[1], n[0]])) == pytest.approx(0.06)


# The energy landscape


def test_colours_are_steps_of_the_cube_root_of_energy() -> None:
    shown = landscape(Settings())
    assert shown is not None
    assert shown.d_end == pytest.approx(min(Settings().safety.d_max, 0.95 * TIP.radius))
    exact = ContactTable.build(TIP, Material.table_i(), tolerance=1e-9)
    rows, cols = np.nonzero(shown.levels < LEVELS)
    theta = np.radians(((cols + 0.5) / WIDTH * 2.0 - 1.0) * THETA_END)
    d = (1.0 - (rows + 0.5) / HEIGHT) * shown.d_end
    root = np.cbrt(exact(d, theta, edge=True).energy / shown.highest)
    assert shown.highest == pytest.approx(float(exact(shown.d_end, 0.0).energy), rel=1e-5)
    assert shown.levels[rows, cols] / (LEVELS - 1.0) == pytest.approx(
        np.minimum(root, 1.0), abs=0.6 / (LEVELS - 1.0)
    )
    assert (np.abs(theta) <= TIP.theta_limit(d) + 1e-3).all()
    assert (shown.levels == LEVELS).any()  # The picture also shows impossible contacts.


# Settings of the hand


def test_known_settings_of_another_version_are_kept() -> None:
    sections = json.loads(Settings().model_dump_json())
    sections["tip"]["radius"] = 0.015
    sections["tip"]["wear"] = 0.1
    sections["servos"]["model"] = 7
    sections["aura"] = {"colour": "green"}
    settings, passed = read_settings({"settings": json.dumps(sections)})
    assert sorted(passed) == ["aura", "servos.model", "tip.wear"]
    assert settings.tip.radius == 0.015
    assert settings.servos == Settings().servos
    for text in ("", "{", "[]", "null", "[" * 100_000, 3, None):
        assert read_settings({"settings": text})[0] == Settings()
