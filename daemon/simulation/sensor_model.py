"""Convert a simulated contact to the counts that a sensor board sends.

`simulated_tactile` handles delayed and lost frames. Standard models describe the sensor
imperfections.

This module computes the pressure that a cylindrical face, such as the side of a disc, exerts on the
cells. `sensing.pressure_grid` computes the pressure that a flat face exerts. Both modules model the
tip as vertical springs that the face compresses. The length of a spring is the height of the
hemisphere above the foot of the spring. An estimator that assumes a flat face underestimates d on a
disc, because the footprint is narrower. The ratio of the estimated d to the true d is 0.72 for a
disc of radius R = a and 0.83 for R = 2a. The estimated θ is 1 % to 12 % too small, and this error
increases with d. The estimated gain is above 1 and compensates for the underestimated force.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.profile.settings import TactileSettings
from softfinger.daemon.profile.simulation_settings import SimulationSettings
from softfinger.daemon.simulation.faults import MeasurementFaults
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.sensing.blur import axis_points, cell_means
from softfinger.kinematics.sensing.pressure_grid import SensorGrid
from softfinger.kinematics.sensing.solid_pressure import SolidPressure
from softfinger.kinematics.sensing.springs_pressure import SpringsPressure, count_for

FloatArray = NDArray[np.float64]

PLAY_COUNT = 4
_FINENESS = 60.0  # minimum number of sample points per tip radius


class SensorModel:
    """Pressure sensor under one simulated tip, with the board's range and imperfections.

    ``gain`` is the ratio of the reading to the pressure that the material law predicts. ``dead``
    lists the cells (row, col) that always read 0. Two models that are created and called with the
    same arguments produce the same frames.
    """

    def __init__(
        self,
        grid: SensorGrid,
        tip: Fingertip,
        material: Material,
        board: TactileSettings,
        flaws: SimulationSettings,
        *,
        seed: int | Sequence[int] = 0,
        gain: float = 1.0,
        dead: Sequence[tuple[int, int]] = (),
    ) -> None:
        self.grid = grid
        self._board, self._flaws = board, flaws
        self._material, self._cells = material, grid.on(tip)
        self._generator = np.random.Generator(np.random.SFC64(seed))
        shape = grid.shape
        deviations = self._generator.standard_normal(shape)
        spread = np.maximum(1.0 + flaws.tactile_gain_spread * deviations, 0.0)
        sensitivity = gain * spread / board.pascal_per_count
        for row, col in dead:
            sensitivity[row, col] = 0.0
        if flaws.tactile_dead > 0.0:
            sensitivity[self._generator.random(shape) < flaws.tactile_dead] = 0.0
        self._sensitivity = sensitivity
        self._pressure = np.zeros(shape)
        self._count = count_for(self._cells, _FINENESS)
        self._tip: SolidPressure | SpringsPressure
        if tip.physics == "solid":
            blurred = replace(grid, blur=flaws.tactile_blur)
            self._tip = SolidPressure(tip, material, blurred.images(tip))
        else:
            self._tip = SpringsPressure(self._cells, material, flaws.tactile_blur, self._count)
        self._plays = np.zeros((PLAY_COUNT if flaws.tactile_hysteresis > 0.0 else 0, *shape))
        self._creep_lag, self._response_lag = np.zeros((2, 2, *shape))
        self._offset = np.zeros(shape)  # counts
        self._warmer = np.zeros(1)  # relative gain drift
        self._t: float | None = None

    @property
    def active(self) -> NDArray[np.bool_]:
        """True for cells that are not dead, bool [rows, cols]."""
        return self._sensitivity > 0.0

    @property
    def has_memory(self) -> bool:
        """True if readings depend on earlier contacts."""
        flaws = self._flaws
        return (
            flaws.tactile_hysteresis > 0.0
            or flaws.tactile_creep > 0.0
            or flaws.tactile_response > 0.0
        )

    def frame(
        self,
        d: float,
        tilt_x: float,
        tilt_y: float,
        out: NDArray[np.uint16],
        t: float = 0.0,
        curvature: float = 0.0,
    ) -> None:
        """Write the counts of the next frame to ``out``, a contiguous uint16 array [rows, cols].

        If ``d`` [m] is 0 or negative, there is no contact. The tilts [rad] are defined in
        :meth:`SensorGrid.pressure`. ``t`` [s] is the frame time, which determines creep, response
        and drift. ``curvature`` is defined in :meth:`press`.
        """
        self.press(d, tilt_x, tilt_y, t, curvature)
        self.read(out)

    def press(
        self,
        d: float,
        tilt_x: float,
        tilt_y: float,
        t: float = 0.0,
        curvature: float = 0.0,
        fraction: float = 1.0,
        shear: float = 0.0,
    ) -> None:
        """Apply the contact at time ``t`` to the cells, but do not read the cells.

        ``curvature`` [1/m] is the curvature of the face in the plane of ``tilt_x``, or 0 for a
        flat face. A curved face is a cylinder whose axis is parallel to the finger's y axis. All
        pressures are multiplied by ``fraction``. A solid tip ignores ``curvature``, because
        ``fraction`` already includes its effect. The frame of a solid tip also depends on the
        ``shear`` force [N], which acts along x at height a.
        """
        n_x, n_y = self.grid.to_sensor(math.sin(tilt_x), math.sin(tilt_y))
        flaws, pressure = self._flaws, self._pressure
        elapsed = 0.0 if self._t is None else max(t - self._t, 0.0)
        self._t = t
        if isinstance(self._tip, SolidPressure):
            self._tip((d, n_x, n_y), fraction, pressure, self.grid.to_sensor(shear, 0.0))
        elif curvature > 0.0:
            pressure[:] = fraction * self._curved(d, n_x, n_y, 1.0 / curvature)
        else:
            self._tip((d, n_x, n_y), fraction, pressure)
        if flaws.tactile_hysteresis > 0.0:
            hysteresis(pressure, flaws.tactile_hysteresis, self._plays)
        if flaws.tactile_creep > 0.0:
            pressure += flaws.tactile_creep * lag(
                pressure, flaws.tactile_creep_time, elapsed, self._creep_lag
            )
        if flaws.tactile_response > 0.0:
            pressure[:] = lag(pressure, flaws.tactile_response, elapsed, self._response_lag)
        if flaws.tactile_drift > 0.0:
            normals = self._generator.standard_normal(self.grid.shape)
            deviation = flaws.tactile_drift / self._board.pascal_per_count
            drift(self._offset, deviation, flaws.tactile_drift_time, elapsed, normals)
        if flaws.tactile_gain_drift > 0.0:
            normal = self._generator.standard_normal(1)
            drift(self._warmer, flaws.tactile_gain_drift, flaws.tactile_drift_time, elapsed, normal)

    @cached_property
    def _points(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Sample positions across the cylinder axis, hemisphere heights [m], and weights.

        The position and height arrays have the shape [lines, points per line]. The height is 0
        beyond the rim. The third array contains the weights for averaging over a cell along y. The
        fourth array contains the weights for averaging along x.
        """
        cells, blur = self._cells, self._flaws.tactile_blur
        x, along_x = axis_points(cells.x, cells.pitch_x, cells.cols, self._count[0], blur)
        y, along_y = axis_points(cells.y, cells.pitch_y, cells.rows, self._count[1], blur)
        x, y = x.T.ravel(), y.T.ravel()[:, None]
        height = np.sqrt(np.maximum(cells.radius**2 - x**2 - y**2, 0.0))
        across_x, across_y = self.grid.to_sensor(1.0, 0.0)
        return across_x * x + across_y * y, height, along_y, along_x

    def _curved(self, d: float, n_x: float, n_y: float, roundness: float) -> FloatArray:
        """Return the pressure [Pa] on each cell due to a cylinder of radius R = ``roundness`` [m].

        The normal (n_x, n_y, …) points from the tip centre to the cylinder axis. The distance to
        the axis is a − d + R. At the coordinate p across the axis, the face has the height z and
        the strain is ε:

            z = c_z − √(R² − (p − c_p)²),    ε = 1 − z/√(a² − x² − y²)

        A cell's pressure is the mean over its sample points.
        """
        tilted = n_x * n_x + n_y * n_y
        if not (d > 0.0 and tilted < 1.0):
            return np.zeros(self.grid.shape)
        across, height, along_y, along_x = self._points
        across_x, across_y = self.grid.to_sensor(1.0, 0.0)
        away = self._cells.radius - d + roundness
        off = across - away * (n_x * across_x + n_y * across_y)
        under = roundness * roundness - off * off
        z = away * math.sqrt(1.0 - tilted) - np.sqrt(np.maximum(under, 0.0))
        touched = (z < height) & (under > 0.0)
        pressure = np.zeros(across.shape)
        pressure[touched] = self._material.stress(
            1.0 - np.maximum(z[touched], 0.0) / height[touched]
        )
        return cell_means(pressure, along_y, along_x)

    def press_evenly(self, pressure: float) -> None:
        """Replace the last press with a uniform pressure [Pa], as exerted by a bladder."""
        self._pressure[:] = pressure

    def read(
        self, out: NDArray[np.uint16], faults: MeasurementFaults | None = None, t: float = 0.0
    ) -> None:
        """Apply the ``faults`` active at ``t`` [s], and write the cell counts to ``out``."""
        flaws, board = self._flaws, self._board
        full_scale = board.full_count * board.pascal_per_count
        felt = curve(self._pressure, flaws.tactile_exponent, full_scale, flaws.tactile_fold)
        signal = felt * self._sensitivity  # counts
        signal *= np.maximum(1.0 + self._warmer, 0.0)
        if faults is not None:
            faults.apply(signal, board.full_count, t)
        rows, cols = np.zeros((self.grid.rows, 1)), np.zeros(self.grid.cols)
        if flaws.tactile_crosstalk > 0.0:
            # The cells of a resistive matrix share drive lines and sense lines, and current leaks
            # along these lines.
            rows += flaws.tactile_crosstalk * signal.mean(axis=1, keepdims=True)
            cols += flaws.tactile_crosstalk * signal.mean(axis=0)
        if flaws.tactile_row_noise > 0.0:
            deviation = flaws.tactile_row_noise / board.pascal_per_count
            rows += self._generator.normal(0.0, deviation, rows.shape)
        signal += self._offset
        signal += rows
        signal += cols
        if flaws.tactile_noise > 0.0:
            deviation = flaws.tactile_noise / board.pascal_per_count
            signal += deviation * self._generator.standard_normal(signal.shape)
        count(signal, self.active, (board.threshold, board.full_count), out)


