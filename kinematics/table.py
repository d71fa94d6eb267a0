"""Contact tables: force, energy and their partials by lookup, to a proven tolerance.

Holds the lookup kernel and the table as an object and as bytes; how one is built and certified is
in `table_build`. A table is one flat float64 array, header and coefficients, which is the kernel's
argument and the file's content alike.

What is tabulated is the ratio of each quantity to its closed form for the modulus at zero strain:
smooth, near 1, finite at d → 0, and exact for a constant modulus. The coordinates make it analytic
up to the edges of the domain: the height h = (a − d)/a, in pieces that divide each octave evenly,
and y = u/h with u = √(1 − ρ²/(a² cos² θ)), which is 1 at θ = 0, 0 at the limit, even in θ, and the
peak strain is 1 − u. Towards h = 0 the ratios are A + B log h with smooth A and B; below the lowest
octave both are tabulated.
"""

from __future__ import annotations

import hashlib
import math
import os
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinematics.contact import Fingertip, closed_form, flatten, theta_limit
from kinematics.kernels import kernel, source_digest
from kinematics.lanes import SQUARE, TRIANGLE, patch
from kinematics.material import Material

FloatArray = NDArray[np.float64]

HALF_PI = math.pi / 2

# Header of a table's array, by index.
FORMAT, FORM, RADIUS, MODULUS, INVERSE_RADIUS = 0, 1, 2, 3, 4
LOWEST, SHIFT, FIRST, H_PIECES, Y_PIECES = 5, 6, 7, 8, 9
PIECES, SIZE, START, CORNER = 10, 11, 12, 13
TOLERANCE, MAX_ERROR, WORST_D, WORST_THETA = 14, 15, 16, 17
HEADER = 24  # a whole number of vector registers, so that coefficients stay aligned

VERSION = 1.0

# The corner h → 0: pieces over y, and terms in h and y of A and B in each; the same for all forms.
CORNER_PIECES = 2
CORNER_TERMS = (9, 16)
CORNER_SIZE = 10 * CORNER_TERMS[0] * CORNER_TERMS[1]

# Forms by number: degree and shape of the local polynomials. 0 is the closed form.
CLOSED = 0
FORMS = (
    (0, TRIANGLE),
    (1, SQUARE),
    (3, SQUARE),
    (5, TRIANGLE),
    (7, TRIANGLE),
    (9, TRIANGLE),
    (12, TRIANGLE),
    (14, TRIANGLE),
)


class TableError(Exception):
    """A table can't be built to the tolerance, or a file holds no sound table of this kind."""


@kernel
def _evaluate(
    data: FloatArray, form: int, at: int, x: float, y: float
) -> tuple[float, float, float, float, float]:
    """The five ratios of one patch. The degrees are literals, as FORMS says."""
    if form == 5:
        return patch(data, at, 9, 0, x, y)
    if form == 6:
        return patch(data, at, 12, 0, x, y)
    if form == 3:
        return patch(data, at, 5, 0, x, y)
    if form == 4:
        return patch(data, at, 7, 0, x, y)
    if form == 7:
        return patch(data, at, 14, 0, x, y)
    if form == 2:
        return patch(data, at, 3, 1, x, y)
    return patch(data, at, 1, 1, x, y)


@kernel
def _evaluate_corner(
    data: FloatArray, h: float, y: float
) -> tuple[float, float, float, float, float]:
    """The five ratios A + B log h below the lowest octave; slower, since no hand works there."""
    j = min(int(y * CORNER_PIECES), CORNER_PIECES - 1)
    y = 2.0 * (y * CORNER_PIECES - j) - 1.0
    x = 2.0 * h / data[LOWEST] - 1.0
    # At h = 0 the logarithm's factors vanish, or θ and with it the partial does.
    scale = math.log(max(h, 1e-300))
    rows, columns = CORNER_TERMS
    at = int(data[CORNER]) + j * CORNER_SIZE
    r0 = 0.0
    r1 = 0.0
    r2 = 0.0
    r3 = 0.0
    r4 = 0.0
    for _ in range(rows):
        q0 = 0.0
        q1 = 0.0
        q2 = 0.0
        q3 = 0.0
        q4 = 0.0
        for _ in range(columns):
            q0 = q0 * y + (data[at] + scale * data[at + 5])
            q1 = q1 * y + (data[at + 1] + scale * data[at + 6])
            q2 = q2 * y + (data[at + 2] + scale * data[at + 7])
            q3 = q3 * y + (data[at + 3] + scale * data[at + 8])
            q4 = q4 * y + (data[at + 4] + scale * data[at + 9])
            at += 10
        r0 = r0 * x + q0
        r1 = r1 * x + q1
        r2 = r2 * x + q2
        r3 = r3 * x + q3
        r4 = r4 * x + q4
    return r0, r1, r2, r3, r4


