"""The estimator's memory, with names: options, one frame, estimate, a step of the fit, cells."""

from __future__ import annotations

from typing import Annotated, NamedTuple, TypeAlias

from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.layout import Pair, Record
from softfinger.kinematics.sensing.footprint import Face, FloatArray, Grid, IntArray
from softfinger.kinematics.sensing.solid_pressure import Weights
from softfinger.kinematics.sensing.springs_pressure import SpringPoints

OUTLIERS_MAX = 6  # left out of one frame
# Parameters of the fit; shear, the last two, is a solid tip's alone.
GAIN, DEPTH, TILT_X, TILT_Y, SHEAR_X, SHEAR_Y = range(6)
PARAMETERS = 6
START_POINTS = 17  # depths of the table from which a fit starts
DEPTHS = 12  # at which the effect of correlated noise is tabulated
# Patterns of shared errors: a shift of all cells, its slopes in x and y, the tip's place in x and
# y, the pitch, and the pressure itself.
SHIFT, SLOPE_X, SLOPE_Y, PLACE_X, PLACE_Y, SCALING, PRESSURE = range(7)
SOURCES = 7

Matrix: TypeAlias = Annotated[FloatArray, 4, 4]
Column: TypeAlias = Annotated[FloatArray, PARAMETERS]
Normal: TypeAlias = Annotated[FloatArray, PARAMETERS, PARAMETERS]
Depths: TypeAlias = Annotated[FloatArray, START_POINTS]


class Options(Record):
    """Constants of one estimator; see `ContactEstimator`."""

    noise: float  # of a cell [Pa]
    undetected: float  # d [m] of a contact that is only just felt
    saturation: float  # [counts]
    floor: float  # least count sent, less a half
    tolerance: float
    peak_level: float  # [noise]
    patch_level: float
    r_squared_min: float
    modulus: float  # at no strain [Pa]
    blur: float  # standard deviation [m]
    rotation: float  # of the sensor [rad]
    iterations: int
    free_gain: bool
    is_solid: bool
    deepest: float  # d that the model holds [m]
    sine_max: float  # sin of the tilt that it holds
    step_deepest: float  # d and sin of the tilt that a step may go to
    step_sine: float
    shear_prior: float  # standard deviation of shear over the normal force


class Signal(Record):
    """One frame: its unit, noise and limits, and what the activity test finds."""

    scale: float  # Pa a count
    variance: float  # of a cell [Pa²]
    noise: float  # of a cell [counts]
    confined: float  # upper limit of a contact as wide as a cell [counts]
    patch_level: float
    saturation: float  # [Pa]
    floor: float  # [Pa]; −inf for none
    number: int  # cells that a contact can press
    peak: float  # largest cell [counts], and its indices, −1 for none above the level
    row: int
    col: int
    mean: float  # [counts]
    energy: float  # Σ p² [counts²]
    clipped: bool  # no cell reads below the floor
    contact: bool
    finite: bool


class Estimate(Record):
    """Estimate of one frame and start of the next: in the sensor's axes, then the finger's."""

    d: float
    gain: float
    chi2: float
    tilt_x: float
    tilt_y: float
    r_squared: float
    peak: float  # [Pa]
    cells: int
    iterations: int
    rejected: int
    contact: bool
    invalid: int  # an `Invalid`
    second: bool
    warm: bool
    shear_x: float  # force on the face [N], of a solid tip
    shear_y: float
    n_x: float
    n_y: float
    shear: Pair  # of the model, over the radius squared [Pa]
    residual: float  # Σ over the footprint of (reading − model)² − reading² [Pa²]
    undetected: float  # what a smooth misfit may hide of d, over d
    shared: float  # standard deviation of d by the known uncertainties, over d
    covariance: Matrix  # of (d, tilt_x, tilt_y, gain)
    systematic: Matrix  # the part of it that all frames share


class Moments(Record):
    """Sums over the footprint, and the contact that they make."""

    total: float  # Σ p
    x: float  # centroid
    y: float
    trace: float  # of the covariance
    number: float  # cells
    d: float
    n_x: float
    n_y: float
    gain: float
    # Of the model, over the depths deepest · (k/(START_POINTS − 1))²:
    force: Depths  # Σ p, upright [Pa]
    extent: Depths  # trace of the pressure's covariance, upright [m²]
    lever: Depths  # centroid over sin of the tilt [m]


