"""What a user would otherwise take for d and tilt from a frame: outside packages, where installed.

Each takes a frame [Pa], keeps what is above three times the noise, and turns the moments or the
area that its package gives into d and the tilts by the model's own closed forms. The last one fits
the same model to the same cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.pressure_grid import SensorGrid

FloatArray = NDArray[np.float64]
Answer = tuple[float, float, float]  # d, tilt_x, tilt_y
Method = Callable[[FloatArray], Answer]
Answers = Callable[[float, float, float, float], Answer]


def rivals(
    tip: Fingertip, material: Material, grid: SensorGrid, noise: float
) -> tuple[dict[str, Method], list[str]]:
    """The methods that can run here, by name, and what to install for the others."""
    level = 3.0 * noise
    pitch_x, pitch_y = grid.pitches
    a = tip.radius

    def answer(x: float, y: float, variance_x: float, variance_y: float) -> Answer:
        """From centroid and variances in cells, the middle of the grid at 0."""
        x, y = x * pitch_x - grid.centre[0], y * pitch_y - grid.centre[1]
        trace = (variance_x - 1 / 12) * pitch_x**2 + (variance_y - 1 / 12) * pitch_y**2
        d = 2 * a - 2 * math.sqrt(max(a * a - 1.5 * max(trace, 0.0), 0.0))
        for _ in range(6):  # the trace falls with the tilt
            s2 = min((x * x + y * y) / (a - d / 3) ** 2, 0.9)
            full = trace + s2 * d * (12 * a - 5 * d) / 36
            d = 2 * a - 2 * math.sqrt(max(a * a - 1.5 * max(full, 0.0), 0.0))
        arm = a - d / 3
        return d, math.asin(_bounded(x / arm)), math.asin(_bounded(y / arm))

    rows, cols = grid.shape
    axes = [np.linspace(0.5 - 0.5 * n, 0.5 * n - 0.5, n) for n in (rows, cols)]
    moments = _numpy(level, axes[0], axes[1], answer)
    found, missing = {"NumPy moments over a threshold": moments}, []
    for name, package, make in (
        ("SciPy ndimage center_of_mass, label", "scipy", _ndimage),
        ("OpenCV moments", "opencv-python-headless", _opencv),
        ("scikit-image regionprops", "scikit-image", _skimage),
    ):
        try:
            found[name] = make(level, axes[0], axes[1], answer)
        except ImportError:
            missing.append(package)
    if "scipy" not in missing:
        fit = _least_squares(tip, material, grid, moments)
        found["scipy least_squares, the same model"] = fit
    return found, missing


def _numpy(level: float, i_axis: FloatArray, j_axis: FloatArray, answer: Answers) -> Method:
    def method(frame: FloatArray) -> Answer:
        kept = np.where(frame > level, frame, 0.0)
        by_col, by_row = kept.sum(axis=0), kept.sum(axis=1)
        total = by_col.sum()
        x, y = by_col @ j_axis / total, by_row @ i_axis / total
        return answer(x, y, by_col @ j_axis**2 / total - x * x, by_row @ i_axis**2 / total - y * y)

    return method


def _bounded(s: float) -> float:
    return min(max(s, -0.95), 0.95)


def _ndimage(level: float, i_axis: FloatArray, j_axis: FloatArray, answer: Answers) -> Method:
    from scipy import ndimage

    def method(frame: FloatArray) -> Answer:
        labels, count = ndimage.label(frame > level)
        index = 1 + int(np.argmax(ndimage.sum_labels(frame, labels, np.arange(1, count + 1))))
        y, x = ndimage.center_of_mass(frame, labels, index)
        total = ndimage.sum_labels(frame, labels, index)
        rows = np.arange(len(i_axis))[:, None] - y
        cols = np.arange(len(j_axis))[None, :] - x
        vy = ndimage.sum_labels(frame * rows**2, labels, index) / total
        vx = ndimage.sum_labels(frame * cols**2, labels, index) / total
        return answer(x + j_axis[0], y + i_axis[0], vx, vy)

    return method


def _opencv(level: float, i_axis: FloatArray, j_axis: FloatArray, answer: Answers) -> Method:
    import cv2

    def method(frame: FloatArray) -> Answer:
        _, kept = cv2.threshold(frame.astype(np.float32), level, 0.0, cv2.THRESH_TOZERO)
        m = cv2.moments(kept)
        total = m["m00"]
        x, y = m["m10"] / total, m["m01"] / total
        return answer(x + j_axis[0], y + i_axis[0], m["mu20"] / total, m["mu02"] / total)

    return method


def _skimage(level: float, i_axis: FloatArray, j_axis: FloatArray, answer: Answers) -> Method:
    from skimage.measure import label, regionprops

    def method(frame: FloatArray) -> Answer:
        regions = regionprops(label(frame > level), intensity_image=frame)
        region = max(regions, key=lambda each: each.area)
        moments = region.moments_weighted_central
        y, x = region.centroid_weighted
        total = moments[0, 0]
        return answer(x + j_axis[0], y + i_axis[0], moments[0, 2] / total, moments[2, 0] / total)

    return method


def _least_squares(tip: Fingertip, material: Material, grid: SensorGrid, start: Method) -> Method:
    from scipy.optimize import least_squares

    unit = material.reference_modulus
    out = np.empty(grid.shape)

    def method(frame: FloatArray) -> Answer:
        def residual(p: FloatArray) -> FloatArray:
            d, x, y = 1e-3 * p[0], float(p[1]), float(p[2])
            model = grid.pressure(tip, material, min(max(d, 1e-5), 0.015), x, y, p[3], out)
            return ((model - frame) / unit).ravel()

        d, x, y = start(frame)
        fit = least_squares(residual, [d * 1e3, x, y, 1.0], x_scale=[1.0, 0.1, 0.1, 0.1])
        return 1e-3 * float(fit.x[0]), float(fit.x[1]), float(fit.x[2])

    return method