@kernel
def lookup(
    data: FloatArray, d: float, theta: float
) -> tuple[float, float, float, float, float, float, bool]:
    """(F, U, ∂F/∂d, ∂F/∂θ, ∂U/∂d, ∂U/∂θ, inside) at displacement d [m] and tilt θ [rad].

    Zeros for d ≤ 0. Outside the domain d and θ are clamped to it and ``inside`` is False; NaN in
    gives NaN out.
    """
    radius = data[RADIUS]
    inside = True
    limited = False
    c = math.cos(theta)
    rho2 = d * (radius - d + radius) * data[INVERSE_RADIUS] * data[INVERSE_RADIUS]
    inverse = 1.0 / c
    g = rho2 * inverse * inverse
    if not (d > 0.0 and g <= 1.0 and d <= radius and abs(theta) <= HALF_PI):
        if math.isnan(d) or math.isnan(theta):
            nan = math.nan
            return nan, nan, nan, nan, nan, nan, False
        if d <= 0.0:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, True
        inside = d <= radius
        d = min(d, radius)
        limit = theta_limit(radius, d)
        # Rounding alone may put g above 1 within the limit.
        limited = True
        inside = inside and abs(theta) <= limit
        theta = min(max(theta, -limit), limit)
        c = math.cos(theta)
        inverse = 1.0 / c
        g = min(d * (radius - d + radius) * (inverse / radius) ** 2, 1.0)
    slope = math.sin(theta) * inverse
    force_d = 2.0 * math.pi * data[MODULUS] * d * inverse
    force = 0.5 * d * force_d
    energy = force * inverse * d * (1.0 / 3.0)
    form = int(data[FORM])
    if form == CLOSED:
        return (
            force,
            energy,
            force_d,
            force * slope,
            force * inverse,
            2.0 * energy * slope,
            inside,
        )
    h = (radius - d) * data[INVERSE_RADIUS]
    count = int(data[Y_PIECES])
    size = int(data[SIZE])
    if h >= data[LOWEST]:
        i = (np.float64(h).view(np.int64) >> int(data[SHIFT])) - int(data[FIRST])
        i = min(i, int(data[H_PIECES]) - 1)
        x = (h - data[HEADER + 2 * i]) * data[HEADER + 2 * i + 1]
        y = math.sqrt(1.0 - g) / h * count
        j = min(int(y), count - 1)
        at = int(data[START]) + (i * count + j) * size
        r_f, r_u, r_fd, r_ft, r_ut = _evaluate(data, form, at, x, 2.0 * (y - j) - 1.0)
    else:
        s = abs(math.sin(theta))
        y = math.sqrt((h - s) * (h + s)) / (c * h) if h > s else 0.0
        r_f, r_u, r_fd, r_ft, r_ut = _evaluate_corner(data, h, y)
    force_theta = force * slope * r_ft
    force *= r_f
    return (
        force,
        energy * r_u,
        force_d * r_fd,
        force_theta,
        force * inverse,
        2.0 * energy * slope * r_ut,
        inside,
    )


@kernel
def lookups(
    data: FloatArray,
    d: FloatArray,
    theta: FloatArray,
    out: FloatArray,
    inside: NDArray[np.bool_],
) -> None:
    """:func:`lookup` at each of d and θ [n] into ``out`` [6, n] and ``inside`` [n]."""
    for i in range(d.shape[0]):
        (out[0, i], out[1, i], out[2, i], out[3, i], out[4, i], out[5, i], inside[i]) = lookup(
            data, d[i], theta[i]
        )


class Contact(NamedTuple):
    """What a table returns; arrays of the broadcast shape of d and θ."""

    force: FloatArray  # F [N]
    energy: FloatArray  # U [J]
    force_d: FloatArray  # ∂F/∂d [N/m]
    force_theta: FloatArray  # ∂F/∂θ [N/rad]
    energy_d: FloatArray  # ∂U/∂d = F/cos θ [N], the push along the face's normal
    energy_theta: FloatArray  # ∂U/∂θ [N·m/rad]
    inside: NDArray[np.bool_]  # False where d or θ was clamped to the domain
    max_error: float  # the certificate: largest relative error of any of the six


class Certificate(NamedTuple):
    """How a table was proven: its largest relative error over all outputs, and where it was."""

    max_error: float
    d: float  # [m]
    theta: float  # [rad]


_MAGIC = b"SFTIPTAB"
_CHECK = 32  # bytes of a SHA-256


