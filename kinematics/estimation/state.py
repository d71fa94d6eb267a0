"""Record types of the estimator's state: options, frame, estimate, fit and cells."""

from __future__ import annotations

from typing import Annotated, NamedTuple, TypeAlias

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.layout import Pair, Record
from softfinger.kinematics.sensing.footprint import Face, FloatArray, Grid, IntArray
from softfinger.kinematics.sensing.solid_pressure import Weights
from softfinger.kinematics.sensing.springs_pressure import SpringPoints

OUTLIERS_MAX = 6  # largest number of outliers excluded from a frame
# Parameters of the fit; only solid tips have the last two.
GAIN, DEPTH, TILT_X, TILT_Y, SHEAR_X, SHEAR_Y = range(6)
PARAMETERS = 6
START_POINTS = 17  # depths in the table for the initial estimate
DEPTHS = 12  # depths in the table of the effect of correlated noise
# Patterns of common errors: a shift of all cells, its slopes in x and y, the tip's position in x
# and y, the pitch, and the pressure itself.
SHIFT, SLOPE_X, SLOPE_Y, PLACE_X, PLACE_Y, SCALING, PRESSURE = range(7)
SOURCES = 7

Matrix: TypeAlias = Annotated[FloatArray, 4, 4]
Column: TypeAlias = Annotated[FloatArray, PARAMETERS]
Normal: TypeAlias = Annotated[FloatArray, PARAMETERS, PARAMETERS]
Depths: TypeAlias = Annotated[FloatArray, START_POINTS]


class Options(Record):
    """Options of an estimator; see `ContactEstimator`."""

    noise: float  # standard deviation of a cell [Pa]
    undetected: float  # d of the smallest detectable contact [m]
    saturation: float  # [counts]
    floor: float  # smallest count sent, less a half
    tolerance: float
    peak_level: float  # [noise]
    patch_level: float
    r_squared_min: float
    modulus: float  # at zero strain [Pa]
    blur: float  # standard deviation [m]
    rotation: float  # of the sensor [rad]
    iterations: int
    free_gain: bool
    is_solid: bool
    deepest: float  # largest d of the model [m]
    sine_max: float  # largest sin of the tilt of the model
    step_deepest: float  # limits of d [m] and sin of the tilt for a step
    step_sine: float
    shear_prior: float  # standard deviation of the shear over the normal force


class Signal(Record):
    """One frame: its unit, noise and limits, and the result of the activity test."""

    scale: float  # Pa per count
    variance: float  # noise of a cell [Pa²]
    noise: float  # standard deviation of a cell [counts]
    narrow_contact_max: float  # largest reading of a contact as wide as a cell [counts]
    patch_level: float
    saturation: float  # [Pa]
    floor: float  # [Pa]; −inf for none
    number: int  # number of cells that a contact can press
    peak: float  # largest cell [counts]; its indices are −1 if it is below the level
    row: int
    col: int
    mean: float  # [counts]
    energy: float  # Σ p² [counts²]
    is_clipped: bool  # no cell reads below the floor
    contact: bool
    is_finite: bool


class Estimate(Record):
    """Estimate of one frame and start of the next, in the sensor's and then the finger's axes."""

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
    shear_x: float  # force on the face [N], for solid tips
    shear_y: float
    n_x: float
    n_y: float
    shear: Pair  # in the model, over the radius squared [Pa]
    residual: float  # Σ over the footprint of (reading − model)² − reading² [Pa²]
    undetected: float  # relative error of d that a smooth misfit may cause
    shared: float  # relative standard deviation of d due to the known uncertainties
    covariance: Matrix  # of (d, tilt_x, tilt_y, gain)
    systematic: Matrix  # the part common to all frames


class Moments(Record):
    """Sums over the footprint, and the contact estimated from them."""

    total: float  # Σ p
    x: float  # centroid
    y: float
    trace: float  # of the covariance
    number: float  # cells
    d: float
    n_x: float
    n_y: float
    gain: float
    # Moments of the model at the depths deepest · (k/(START_POINTS − 1))²:
    force: Depths  # Σ p, upright [Pa]
    extent: Depths  # trace of the pressure's covariance, upright [m²]
    centroid_arm: Depths  # centroid over sin of the tilt [m]