# --- effects of a soft, resistive sensor ---------------------------------------------------------


def hysteresis(pressure: FloatArray, excess: float, state: FloatArray) -> None:
    """Apply hysteresis, which makes cells read higher during unloading than during loading.

    The hysteresis is described by a Prandtl-Ishlinskii model. The output of a cell is the mean of
    PLAY_COUNT generalised play operators, whose states are ``state`` [PLAY_COUNT, rows, cols]. At
    the pressure p, the state of operator k is limited to the range from p to (1 + h_k) p. The
    widths h_k are evenly spaced between 0 and 2·excess. Therefore, the output is p during loading
    and at most (1 + excess) p during unloading. Hysteresis loops are closed, and smaller loops lie
    inside larger loops. A cell without pressure always reads 0.
    """
    widths = 2.0 * excess * (np.arange(PLAY_COUNT) + 0.5) / PLAY_COUNT
    np.minimum(state, (1.0 + widths)[:, None, None] * pressure, out=state)
    np.maximum(state, pressure, out=state)
    state.mean(axis=0, out=pressure)


def lag(pressure: FloatArray, time: float, elapsed: float, state: FloatArray) -> FloatArray:
    """Apply a first-order lag, dz/dt = (p − z)/time, to each cell's pressure p and return z.

    The sum p + share · z models the creep of a standard linear solid. The solution is exact for a
    pressure that changes linearly during ``elapsed`` [s]. The function updates ``state`` [2, rows,
    cols], which contains the last p and z.
    """
    before = state[0]
    lagged: FloatArray = state[1]
    ratio = elapsed / time
    decay = math.exp(-ratio)
    # Mean decay factor over the interval. For a short interval, the mean is 1 − r/2 + …, where r is
    # `ratio`.
    mean = -math.expm1(-ratio) / ratio if ratio > 0.0 else 1.0
    lagged *= decay
    lagged += (mean - decay) * before + (1.0 - mean) * pressure
    before[:] = pressure
    return lagged


