"""Record types for the estimator state: options, frame, estimate, fit and cells."""

from __future__ import annotations

from typing import Annotated, NamedTuple, TypeAlias

import numpy as np

from softfinger.kinematics.compiled.layout import FloatArray, Record
from softfinger.kinematics.sensing.footprint import Face, Grid
from softfinger.kinematics.sensing.solid_pressure import Weights
from softfinger.kinematics.sensing.springs_pressure import SpringPoints

# Fit parameters. The last two parameters apply only to solid tips.
GAIN, DEPTH, TILT_X, TILT_Y, SHEAR_X, SHEAR_Y = range(6)
PARAMETERS = 6
START_POINTS = 17  # number of depths in the table for the initial estimate
DEPTHS = 12  # number of depths in the table for the effects of correlated noise
SOURCES = 7  # number of patterns of common errors, see `error_budget`

Matrix: TypeAlias = Annotated[FloatArray, 4, 4]
Column: TypeAlias = Annotated[FloatArray, PARAMETERS]
Normal: TypeAlias = Annotated[FloatArray, PARAMETERS, PARAMETERS]
Depths: TypeAlias = Annotated[FloatArray, START_POINTS]


class Options(Record):
    """Options of an estimator; see `ContactEstimator`."""

    noise: float  # standard deviation of a cell [Pa]
    undetected: float  # d of the smallest detectable contact [m]
    floor: float  # smallest count that the board sends, minus one half
    tolerance: float
    patch_level: float  # [noise standard deviations]
    modulus: float  # at zero strain [Pa]
    blur: float  # standard deviation [m]
    rotation: float  # rotation of the sensor [rad]
    number: int  # number of cells that a contact can load
    free_gain: bool
    is_solid: bool
    deepest: float  # maximum d of the model [m]
    sine_max: float  # sine of the model's maximum tilt


class Signal(Record):
    """Unit, noise and limits of one frame, and the result of the activity test."""

    scale: float  # Pa per count
    variance: float  # noise variance of a cell [Pa²]
    noise: float  # standard deviation of a cell [counts]
    narrow_contact_max: float  # maximum reading of a contact that is as wide as a cell [counts]
    patch_level: float
    saturation: float  # [Pa]
    floor: float  # [Pa]; −inf without a floor
    number: int  # number of cells that a contact can load, excluding outliers
    peak: float  # largest reading [counts]
    cell: int  # cell of the peak, or −1 if the peak is below the level
    mean: float  # [counts]
    energy: float  # Σ p² [Pa²]
    is_clipped: bool  # True if readings are clipped at the floor
    contact: bool
    is_finite: bool


class Estimate(Record):
    """Estimate for one frame in finger axes, and the next initial guess in sensor axes."""

    d: float
    gain: float
    chi2: float
    tilt_x: float
    tilt_y: float
    r_squared: float
    peak: float  # [Pa]
    cells: int
    iterations: int
    rejected_count: int
    contact: bool
    invalid: int  # an `Invalid`
    has_second_contact: bool
    has_last_contact: bool
    shear_x: float  # force on the face of a solid tip [N]
    shear_y: float
    guess: Column  # fit parameters of the last fit, or of the initial estimate
    residual: float  # sum of (reading − model)² − reading² over the footprint [Pa²]
    undetected: float  # relative error of d that a smooth misfit may cause
    shared: float  # relative standard deviation of d due to known errors
    covariance: Matrix  # covariance of (d, tilt_x, tilt_y, gain)
    systematic: Matrix  # part of the covariance due to errors that all frames share


class Moments(Record):
    """Moments of the selected cells, and a table of the model's moments."""

    total: float  # Σ p
    x: float  # centroid
    y: float
    trace: float  # trace of the pressure's covariance
    number: float  # number of cells
    # Moments of the model at the depths deepest · (k/(START_POINTS − 1))².
    force: Depths  # Σ p for an upright tip [Pa]
    extent: Depths  # trace of the spatial covariance of the pressure for an upright tip [m²]
    centroid_arm: Depths  # centroid divided by the sine of the tilt [m]


