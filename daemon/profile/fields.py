"""Define bounded number types for settings, and the base class for settings sections."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

from softfinger.daemon.backends import Kind, backend, known, servo_model
from softfinger.daemon.errors import PluginError

__all__ = ["Section", "setting"]

# Every number has a lower and an upper bound, so that most mistyped values are rejected.
Positive = Annotated[float, Field(ge=1e-9, le=1e9, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Length = Annotated[float, Field(ge=1e-4, le=1, allow_inf_nan=False)]  # m
Place = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]  # m
Angle = Annotated[float, Field(ge=-6.3, le=6.3, allow_inf_nan=False)]  # rad
Seconds = Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)]
Delay = Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)]  # s
Rate = Annotated[float, Field(ge=0.1, le=10_000, allow_inf_nan=False)]  # Hz
Acceleration = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]  # m/s²
Factor = Annotated[float, Field(ge=1e-5, le=1e5, allow_inf_nan=False)]
Counts = Annotated[int, Field(ge=-1_048_575, le=1_048_575)]
Modulus = Annotated[float, Field(ge=1, le=1e10, allow_inf_nan=False)]  # Pa
Fraction = Annotated[float, Field(ge=0, le=1)]
Index = Annotated[int, Field(ge=0, le=255)]
ServoId = Annotated[int, Field(ge=0, le=252)]
Processor = Annotated[int, Field(ge=0, le=1023)]


def setting(default: Any, unit: str, description: str, **options: Any) -> Any:
    """Declare one setting in a section class.

    The profile reference, the documentation and the JSON schema are generated from the
    declarations.

    Parameters
    ----------
    default
        Value for the built-in simulated hand.
    unit
        SI unit of the value or of each element, empty for a dimensionless value.
    description
        Meaning of the value, in one or two sentences.
    **options
        Bounds and examples, passed to :func:`pydantic.Field`.
    """
    if unit:
        options["json_schema_extra"] = {"unit": unit}
    return Field(default, description=description, **options)


class Section(BaseModel):
    """Base class of all settings sections. Sections are immutable and strictly typed.

    Unknown keys are errors. Integers are accepted for floats, but strings are never converted to
    numbers.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def names_backend(kind: Kind) -> AfterValidator:
    """Return a validator for backend names; its error messages match those of a Literal."""

    def check(name: str) -> str:
        try:
            backend(kind, name)
        except PluginError as error:
            why = {"why": str(error)}
            raise PydanticCustomError("plugin", "a working plugin: {why}", why) from None
        except KeyError:
            *most, last = map(repr, known(kind))
            listed = {"known": f"{', '.join(most)} or {last}"}
            raise PydanticCustomError("one_of", "Input should be {known}", listed) from None
        return name

    return AfterValidator(check)


def _servo_model(name: str) -> str:
    try:
        servo_model(name)
    except KeyError as error:
        expected = str(error.args[0]).partition("expected ")[2]
        raise PydanticCustomError("servo_model", "{expected}", {"expected": expected}) from None
    return name


ServoModel = Annotated[str, AfterValidator(_servo_model)]