class Fit(Record):
    """Gauss-Newton step at one contact and gain."""

    face: Face
    gain: float
    d: float
    n_x: float
    n_y: float
    shear: Pair
    first_row: int  # range of cells pressed by the model
    last_row: int
    clip_noise: float  # noise of cells clipped at the floor [Pa]; 0 without clipping
    decrement: float  # predicted decrease of the sum of squares
    misfit: float  # Σ (reading − model)²
    readings: float  # Σ reading²
    counted_cells: float  # number of cells that count
    is_limited: bool  # the last step was clamped to the limits of the model
    normal: Normal  # JᵀJ
    gradient: Column  # Jᵀr
    step: Column
    scale: Column
    lower: Normal
    inverse: Normal
    covariance: Matrix  # of (d, n_x, n_y, gain)


class Budget(Record):
    """Errors other than white cell noise, and scratch arrays for them; see `error_budget`."""

    sizes: Annotated[FloatArray, SOURCES]  # standard deviations of the patterns' factors
    baseline: float  # standard deviation of a shift of all cells [Pa]
    slope: float  # standard deviation of a slope of the zeros, at the rim [Pa]
    smooth: float  # relative pressure error
    rotation: float  # of the sensor [rad]
    tilt_error: float  # relative tilt error of a solid tip over d/a
    row_correlation: float  # correlation of neighbours in a row
    cells_per_sample: float  # Σρ², cells per independent noise sample
    has_common_errors: bool  # True if any error other than the correlation is set
    is_correlated: bool
    widening: Annotated[FloatArray, DEPTHS, 5]  # factors of the standard deviations, used-up cells
    responses: Annotated[FloatArray, PARAMETERS, SOURCES]  # Jᵀq
    squares: Annotated[FloatArray, SOURCES]  # qᵀq
    displacement: Column
    shared: Normal  # covariance due to common errors
    covariance: Matrix  # the same of (d, n_x, n_y, gain)


class EstimatorState(Record):
    """Complete state of an estimator except its cell arrays."""

    options: Options
    grid: Grid  # the part of the sensor that a contact can press
    signal: Signal
    estimate: Estimate
    moments: Moments
    fit: Fit
    budget: Budget
    around: Face  # widened footprint
    outliers: Annotated[IntArray, OUTLIERS_MAX]  # cells


class Cells(NamedTuple):
    """Arrays over the cells of `EstimatorState.grid`, float64 [cells].

    ``planes`` [4, rows, cols] holds ``stress`` to ``by_y`` in one array: the modelled pressure at a
    gain of 1 and its partials.
    """

    planes: FloatArray
    stress: FloatArray
    by_d: FloatArray
    by_x: FloatArray
    by_y: FloatArray
    height: FloatArray  # √(a² − x² − y²) [m], see `cell_centres`; negative for unused cells
    x: FloatArray  # centre of the cell [m]
    y: FloatArray
    pattern: FloatArray  # for the detection of a solid tip's contact
    model: FloatArray  # pressure [Pa] with gain and shear
    residual: FloatArray  # reading − model [Pa], 0 for cells that do not count
    factor: FloatArray  # sensitivity of the reading to pressure, likewise


STRESS, BY_D, BY_X, BY_Y, HEIGHT, X, Y, PATTERN, MODEL, RESIDUAL, FACTOR = range(11)  # row indices
ROWS = 11


@inner_kernel
def cells_in(rows: FloatArray, grid: Grid) -> Cells:
    """Return the cell arrays stored in ``rows`` [ROWS, cells]."""
    planes = rows[:HEIGHT].reshape((HEIGHT, grid.rows, grid.cols))
    return Cells(
        planes, rows[STRESS], rows[BY_D], rows[BY_X], rows[BY_Y], rows[HEIGHT], rows[X], rows[Y],
        rows[PATTERN], rows[MODEL], rows[RESIDUAL], rows[FACTOR],
    )  # fmt: skip


class Images(NamedTuple):
    """Images of a solid tip on `EstimatorState.grid`, and their weights."""

    pixels: FloatArray  # [images · cells]; the last two images are those of shear
    weights: Weights


class Model(NamedTuple):
    """Forward model: points for springs or images for solid rubber; the other one is empty."""

    points: SpringPoints
    images: Images