class Fit(Record):
    """Gauss-Newton at one contact and gain."""

    face: Face
    gain: float
    d: float
    n_x: float
    n_y: float
    shear: Pair
    first_row: int  # of cells that the model presses
    last_row: int
    clip: float  # noise of cells that end at the floor [Pa]; 0 where none do
    decrement: float  # fall of the sum of squares that the step promises
    misfit: float  # Σ (reading − model)²
    readings: float  # Σ reading²
    weight: float  # cells that count
    limited: bool  # the last step ended where the model does
    normal: Normal  # JᵀJ
    right: Column  # Jᵀr
    step: Column
    scale: Column
    lower: Normal
    inverse: Normal
    covariance: Matrix  # of (d, n_x, n_y, gain)


class Budget(Record):
    """Errors beside single cells' noise, see `error_budget`, and scratch for them."""

    sizes: Annotated[FloatArray, SOURCES]  # standard deviations of the patterns' factors
    baseline: float  # standard deviation of a shift of all cells [Pa]
    slope: float  # of the zero, at the radius [Pa]
    smooth: float  # of pressure, relative
    rotation: float  # of the sensor [rad]
    lean: float  # of a solid tip's tilt, relative, over d/a
    along: float  # correlation of neighbours in a row
    cells_per_sample: float  # Σρ²: cells for each that is independent
    systematic: bool  # any of those but the correlation
    correlated: bool
    widening: Annotated[FloatArray, DEPTHS, 5]  # standard deviations' factors; lost cells
    responses: Annotated[FloatArray, PARAMETERS, SOURCES]  # Jᵀq
    squares: Annotated[FloatArray, SOURCES]  # qᵀq
    displacement: Column
    shared: Normal  # covariance by what all frames share
    covariance: Matrix  # the same of (d, n_x, n_y, gain)


class EstimatorState(Record):
    """All of it, but the arrays."""

    options: Options
    grid: Grid  # the part of the sensor's that a contact can press
    signal: Signal
    estimate: Estimate
    moments: Moments
    fit: Fit
    budget: Budget
    around: Face  # a little beyond the footprint
    outliers: Annotated[IntArray, OUTLIERS_MAX]  # cells


class Cells(NamedTuple):
    """Arrays of the cells of `EstimatorState.grid`, one after the other, float64 [cells].

    ``planes`` [4, rows, cols] are ``stress`` to ``by_y`` in one: the model's pressure at a gain of
    1, and its partials.
    """

    planes: FloatArray
    stress: FloatArray
    by_d: FloatArray
    by_x: FloatArray
    by_y: FloatArray
    height: FloatArray  # √(a² − x² − y²) [m], see `cell_centres`; below 0 for a cell not to be used
    x: FloatArray  # of the centre [m]
    y: FloatArray
    pattern: FloatArray  # by which a solid tip's contact is noticed
    model: FloatArray  # pressure [Pa], gain and shear in it
    residual: FloatArray  # reading − model [Pa], 0 for cells that do not count
    factor: FloatArray  # how far a reading answers to pressure, likewise


STRESS, BY_D, BY_X, BY_Y, HEIGHT, X, Y, PATTERN, MODEL, RESIDUAL, FACTOR = range(11)  # rows of them
ROWS = 11


@inner_kernel
def cells_in(rows: FloatArray, grid: Grid) -> Cells:
    """Return the cells whose arrays are ``rows`` [ROWS, cells]."""
    planes = rows[:HEIGHT].reshape((HEIGHT, grid.rows, grid.cols))
    return Cells(
        planes, rows[STRESS], rows[BY_D], rows[BY_X], rows[BY_Y], rows[HEIGHT], rows[X], rows[Y],
        rows[PATTERN], rows[MODEL], rows[RESIDUAL], rows[FACTOR],
    )  # fmt: skip


class Images(NamedTuple):
    """A solid tip's images of `EstimatorState.grid`, one after the other, and their weights."""

    pixels: FloatArray  # [images · cells], shear's two last
    weights: Weights


class Model(NamedTuple):
    """The forward model: of springs by points, of solid rubber by images; the other is empty."""

    points: SpringPoints
    images: Images