class Fit(Record):
    """Gauss-Newton step for one contact and gain."""

    face: Face
    contact: Column  # gain, d [m], n_x, n_y in sensor axes, shear force divided by a² [Pa]
    previous: Column  # contact before the last step
    first_cell: int  # range of cells that are under pressure in the model
    last_cell: int
    clip_noise: float  # noise of cells that are clipped at the floor, or 0 without clipping [Pa]
    decrement: float  # predicted decrease of the sum of squares
    misfit: float  # Σ (reading − model)²
    readings: float  # Σ reading²
    counted_cells: float  # number of cells in the fit
    is_limited: bool  # True if the last step was clamped to the limits of the model
    normal: Normal  # JᵀJ
    gradient: Column  # Jᵀr
    step: Column
    scale: Column
    inverse: Normal
    variance: float  # factor that converts ``inverse`` to the noise covariance [Pa²]
    widening: float  # factor that converts `Budget.shared` to the covariance of other errors
    to_results: Matrix  # partials of (d, tilt_x, tilt_y, gain) with respect to the fit parameters


class Budget(Record):
    """Errors other than white cell noise, with scratch arrays; see `error_budget`."""

    sizes: Annotated[FloatArray, SOURCES]  # standard deviations of the pattern factors
    baseline: float  # standard deviation of a shift of all cells [Pa]
    slope: float  # standard deviation of the zero-offset slope, measured at the rim [Pa]
    smooth: float  # relative pressure error
    rotation: float  # rotation of the sensor [rad]
    tilt_error: float  # relative tilt error of a solid tip, divided by d/a
    row_correlation: float  # correlation of neighbouring cells in a row
    cells_per_sample: float  # Σρ², the number of cells per independent noise sample
    has_common_errors: bool  # True if there are errors other than correlated noise
    is_correlated: bool
    # Factors that widen the four standard deviations, and the number of degrees of freedom used.
    widening: Annotated[FloatArray, DEPTHS, 5]
    response: Column  # Jᵀq, multiplied by the size of the pattern q
    displacement: Column  # change in the fit parameters due to one pattern
    shared: Normal  # covariance of the fit parameters due to common errors and a smooth misfit


class EstimatorState(Record):
    """Complete state of an estimator except for its cell arrays."""

    options: Options
    grid: Grid  # cells that a contact can load
    signal: Signal
    estimate: Estimate
    moments: Moments
    fit: Fit
    budget: Budget
    around: Face  # widened footprint


class Cells(NamedTuple):
    """Float64 arrays [cells] or [·, cells], with one column per cell of `EstimatorState.grid`."""

    sensitivity: FloatArray  # pressure at a gain of 1, ∂/∂parameters, shear images [PARAMETERS, ·]
    planes: FloatArray  # the first four rows of ``sensitivity``, [4, rows, cols]
    reach: FloatArray  # √(a² − x² − y²), negative for unused cells [m]
    x: FloatArray  # cell centre [m]
    y: FloatArray
    height: FloatArray  # like ``reach``, but negative for outliers in the frame
    pattern: FloatArray  # pattern for detecting the contact of a solid tip
    model: FloatArray  # modelled pressure including gain and shear [Pa]
    residual: FloatArray  # reading − model, or 0 for cells excluded from the fit [Pa]
    factor: FloatArray  # sensitivity of the reading to pressure, or 0 for excluded cells
    jacobian: FloatArray  # partials of the readings with respect to the parameters [PARAMETERS, ·]
    errors: FloatArray  # patterns of the common errors [SOURCES, ·]


def new_cells(rows: int, cols: int) -> Cells:
    """Create the arrays of a grid with rows × cols cells, filled with zeros."""
    count = rows * cols
    sensitivity = np.zeros((PARAMETERS, count))
    planes = sensitivity[:SHEAR_X].reshape(SHEAR_X, rows, cols)
    vectors = (np.zeros(count) for _ in range(8))
    jacobian, errors = np.zeros((PARAMETERS, count)), np.zeros((SOURCES, count))
    return Cells._make([sensitivity, planes, *vectors, jacobian, errors])


class Model(NamedTuple):
    """Forward model: points for springs, or images and their weights for solid rubber."""

    points: SpringPoints
    pixels: FloatArray  # images of a solid tip on `EstimatorState.grid`, see `solid_pressure`
    weights: Weights
