"""Perturb results by one unit in the last place, to find tests that depend on rounding.

``pytest --perturb SEED`` changes the following values by -1, 0 or 1 unit in the last place:

- the results of elementary functions, sums and products from NumPy and `math`, in test modules and
  in softfinger modules that define no function of a kernel;
- the results of `numpy.linalg` in all modules;
- the results of functions passed to `solve_ivp` and `curve_fit`;
- the results of contact tables, closed forms, quadrature, material laws and pressure grids;
- the parameters of each simulated plant, which affect transitions between stick and slip.

The change depends only on the number, the position in the array, and SEED, so a repeated
computation returns the same bits. Computations with an array and with single numbers therefore
differ, and so do values that would be equal by symmetry. Integer results are not changed, because
every library computes values such as cos 0 exactly.

The option does not affect operators (``+``, ``@``), array methods, intermediate results of kernels,
modules imported within a function, or other processes. `tests.harness.arithmetic` uses another BLAS
and other machine code, and thereby covers the computations that the option does not affect.
"""

import importlib
import math
import sys
from collections.abc import Callable
from functools import wraps
from types import ModuleType
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from softfinger.kinematics.compiled.plain import InnerKernel

_MATH = "sin cos tan asin acos atan atan2 exp expm1 log log1p log10 hypot sinh cosh tanh erf erfc"
_NUMPY = (
    "sin cos tan arcsin arccos arctan arctan2 exp expm1 log log1p log2 log10 hypot sinh cosh tanh "
    "power cbrt sum mean std var cumsum dot matmul einsum interp cov average polyfit"
)
_LINALG = "inv solve lstsq eigh eigvalsh eig eigvals svd qr cholesky pinv det norm"
_SOLVERS = {"scipy.integrate": "solve_ivp", "scipy.optimize": "curve_fit"}
_PRODUCT = {
    "softfinger.kinematics.contact.closed_form": "closed_forms",
    "softfinger.kinematics.contact.quadrature": "integrate",
    "softfinger.kinematics.contact.material": "Material.stress Material.energy_density",
    "softfinger.kinematics.sensing.pressure_grid": "SensorGrid.pressure",
}
_TABLE = "softfinger.kinematics.contact.table"
_PLANT = "softfinger.daemon.simulation.physics.simulated_hand"
_TIMES = ("step", "sample_period")  # times that must divide a millisecond exactly
_KERNELS = (Dispatcher, InnerKernel)
_SIGN = np.uint64(1 << 63)
_STEPS = np.array([-1, 0, 0, 1]).astype(np.uint64)

Function = Callable[..., Any]


class Perturbation:
    """Reproducible perturbations for one seed."""

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def start(self) -> None:
        """Patch `numpy.linalg`, SciPy's solvers and softfinger before tests are imported."""
        self._wrap(np.linalg, _LINALG, self._moving)
        for module, names in _SOLVERS.items():
            self._wrap(importlib.import_module(module), names, self._moving_first)
        for module, names in _PRODUCT.items():
            self._wrap(importlib.import_module(module), names, self._moving)
        table = importlib.import_module(_TABLE)
        self._wrap(table, "lookup", self._moving)
        self._wrap(table, "lookups", self._moving_out)
        self._wrap(importlib.import_module(_PLANT), "SimulatedHand.__init__", self._moving_plant)

    def enter_modules(self) -> None:
        """Replace `np` and `math` in all imported modules that define no function of a kernel."""
        own = {"np": self._own(np, _NUMPY), "math": self._own(math, _MATH)}
        named = ("tests.", "softfinger.")
        modules = [vars(each) for name, each in sys.modules.items() if name.startswith(named)]
        compiled = {
            id(each.py_func.__globals__)
            for names in modules
            for each in names.values()
            if isinstance(each, _KERNELS)
        }
        for names in modules:
            if id(names) not in compiled:
                names.update({key: own[key] for key in own if names.get(key) in (np, math)})

    def moved(self, value: Any) -> Any:
        """Return ``value`` with all floats perturbed; arrays are changed in place."""
        if isinstance(value, tuple):
            parts = [self.moved(each) for each in value]
            return value._make(parts) if hasattr(value, "_make") else tuple(parts)
        if isinstance(value, np.ndarray) and value.flags.writeable:
            if value.dtype == np.complex128:
                value.real, value.imag = self._array(value.real), self._array(value.imag)
            elif value.dtype == np.float64:
                value[...] = self._array(value)
        elif isinstance(value, float | complex):
            return type(value)(self.moved(np.array([value]))[0])
        return value

    def _array(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        bits = np.ascontiguousarray(value).view(np.uint64)
        place = np.arange(value.size, dtype=np.uint64).reshape(value.shape)
        mixed = (bits & ~_SIGN) + place + np.uint64(7919 * self._seed + 104729 * value.size)
        for factor in (0x9E3779B97F4A7C15, 0xD6E8FEB86659FD93):
            mixed = (mixed ^ (mixed >> np.uint64(32))) * np.uint64(factor)
        steps = _STEPS[(mixed >> np.uint64(62)).astype(int)]
        normal = np.isfinite(value) & (np.abs(value) > 1e-300) & (value != np.rint(value))
        return np.where(normal, (bits + steps).view(np.float64), value)

    def _own(self, module: ModuleType, names: str) -> ModuleType:
        own = ModuleType(module.__name__)
        vars(own)["__getattr__"] = lambda name: getattr(module, name)
        for name in names.split():
            setattr(own, name, self._moving(getattr(module, name)))
        return own

    @staticmethod
    def _wrap(module: ModuleType, names: str, way: Callable[[Function], Function]) -> None:
        for name in names.split():
            *path, last = name.split(".")
            place: Any = module
            for each in path:
                place = getattr(place, each)
            setattr(place, last, way(getattr(place, last)))

    def _moving(self, function: Function) -> Function:
        def call(*words: Any, **named: Any) -> Any:
            return self.moved(function(*words, **named))

        return wraps(function)(call)

    def _moving_first(self, solver: Function) -> Function:
        def call(function: Function, *words: Any, **named: Any) -> Any:
            return solver(self._moving(function), *words, **named)

        return wraps(solver)(call)

    def _moving_out(self, lookups: Function) -> Function:
        def call(data: Any, d: Any, theta: Any, out: Any, inside: Any) -> None:
            lookups(data, d, theta, out, inside)
            self.moved(out)

        return call

    def _moving_plant(self, begin: Function) -> Function:
        def call(hand: Any, *words: Any, **named: Any) -> None:
            begin(hand, *words, **named)
            parameters = hand.plant.parameters.array
            for name in parameters.dtype.names:
                if name not in _TIMES and parameters.dtype[name].base == np.float64:
                    parameters[name] = self.moved(np.array(parameters[name]))

        return wraps(begin)(call)