def curve(pressure: FloatArray, exponent: float, full_scale: float, fold: float) -> FloatArray:
    """Return the readings (p/full_scale)^exponent · full_scale for pressures p.

    If ``fold`` [Pa] is above 0, each pressure p above ``fold`` is replaced by fold²/p. Beyond the
    range of the contact resistance, a cell's reading decreases as the pressure increases.
    """
    if fold > 0.0:
        pressure = np.minimum(pressure, fold * fold / np.maximum(pressure, fold))
    if exponent != 1.0:
        pressure = full_scale * (pressure / full_scale) ** exponent
    return pressure


def drift(
    value: FloatArray, deviation: float, time: float, elapsed: float, normals: FloatArray
) -> None:
    """Advance a zero drift or gain drift, modelled as an Ornstein-Uhlenbeck process.

    ``value`` starts at 0 after a tare. ``value`` has the correlation time ``time`` [s], and its
    standard deviation approaches ``deviation``. ``normals`` contains standard normal random
    numbers.
    """
    decay = math.exp(-elapsed / time)
    value *= decay
    value += deviation * math.sqrt(1.0 - decay * decay) * normals


def count(
    signal: FloatArray, active: NDArray[np.bool_], ends: tuple[int, int], out: NDArray[np.uint16]
) -> None:
    """Round a signal to counts and store the counts in ``out``; inactive cells read 0.

    ``ends`` contains a threshold and the maximum count. Counts below the threshold are set to 0.
    """
    lowest, full = ends
    value = np.clip(signal + 0.5, 0.0, full + 0.5)
    value[~active | (value < lowest)] = 0.0
    out[:] = value  # The assignment truncates to integers.