class ContactTable:
    """Force, energy and first partials of one tip of one material, by lookup.

    ``data`` is the flat float64 array that :func:`lookup` takes. The domain is 0 < d ≤ a and
    |θ| ≤ asin((a − d)/a).
    """

    def __init__(self, data: FloatArray) -> None:
        self.data = data

    @classmethod
    def build(
        cls,
        tip: Fingertip,
        material: Material,
        tolerance: float = 1e-9,
        form: int | None = None,
    ) -> ContactTable:
        """Build and certify the cheapest table that meets ``tolerance``, relative, on all outputs.

        ``form`` asks for one form of FORMS by its number, whatever its cost. Raises TableError,
        with the best that was reached, when the tolerance can't be met within 256 KiB.
        """
        # Imported here: a table that is loaded needs none of the quadrature.
        from kinematics.table_build import build

        return cls(build(tip, material, tolerance, form))

    @classmethod
    def load_or_build(
        cls, path: Path | str, tip: Fingertip, material: Material, tolerance: float = 1e-9
    ) -> ContactTable:
        """The table kept at ``path``, or built and kept there.

        ``path`` is a file, or a folder where the file is named after its key. A damaged or foreign
        file is replaced; where nothing can be written the table is built all the same.
        """
        file = Path(path)
        if file.is_dir() or not file.suffix:
            file = file / f"contact-{table_key(tip, material, tolerance).hex()[:16]}.table"
        try:
            return cls.load(file, tip, material, tolerance)
        except (OSError, TableError):
            table = cls.build(tip, material, tolerance)
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            table.save(file, tip, material)
        except OSError:
            pass
        return table

    def save(self, path: Path | str, tip: Fingertip, material: Material) -> None:
        """Write the table with its key and checksum; the file appears whole or not at all."""
        key = table_key(tip, material, self.tolerance)
        body = key + struct.pack("<Q", self.data.size) + self.data.astype("<f8").tobytes()
        target = Path(path)
        part = target.with_name(f"{target.name}.{os.getpid()}.part")
        part.write_bytes(_MAGIC + hashlib.sha256(body).digest() + body)
        part.replace(target)

    @classmethod
    def load(
        cls, path: Path | str, tip: Fingertip, material: Material, tolerance: float = 1e-9
    ) -> ContactTable:
        """Read a table that was saved for this tip, material and tolerance by this version.

        Raises TableError when the file is damaged or belongs to another table, OSError when it
        can't be read.
        """
        content = Path(path).read_bytes()
        start = len(_MAGIC) + _CHECK
        body = content[start:]
        if content[: len(_MAGIC)] != _MAGIC:
            raise TableError(f"{path} holds no contact table")
        if hashlib.sha256(body).digest() != content[len(_MAGIC) : start]:
            raise TableError(f"{path} is damaged: its checksum does not match")
        if body[:_CHECK] != table_key(tip, material, tolerance):
            raise TableError(f"{path} belongs to another tip, material, tolerance or version")
        (size,) = struct.unpack_from("<Q", body, _CHECK)
        data = aligned(size)
        data[:] = np.frombuffer(body, dtype="<f8", offset=_CHECK + 8, count=size)
        return cls(data)

    @property
    def tolerance(self) -> float:
        """The tolerance it was built to."""
        return float(self.data[TOLERANCE])

    @property
    def max_error(self) -> float:
        """The certificate's largest relative error of any output."""
        return float(self.data[MAX_ERROR])

    @property
    def certificate(self) -> Certificate:
        """Largest relative error found, and at what d and θ."""
        return Certificate(*(float(self.data[i]) for i in (MAX_ERROR, WORST_D, WORST_THETA)))

    @property
    def form(self) -> int:
        """Number of its form in FORMS; 0 is the closed form."""
        return int(self.data[FORM])

    @property
    def tip(self) -> Fingertip:
        """The tip that it was built for."""
        return Fingertip(float(self.data[RADIUS]))

    def __call__(self, d: ArrayLike, theta: ArrayLike) -> Contact:
        """Look up at displacement d [m] and tilt θ [rad]; they broadcast.

        Zeros for d ≤ 0, NaN for NaN; outside the domain the nearest inside, flagged.
        """
        shape, (depth, tilt) = flatten(d, theta)
        out = np.empty((6, depth.size))
        inside = np.empty(depth.size, dtype=np.bool_)
        lookups(self.data, depth, tilt, out, inside)
        return Contact(*(row.reshape(shape) for row in out), inside.reshape(shape), self.max_error)


def table_key(tip: Fingertip, material: Material, tolerance: float) -> bytes:
    """What a saved table is for: SHA-256 of tip, material, tolerance and the code's version."""
    law = [str(value) for value in material.coefficients]
    builder = Path(__file__).with_name("table_build.py")
    text = repr((VERSION, source_digest(builder), tip.radius.hex(), law, float(tolerance).hex()))
    return hashlib.sha256(text.encode()).digest()


def aligned(size: int) -> FloatArray:
    """Zeros, float64 [size], starting at a cache line so that vector loads do not straddle two."""
    room = np.zeros(size + 8)
    skip = (-room.ctypes.data % 64) // 8
    return room[skip : skip + size]
