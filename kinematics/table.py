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
from kinematics.lanes import slab, square
from kinematics.material import Material

FloatArray = NDArray[np.float64]

HALF_PI = math.pi / 2

# Header of a table's array, by index.
FORMAT, FORM, RADIUS, MODULUS, INVERSE_RADIUS = 0, 1, 2, 3, 4
LOWEST, SHIFT, FIRST, H_PIECES, Y_PIECES = 5, 6, 7, 8, 9
SIZE, CORNER, TOLERANCE, MAX_ERROR, WORST_D, WORST_THETA = 10, 11, 12, 13, 14, 15
CENTRES = 16  # of the pieces of h, each with the inverse of its half width

VERSION = 1.0

# The corner h → 0: pieces over y, and terms in h and y of A and B in each; the same for all forms.
CORNER_PIECES = 6
CORNER_TERMS = (8, 10)
CORNER_SIZE = 10 * CORNER_TERMS[0] * CORNER_TERMS[1]


class Form(NamedTuple):
    """One representation: degrees of its local polynomials and the grid of their pieces."""

    name: str
    nx: int  # degree in h
    ny: int  # degree in y; with ny = nx all powers, else the triangle between the two
    bits: int  # 2^bits pieces an octave of h
    y_pieces: int


# Forms by number, as the header has it, cheapest first. The slabs span all of y, so that where their
# coefficients stand depends on d alone and they are read while θ's cosine is still being computed.
FORMS = (
    Form("closed", 0, 0, 0, 0),
    Form("bilinear", 1, 1, 3, 16),
    Form("bicubic", 3, 3, 2, 8),
    Form("quintic", 5, 5, 2, 4),
    Form("slab 6-11", 6, 11, 2, 1),
    Form("slab 7-18", 7, 18, 2, 1),
    Form("slab 10-21", 10, 21, 2, 1),
    Form("slab 12-28", 12, 28, 2, 1),
)
CLOSED = 0
_SLABS = 4  # the first form that spans all of y


class TableError(Exception):
    """A table can't be built to the tolerance, or a file holds no sound table of this kind."""


@kernel
def _sine_cosine(theta: float) -> tuple[float, float]:
    """sin θ and cos θ to an ulp, both relative, for |θ| ≤ π/2; inlined, unlike the C library's."""
    size = abs(theta)
    far = size > 0.7853981633974483
    # π/2 − |θ| keeps its digits near π/2, and so does the cosine.
    r = (HALF_PI - size) + 6.123233995736766e-17 if far else size
    z = r * r
    z2 = z * z
    z4 = z2 * z2
    p = (-0.16666666666666666 + z * 0.00833333333333095) + z2 * (
        -0.00019841269836759774 + z * 2.755731610309567e-06
    )
    p += z4 * (-2.505113194542731e-08 + z * 1.5918135792566938e-10)
    q = (0.041666666666666664 - z * 0.0013888888888887398) + z2 * (
        2.4801587298766353e-05 - z * 2.755731727203115e-07
    )
    q += z4 * (2.087614632409855e-09 - z * 1.1382636028190913e-11)
    sine = r + r * z * p
    half = 0.5 * z
    most = 1.0 - half
    cosine = most + (((1.0 - most) - half) + z2 * q)
    if far:
        sine, cosine = cosine, sine
    return math.copysign(sine, theta), cosine


_START_SLABS = CENTRES + 24  # three octaves of four pieces


@kernel
def _evaluate_slab(
    data: FloatArray, form: int, i: int, x: float, y: float
) -> tuple[float, float, float, float, float]:
    """The five ratios of a piece of h. The degrees are literals, as FORMS says."""
    at = _START_SLABS + i * int(data[SIZE])
    if form == 5:
        return slab(data, at, 7, 18, x, y)
    if form == 6:
        return slab(data, at, 10, 21, x, y)
    if form == 4:
        return slab(data, at, 6, 11, x, y)
    return slab(data, at, 12, 28, x, y)


@kernel
def _evaluate_local(
    data: FloatArray, form: int, i: int, x: float, y: float
) -> tuple[float, float, float, float, float]:
    """The five ratios of the piece of h and y."""
    count = int(data[Y_PIECES])
    y *= count
    j = min(int(y), count - 1)
    y = 2.0 * (y - j) - 1.0
    at = CENTRES + 2 * int(data[H_PIECES]) + (i * count + j) * int(data[SIZE])
    if form == 1:
        return square(data, at, 1, x, y)
    if form == 2:
        return square(data, at, 3, x, y)
    return square(data, at, 5, x, y)


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
    h = (radius - d) * data[INVERSE_RADIUS]
    rho2 = d * data[INVERSE_RADIUS] * (1.0 + h)
    s, c = _sine_cosine(theta)
    gap = c * c - rho2  # cos² θ u², and h² − sin² θ
    if not (d > 0.0 and gap >= 0.0 and h >= 0.0 and abs(theta) <= HALF_PI):
        if math.isnan(d) or math.isnan(theta):
            nan = math.nan
            return nan, nan, nan, nan, nan, nan, False
        if d <= 0.0:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, True
        d, theta, inside = _clamp(radius, d, theta)
        h = (radius - d) * data[INVERSE_RADIUS]
        s, c = _sine_cosine(theta)
        gap = 0.0
    form = int(data[FORM])
    # One division for 1/(h cos θ) and 1/cos θ; for h = 0 the corner does without the former.
    over = 1.0 / (c * max(h, 1e-300))
    inverse = over * max(h, 1e-300)
    slope = s * inverse
    push = math.pi * data[MODULUS] * d * inverse
    force = push * d
    energy = force * inverse * d * (1.0 / 3.0)
    if form == CLOSED:
        return (
            force,
            energy,
            2.0 * push,
            force * slope,
            force * inverse,
            2.0 * energy * slope,
            inside,
        )
    if h >= data[LOWEST]:
        i = (np.float64(h).view(np.int64) >> int(data[SHIFT])) - int(data[FIRST])
        i = min(i, int(data[H_PIECES]) - 1)
        x = (h - data[CENTRES + 2 * i]) * data[CENTRES + 2 * i + 1]
        y = math.sqrt(gap) * over
        if form >= _SLABS:
            ratios = _evaluate_slab(data, form, i, x, 2.0 * y - 1.0)
        else:
            ratios = _evaluate_local(data, form, i, x, y)
    else:
        s = abs(s)
        y = math.sqrt((h - s) * (h + s)) * over if h > s else 0.0
        ratios = _evaluate_corner(data, h, y)
    r_f, r_u, r_fd, r_ft, r_ut = ratios
    force_theta = force * slope * r_ft
    force *= r_f
    return (
        force,
        energy * r_u,
        2.0 * push * r_fd,
        force_theta,
        force * inverse,
        2.0 * energy * slope * r_ut,
        inside,
    )


@kernel
def _clamp(radius: float, d: float, theta: float) -> tuple[float, float, bool]:
    """The nearest d and θ of the domain, and whether they were in it (rounding aside)."""
    inside = d <= radius
    d = min(d, radius)
    limit = theta_limit(radius, d)
    inside = inside and abs(theta) <= limit
    return d, min(max(theta, -limit), limit), inside


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
        form: str | None = None,
    ) -> ContactTable:
        """Build and certify the cheapest table that meets ``tolerance``, relative, on all outputs.

        ``form`` asks for one form of FORMS by its name, whatever its cost. Raises TableError,
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
    def form(self) -> Form:
        """Its representation."""
        return FORMS[int(self.data[FORM])]

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
