"""What differs between the Dynamixel X models: one table of plain data, from the maker's manuals.

Nothing here talks to a servo. Values marked as defaults are what a factory-new servo holds.
"""

from __future__ import annotations

from dataclasses import dataclass

from softfinger.daemon.servos.registers import BAUD_RATES, VELOCITY_UNIT


@dataclass(frozen=True, slots=True)
class ServoModel:
    """One model. Counts where the register holds counts; ``current_unit`` is 0 without a sensor."""

    name: str
    number: int
    firmware: int  # the version the emulated servo reports
    highest_baud: int  # index into BAUD_RATES
    current_unit: float  # A a count
    current_limit: int  # counts, default and upper bound
    velocity_limit: int  # counts, default
    velocity_max: int  # counts, upper bound of the velocity limit
    temperature_limit: int  # °C, default
    voltage_min: int  # 0.1 V, default and lower bound
    voltage_max: int  # 0.1 V, default and upper bound
    velocity_gains: tuple[int, int]  # I, P
    position_gains: tuple[int, int, int]  # D, I, P
    shutdown: int
    drive_mode_max: int
    modes: tuple[int, ...]
    fast_read_firmware: int  # first version that answers fast sync and fast bulk read
    pwm_slope: int | None = None  # default of register 62, where the model has it
    small: bool = False  # X330 frame: its indirect map moved with firmware 53

    @property
    def senses_current(self) -> bool:
        """Whether the model measures and bounds motor current."""
        return self.current_unit > 0.0

    @property
    def baud_rates(self) -> tuple[int, ...]:
        """The rates that register 8 can choose."""
        return BAUD_RATES[: self.highest_baud + 1]

    @property
    def stall_current(self) -> float:
        """A: the greatest current the model allows (1 A where it can't sense current)."""
        return self.current_limit * self.current_unit if self.senses_current else 1.0

    @property
    def no_load_speed(self) -> float:
        """rad/s at the shaft with full PWM and no load; the default velocity limit is about it."""
        return self.velocity_limit * VELOCITY_UNIT

    def indirect_blocks(self, firmware: int) -> tuple[tuple[int, int, int], ...]:
        """(first address register, first data register, entries) of each indirect block."""
        if not self.small:
            return ((168, 224, 28), (578, 634, 28))
        if firmware <= 52:
            return ((168, 208, 20),)
        return ((168, 224, 28),)

    def fast_read(self, firmware: int) -> bool:
        """Whether this firmware answers fast sync read and fast bulk read."""
        return firmware >= self.fast_read_firmware

    def highest_address(self, firmware: int) -> int:
        """The last address of the control table."""
        return max(data + entries for _, data, entries in self.indirect_blocks(firmware)) - 1


_ALL_MODES = (0, 1, 3, 4, 5, 16)
_NO_CURRENT_MODES = (1, 3, 4, 16)


def _x330(
    name: str,
    number: int,
    current_limit: int,
    velocity_limit: int,
    voltage: tuple[int, int],
    velocity_gains: tuple[int, int],
    position_gains: tuple[int, int, int],
    shutdown: int = 52,
    drive_mode_max: int = 13,
    pwm_slope: int = 140,
) -> ServoModel:
    return ServoModel(
        name=name,
        number=number,
        firmware=53,
        highest_baud=6,
        current_unit=1e-3,
        current_limit=current_limit,
        velocity_limit=velocity_limit,
        velocity_max=2047,
        temperature_limit=70,
        voltage_min=voltage[0],
        voltage_max=voltage[1],
        velocity_gains=velocity_gains,
        position_gains=position_gains,
        shutdown=shutdown,
        drive_mode_max=drive_mode_max,
        modes=_ALL_MODES,
        fast_read_firmware=46,
        pwm_slope=pwm_slope,
        small=True,
    )


def _xm(name: str, number: int, current_limit: int, velocity_limit: int) -> ServoModel:
    return ServoModel(
        name=name,
        number=number,
        firmware=48,
        highest_baud=7,
        current_unit=2.69e-3,
        current_limit=current_limit,
        velocity_limit=velocity_limit,
        velocity_max=1023,
        temperature_limit=80,
        voltage_min=95,
        voltage_max=160,
        velocity_gains=(1920, 100),
        position_gains=(0, 0, 800),
        shutdown=52,
        drive_mode_max=5,
        modes=_ALL_MODES,
        fast_read_firmware=45,
    )


_TABLE = (
    _xm("XM430-W350", 1020, 1193, 200),
    _xm("XM430-W210", 1030, 1193, 330),
    _xm("XM540-W270", 1120, 2047, 128),
    _x330("XL330-M288", 1200, 1750, 445, (35, 70), (1600, 180), (0, 0, 400), 53, 5),
    _x330("XL330-M077", 1190, 1750, 1620, (35, 70), (400, 40), (0, 400, 400), 53, 5),
    _x330(
        "XC330-T288",
        1220,
        910,
        320,
        (55, 140),
        (1200, 40),
        (0, 0, 900),
        drive_mode_max=13,
        pwm_slope=255,
    ),
    _x330("XC330-M288", 1240, 2352, 350, (35, 70), (1600, 50), (500, 0, 1100)),
    ServoModel(
        name="XL430-W250",
        number=1060,
        firmware=48,
        highest_baud=7,
        current_unit=0.0,
        current_limit=0,
        velocity_limit=265,
        velocity_max=1023,
        temperature_limit=72,
        voltage_min=60,
        voltage_max=140,
        velocity_gains=(1000, 100),
        position_gains=(4000, 0, 640),
        shutdown=52,
        drive_mode_max=13,
        modes=_NO_CURRENT_MODES,
        fast_read_firmware=45,
    ),
)

MODELS: dict[str, ServoModel] = {model.name: model for model in _TABLE}
_BY_NUMBER: dict[int, ServoModel] = {model.number: model for model in _TABLE}


def by_name(name: str) -> ServoModel:
    """The model of that name; a connector suffix (``-T``, ``-R``) is not needed.

    Raises:
        KeyError: no such model; the message names the known ones.
    """
    plain = name.upper().removesuffix("-T").removesuffix("-R")
    model = MODELS.get(plain)
    if model is None:
        raise KeyError(f"unknown servo model {name!r}; known: {', '.join(MODELS)}")
    return model


def by_number(number: int) -> ServoModel | None:
    """The model that answers a ping with ``number``, or None for one that is not in the table."""
    return _BY_NUMBER.get(number)
