"""The estimator's memory, with names: options, one frame, the estimate, a step of the fit, scratch.

What depends on the grid's size stands in one array of floats, the scratch; `Offsets` says where.
"""

from __future__ import annotations

from typing import Annotated, TypeAlias

from softfinger.kinematics.compiled.layout import Record, Records
from softfinger.kinematics.sensing.footprint import Face, FloatArray, Grid, IntArray

# Planes of the packed cells of a footprint: the fraction of a cell that lies in it, over that
# fraction the means of g, x g, y g (g = 1/√(a² − x² − y²)) and the strain's variance; reading and
# weight.
FRACTION, PLAIN, ALONG_X, ALONG_Y, VARIANCE, READING, WEIGHT = range(7)
PLANES = 7

LEVELS = 3  # how near the rim a cut cell is
STRIPS = 264  # of cut cells integrated at once, of each level
OWNERS = 128  # cut cells at once, of each level
OUTLIERS_MAX = 6  # left out of one frame
RATIO_POINTS = 33
LAW_TERMS = 12
# Images of shared errors: a shift of all cells, its slopes in x and y, the tip's place in x and y,
# and the pitch.
SHIFT, SLOPE_X, SLOPE_Y, PLACE_X, PLACE_Y, SCALING = range(6)
SOURCES = 6
DEPTHS = 12  # at which the covariance under correlated noise is tabulated

Four: TypeAlias = Annotated[FloatArray, 4]
Matrix: TypeAlias = Annotated[FloatArray, 4, 4]
Strip: TypeAlias = Annotated[FloatArray, STRIPS]


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


class Law(Record):
    """The material's σ(ε), a polynomial."""

    polynomial: Annotated[FloatArray, LAW_TERMS]  # lowest first
    bent: bool  # curved, so that the strain's variance counts


class Region(Record):
    """Cells that a contact can press: the flat range of their rows, and their number."""

    first: int
    last: int
    number: int


class Signal(Record):
    """One frame: its unit, noise and limits, and what the activity test finds."""

    scale: float  # Pa a count
    variance: float  # of a cell [Pa²]
    noise: float  # of a cell [counts]
    confined: float  # upper limit of a contact as wide as a cell [counts]
    patch_level: float
    saturation: float  # [Pa]
    floor: float  # [Pa]; −inf for none
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
    ratios: Annotated[FloatArray, RATIO_POINTS, 3]  # to a constant modulus, over d
    face: Face


class Sums(Record):
    """Sums over the cells for one step, columns of the Jacobian by (gain, u, v, w)."""

    normal: Annotated[FloatArray, 10]  # upper triangle of JᵀWJ by rows
    right: Four  # JᵀWr
    misfit: float  # rᵀWr
    readings: float  # yᵀWy
    weight: float  # ΣW


class Fit(Record):
    """Gauss-Newton at one face and gain."""

    face: Face
    gain: float
    clip: float  # noise of cells that end at the floor [Pa]; 0 where none do
    decrement: float  # fall of the sum of squares that the step promises
    count: int  # packed cells
    sums: Sums
    step: Four  # in (gain, u, v, w), as the matrices
    right: Four
    scale: Four
    matrix: Matrix
    lower: Matrix
    inverse: Matrix
    covariance: Matrix  # of (d, n_x, n_y, gain)


class Budget(Record):
    """Errors beside single cells' noise, see `error_budget`, and scratch for them."""

    baseline: float  # standard deviations: of a shift of all cells [Pa]
    shift: float  # the same, and of the pressed ones by the law's misfit
    slope: float  # of the zero, at the radius [Pa]
    centre: float  # of the tip's place [m]
    pitch: float  # relative
    modulus: float  # of modulus and gain, relative; 0 with a free gain
    smooth: float  # of pressure, relative
    rotation: float  # of the sensor [rad]
    radius: float  # relative
    skew: float  # of the face over a scan of all rows, in w [–]
    along: float  # correlation of neighbours in a row
    cells_per_sample: float  # Σρ²: cells for each that is independent
    systematic: bool  # any of those but the correlation
    correlated: bool
    variance_factor: Annotated[FloatArray, DEPTHS, 4, 4]
    work: Matrix
    responses: Annotated[FloatArray, 4, SOURCES]  # Jᵀq
    squares: Annotated[FloatArray, SOURCES]  # qᵀq
    displacement: Four
    shared: Matrix  # covariance by what all frames share, of (gain, u, v, w)
    covariance: Matrix  # the same of (d, n_x, n_y, gain)


class Strips(Record):
    """Strips of cut cells that wait to be integrated side by side."""

    start: Strip  # lower end in y
    length: Strip
    cell_x: Strip  # the cell's left side
    side: Strip  # 1 where the rim is on the cell's left, else 0
    left: Strip  # of the line at work
    width: Strip
    area: Strip
    sum_g: Strip
    sum_x: Strip
    sum_y: Strip
    sum_square: Strip
    count: int
    owners: int  # cells that they belong to
    indices: Annotated[IntArray, OWNERS]  # of these among the packed cells
    ends: Annotated[IntArray, OWNERS]  # of their strips


class Blur(Record):
    """Model of a blurred grid: pieces of cells, blurred by weights."""

    pieces_x: int  # of a cell
    pieces_y: int
    weights_x: int
    weights_y: int


class Offsets(Record):
    """Offsets of the arrays in the scratch."""

    centres: int  # planes of cell_centres [3, cells]
    cells: int  # planes of cell_integrals [rows, CELL_PLANES, cols]
    columns: int  # spans on the lines between columns, [2, cols + 1]
    lines: int  # and on those between rows
    packed: int  # [PLANES, cells]
    pieces: int  # planes of the pieces of cells; the following ones are for a blur alone
    across: int  # weights [n]
    along: int
    fine: int  # [rows, cols] of pieces
    half: int  # [cols]


class EstimatorState(Record):
    """All of it."""

    options: Options
    law: Law
    grid: Grid
    model: Grid  # what is modelled: the grid, or its pieces with a blur
    region: Region
    signal: Signal
    estimate: Estimate
    moments: Moments
    fit: Fit
    budget: Budget
    strips: Annotated[Records[Strips], LEVELS]
    around: Face  # a little beyond the footprint
    outliers: Annotated[IntArray, OUTLIERS_MAX]  # cells
    blur: Blur
    at: Offsets
