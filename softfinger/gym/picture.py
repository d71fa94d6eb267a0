"""Draw the simulated hand and its pressure maps as an RGB image, and display the image.

The scene contains the same lines as the `softfinger view` page. The estimated object is green, and
the true object is grey. The pressure maps are next to the scene. The left finger's map is above the
right finger's map.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire.schema import HandState
from softfinger.tools.terminal.heatmap import colour_map
from softfinger.tools.viewing.hand_drawing import COLOURS, hand_parts

Image = NDArray[np.uint8]

_SIDE, _MAP = 400, 150  # width of the scene and side length of a pressure map [pixels]
HEIGHT, WIDTH = 2 * _MAP, _SIDE + _MAP
_SCALE = 2100.0  # scale of the picture [pixels/m]
_LOWEST = -0.012  # y coordinate of the lower edge of the scene [m]
_THINNEST = 1.6  # pixels
_BACKGROUND = 24


class Painter:
    """Renderer for images of one hand."""

    def __init__(self, settings: Settings, full_scale: float) -> None:
        """Create a renderer; pressure maps show ``full_scale`` [counts] in the brightest colour."""
        self._settings = settings
        colours = np.array(colour_map(), np.uint8)
        self._colours, self._full = colours, full_scale / len(colours)

    def __call__(
        self, state: HandState, truth: dict[str, Any], pressure: NDArray[np.uint16]
    ) -> Image:
        """Return the image [HEIGHT, WIDTH, 3] for a state, a ``hand/truth`` message and frames."""
        scene = np.full((HEIGHT, _SIDE, 3), float(_BACKGROUND))
        for part in hand_parts(self._settings, state, truth).values():
            for colour, width, points in part.lines:
                _stroke(scene, points, width, COLOURS[colour])
        image = np.full((HEIGHT, WIDTH, 3), _BACKGROUND, np.uint8)
        image[:, :_SIDE] = np.rint(scene)
        for k, frame in enumerate(pressure):
            level = np.minimum(frame / self._full, len(self._colours) - 1).astype(np.intp)
            rows, cols = (np.arange(_MAP) * n // _MAP for n in frame.shape)
            shown = self._colours[level[::-1][rows[:, None], cols]]  # Row 0 is at the bottom.
            image[k * _MAP : (k + 1) * _MAP, _SIDE:] = shown
        return image


def _stroke(
    scene: NDArray[np.float64], points: NDArray[Any], width: float, colour: tuple[int, int, int]
) -> None:
    """Draw an antialiased line through points [n, 2] [m]."""
    at = np.array([0.5 * _SIDE, HEIGHT]) + _SCALE * (points - (0.0, _LOWEST)) * (1.0, -1.0)
    reach = 0.5 * max(_SCALE * width, _THINNEST) + 0.5
    cover = np.zeros(scene.shape[:2])
    for start, end in itertools.pairwise(at):
        rows, cols = _box(np.array([start, end]), reach)
        x = np.arange(_SIDE)[cols] + 0.5 - start[0]
        y = np.arange(HEIGHT)[rows, None] + 0.5 - start[1]
        along, across = (end - start).tolist()
        share = np.clip((x * along + y * across) / max(along**2 + across**2, 1e-9), 0.0, 1.0)
        distance = np.hypot(x - share * along, y - share * across)
        part = cover[rows, cols]
        np.maximum(part, np.clip(reach - distance, 0.0, 1.0), out=part)
    part = scene[_box(at, reach)]
    part += cover[_box(at, reach)][..., None] * (np.array(colour) - part)


def _box(at: NDArray[np.float64], reach: float) -> tuple[slice, slice]:
    """Return slices that enclose all pixels within a distance ``reach`` of points [n, 2]."""
    low, high = np.floor(at.min(axis=0) - reach), np.ceil(at.max(axis=0) + reach)
    (x0, y0), (x1, y1) = np.clip((low, high), 0, (_SIDE, HEIGHT)).astype(int).tolist()
    return slice(y0, y1), slice(x0, x1)


class Window:
    """Tkinter window that shows images at real-time speed or slower."""

    def __init__(self, title: str) -> None:
        """Open the window.

        Raises RuntimeError if tkinter or a display is missing.
        """
        self._shown = 0.0
        try:
            import tkinter

            self._root = tkinter.Tk()
        except Exception as error:  # ImportError, or TclError from tkinter itself
            raise RuntimeError(
                f"render_mode: found 'human', but no window can be opened: {error}; use a display "
                "and a Python installation with tkinter, or render_mode 'rgb_array'"
            ) from None
        self._closed_error = tkinter.TclError  # raised after the user has closed the window
        self._root.title(title)
        self._photo = tkinter.PhotoImage(width=WIDTH, height=HEIGHT)
        tkinter.Label(self._root, image=self._photo).pack()

    def show(self, image: Image, period: float) -> None:
        """If the window is open, show an image ``period`` [s] after the previous image."""
        time.sleep(max(self._shown + period - time.monotonic(), 0.0))
        self._shown = time.monotonic()
        with contextlib.suppress(self._closed_error):
            head = f"P6 {WIDTH} {HEIGHT} 255\n".encode()
            self._photo.configure(data=head + image.tobytes())
            self._root.update()

    def close(self) -> None:
        """Close the window."""
        with contextlib.suppress(self._closed_error):
            self._root.destroy()
