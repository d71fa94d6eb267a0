"""Define the control table for Dynamixel X servos: addresses, units, modes and models.

The data come from the manufacturer's manuals. `servos.joint` converts register counts to rad, rad/s
and A. The client and the emulated servos share this table and the packet CRC. This module does not
communicate with servos.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

# --- addresses -----------------------------------------------------------------------------------

# EEPROM registers keep their values across a reboot and are writable only while torque is off.
MODEL_NUMBER: Final = 0
MODEL_INFORMATION: Final = 2
FIRMWARE_VERSION: Final = 6
ID: Final = 7
BAUD_RATE: Final = 8
RETURN_DELAY_TIME: Final = 9
DRIVE_MODE: Final = 10
OPERATING_MODE: Final = 11
SHADOW_ID: Final = 12
PROTOCOL_TYPE: Final = 13
HOMING_OFFSET: Final = 20
MOVING_THRESHOLD: Final = 24
TEMPERATURE_LIMIT: Final = 31
MAX_VOLTAGE_LIMIT: Final = 32
MIN_VOLTAGE_LIMIT: Final = 34
PWM_LIMIT: Final = 36
CURRENT_LIMIT: Final = 38
VELOCITY_LIMIT: Final = 44
MAX_POSITION_LIMIT: Final = 48
MIN_POSITION_LIMIT: Final = 52
STARTUP_CONFIGURATION: Final = 60
PWM_SLOPE: Final = 62
SHUTDOWN: Final = 63

# The RAM registers are reset on every reboot.
RAM: Final = 64
TORQUE_ENABLE: Final = 64
LED: Final = 65
STATUS_RETURN_LEVEL: Final = 68
REGISTERED_INSTRUCTION: Final = 69
HARDWARE_ERROR_STATUS: Final = 70
VELOCITY_I_GAIN: Final = 76
VELOCITY_P_GAIN: Final = 78
POSITION_D_GAIN: Final = 80
POSITION_I_GAIN: Final = 82
POSITION_P_GAIN: Final = 84
FEEDFORWARD_2ND_GAIN: Final = 88
FEEDFORWARD_1ST_GAIN: Final = 90
BUS_WATCHDOG: Final = 98
GOAL_PWM: Final = 100
GOAL_CURRENT: Final = 102
GOAL_VELOCITY: Final = 104
PROFILE_ACCELERATION: Final = 108
PROFILE_VELOCITY: Final = 112
GOAL_POSITION: Final = 116
REALTIME_TICK: Final = 120
MOVING: Final = 122
MOVING_STATUS: Final = 123
PRESENT_PWM: Final = 124
PRESENT_CURRENT: Final = 126
PRESENT_VELOCITY: Final = 128
PRESENT_POSITION: Final = 132
VELOCITY_TRAJECTORY: Final = 136
POSITION_TRAJECTORY: Final = 140
PRESENT_INPUT_VOLTAGE: Final = 144
PRESENT_TEMPERATURE: Final = 146
BACKUP_READY: Final = 147
INDIRECT_ADDRESS: Final = 168

# --- units ---------------------------------------------------------------------------------------

BAUD_RATES: Final = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
COUNTS_PER_TURN: Final = 4096
VELOCITY_UNIT: Final = 0.229 * 2.0 * math.pi / 60.0  # rad/s per count
ACCELERATION_UNIT: Final = 214.577 * 2.0 * math.pi / 3600.0  # rad/s² per count
VOLTAGE_UNIT: Final = 0.1  # V per count
RETURN_DELAY_UNIT: Final = 2e-6  # s per count
WATCHDOG_UNIT: Final = 0.020  # s per count
WATCHDOG_MAX: Final = 127
WATCHDOG_ERROR: Final = 0xFF  # value after a watchdog stop; goals are rejected until 0 is written

# --- operating modes, register 11 ----------------------------------------------------------------

CURRENT_MODE: Final = 0
VELOCITY_MODE: Final = 1
POSITION_MODE: Final = 3
EXTENDED_POSITION_MODE: Final = 4
CURRENT_BASED_POSITION_MODE: Final = 5
PWM_MODE: Final = 16
MODE_NAMES: Final = {
    CURRENT_MODE: "current",
    VELOCITY_MODE: "velocity",
    POSITION_MODE: "position",
    EXTENDED_POSITION_MODE: "extended position",
    CURRENT_BASED_POSITION_MODE: "current-based position",
    PWM_MODE: "PWM",
}
MODE_NUMBERS: Final = {name: number for number, name in MODE_NAMES.items()}

# --- hardware errors, registers 70 and 63 --------------------------------------------------------

OVERHEATING: Final = 2
OVERLOAD: Final = 5
HARDWARE_ERRORS: Final = {
    0: "input voltage outside its limits",
    OVERHEATING: "overheating",
    3: "motor encoder",
    4: "electrical shock",
    OVERLOAD: "overload",
}


def hardware_error_names(status: int) -> str:
    """Return the names of the hardware errors in ``status``, separated by commas."""
    names = [name for bit, name in HARDWARE_ERRORS.items() if status >> bit & 1]
    return ", ".join(names) or f"unknown error bits 0x{status:02X}"


# --- models --------------------------------------------------------------------------------------

_SPECIFIC_HEAT = 0.9  # approximate mean specific heat of plastic, aluminium and steel [J/(g K)]
_CONVECTION = 10.0  # convection coefficient of a small body in still air [W/(m² K)]
SAG: Final = 0.35  # resistance of the simulated power supply and its cable [Ω]


@dataclass(frozen=True, slots=True)
class ServoModel:
    """Data and factory defaults of a servo model, in register counts unless a unit is given."""

    name: str
    number: int
    firmware: int  # firmware version that the emulated servo reports
    highest_baud: int  # index into BAUD_RATES
    current_unit: float  # current per count [A], or 0 if there is no current sensor
    current_limit: int  # default and upper bound
    velocity_limit: int  # default
    velocity_max: int  # upper bound of the velocity limit
    temperature_limit: int  # default [°C]
    voltage_min: int  # default of the minimum voltage limit [0.1 V]
    voltage_max: int  # default and upper bound of the voltage limits [0.1 V]
    velocity_gains: tuple[int, int]  # I, P
    position_gains: tuple[int, int, int]  # D, I, P
    shutdown: int
    drive_mode_max: int
    fast_read_firmware: int  # first firmware version with fast sync read and fast bulk read
    stall: tuple[float, float, float]  # stall torque [N·m], stall current [A], voltage [V]
    mass: float  # g
    size: tuple[float, float, float]  # mm
    modes: tuple[int, ...] = tuple(MODE_NAMES)
    pwm_slope: int | None = None  # default of register 62, or None if the model lacks this register
    is_x330: bool = False  # True for the X330 series, whose indirect addresses moved in firmware 53
    gear_loss: float = 0.0  # published fraction of torque lost to gear friction, or 0

    @property
    def senses_current(self) -> bool:
        """True if the model can measure and limit motor current."""
        return self.current_unit > 0.0

    @property
    def baud_rates(self) -> tuple[int, ...]:
        """Baud rates that register 8 can select."""
        return BAUD_RATES[: self.highest_baud + 1]

    @property
    def stall_current(self) -> float:
        """Maximum current allowed by the model [A]; 1 A if the model has no current sensor."""
        return self.current_limit * self.current_unit if self.senses_current else 1.0

    @property
    def torque_constant(self) -> float:
        """Torque constant at the shaft [N·m/A]; 0 if the model has no current sensor."""
        torque, current, _ = self.stall
        return torque / current if self.senses_current else 0.0

    @property
    def no_load_speed(self) -> float:
        """Approximate no-load speed at full PWM [rad/s], taken from the default velocity limit."""
        return self.velocity_limit * VELOCITY_UNIT

    @property
    def supply(self) -> float:
        """Middle of the supply voltage range [V]."""
        return (self.voltage_min + self.voltage_max) / 2.0 * VOLTAGE_UNIT

    @property
    def voltage_bound(self) -> int:
        """Lower bound of the voltage limits [0.1 V]. Models for 5 V accept 31, others the default.

        The source is the range of registers 32 and 34 in the e-Manual's control tables.
        """
        return 31 if self.voltage_min == 35 else self.voltage_min

    @property
    def resistance(self) -> float:
        """Electrical resistance at stall [Ω], including the driver."""
        return self.stall[2] / self.stall[1]

    @property
    def heat_capacity(self) -> float:
        """Heat capacity [J/K], estimated from the mass."""
        return _SPECIFIC_HEAT * self.mass

    @property
    def case_resistance(self) -> float:
        """Thermal resistance between case and still air [K/W], estimated from the surface area."""
        a, b, c = (1e-3 * side for side in self.size)
        return 1.0 / (_CONVECTION * 2.0 * (a * b + b * c + c * a))

    def indirect_blocks(self, firmware: int) -> tuple[tuple[int, int, int], ...]:
        """Return each indirect block as (first address register, first data register, length)."""
        if not self.is_x330:
            return ((INDIRECT_ADDRESS, 224, 28), (578, 634, 28))
        if firmware <= 52:
            return ((INDIRECT_ADDRESS, 208, 20),)
        return ((INDIRECT_ADDRESS, 224, 28),)

    def fast_read(self, firmware: int) -> bool:
        """Return True if this firmware supports fast sync read and fast bulk read."""
        return firmware >= self.fast_read_firmware

    def highest_address(self, firmware: int) -> int:
        """Return the last control table address."""
        return max(data + entries for _, data, entries in self.indirect_blocks(firmware)) - 1


_ALL = tuple(MODE_NAMES)
_WITHOUT_CURRENT = (VELOCITY_MODE, POSITION_MODE, EXTENDED_POSITION_MODE, PWM_MODE)
# One row per model, in the order of the ServoModel fields. The data come from the specifications
# and the control table on the model's page in the ROBOTIS e-Manual,
# emanual.robotis.com/docs/en/dxl/x/NAME/ or …/mx/NAME-2/. The model numbers of the XD430 come from
# control_table/dynamixel.model in dynamixel-sdk. For XH430-V, XH540-V270, XM540-W150, MX-64 and
# MX-106, the velocity limit is the no-load speed. The manual's velocity limits apply to firmware
# before version 42. For the XW430-T200, the e-Manual lists 6.9 N·m at 4.9 A, which is the stall
# torque of the XW540-T140. The row of the XW430-T200 therefore contains the data of the XH430-W210.
# Only the stall torque is scaled, by the ratio of the gear reductions, 200 : 213. For the
# XW430-T333, scaling by the gear ratio gives 3.2 N·m. The e-Manual lists 3.1 N·m at 1.3 A.
_430 = 82, (28.5, 46.5, 34.0)  # mass [g], size [mm]
_540 = 165, (33.5, 58.5, 44.0)
_XW540 = 185, (33.5, 58.5, 45.9)
_XL330 = 18, (20.0, 34.0, 26.0)
_XC330 = 23, (20.0, 34.0, 26.0)
_MODELS: tuple[tuple[Any, ...], ...] = (
    ("XM430-W350", 1020, 48, 7, 2.69e-3, 1193, 200, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 800), 52, 5, 45, (4.1, 2.3, 12.0), *_430),
    ("XM430-W210", 1030, 48, 7, 2.69e-3, 1193, 330, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 800), 52, 5, 45, (3.0, 2.3, 12.0), *_430),
    ("XM540-W150", 1130, 48, 7, 2.69e-3, 2047, 230, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 800), 52, 5, 45, (7.3, 4.4, 12.0), *_540),
    ("XM540-W270", 1120, 48, 7, 2.69e-3, 2047, 128, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 800), 52, 5, 45, (10.6, 4.4, 12.0), *_540),
    ("XH430-W210", 1010, 48, 7, 2.69e-3, 648, 210, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 900), 52, 5, 45, (2.5, 1.3, 12.0), *_430),
    ("XH430-W350", 1000, 48, 7, 2.69e-3, 648, 130, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 900), 52, 5, 45, (3.4, 1.3, 12.0), *_430),
    ("XH430-V210", 1050, 48, 7, 1.34e-3, 689, 227, 1023, 80, 110, 300,
     (1920, 100), (0, 0, 800), 52, 5, 45, (2.6, 0.7, 24.0), *_430),
    ("XH430-V350", 1040, 48, 7, 1.34e-3, 689, 135, 1023, 80, 110, 300,
     (1920, 100), (0, 0, 800), 52, 5, 45, (3.3, 0.7, 24.0), *_430),
    ("XD430-T210", 1011, 48, 7, 2.69e-3, 648, 210, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 900), 52, 5, 45, (2.5, 1.3, 12.0), *_430),
    ("XD430-T350", 1001, 48, 7, 2.69e-3, 648, 130, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 900), 52, 5, 45, (3.4, 1.3, 12.0), *_430),
    ("XH540-W150", 1110, 48, 7, 2.69e-3, 2047, 300, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 800), 52, 5, 45, (7.1, 4.9, 12.0), *_540),
    ("XH540-W270", 1100, 48, 7, 2.69e-3, 2047, 167, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 800), 52, 5, 45, (9.9, 4.9, 12.0), *_540),
    ("XH540-V150", 1150, 48, 7, 2.69e-3, 2047, 230, 1023, 80, 110, 300,
     (1920, 100), (0, 0, 800), 52, 5, 45, (6.4, 2.4, 24.0), *_540),
    ("XH540-V270", 1140, 48, 7, 2.69e-3, 2047, 148, 1023, 80, 110, 300,
     (1920, 100), (0, 0, 800), 52, 5, 45, (9.2, 2.4, 24.0), *_540),
    ("XW430-T200", 1280, 48, 7, 2.69e-3, 2047, 235, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 900), 52, 13, 45, (2.3, 1.3, 12.0), *_430),
    ("XW430-T333", 1270, 48, 7, 2.69e-3, 2047, 139, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 900), 52, 13, 45, (3.1, 1.3, 12.0), *_430),
    ("XW540-T140", 1180, 48, 7, 2.69e-3, 2047, 304, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 800), 52, 5, 45, (6.9, 4.9, 12.0), *_XW540),
    ("XW540-T260", 1170, 48, 7, 2.69e-3, 2047, 167, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 800), 52, 5, 45, (9.5, 4.9, 12.0), *_XW540),
    ("MX-64", 311, 48, 7, 3.36e-3, 1941, 275, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 850), 52, 5, 45, (6.0, 4.1, 12.0),
     165, (40.2, 61.1, 41.0), _ALL, None, False, 0.23),
    ("MX-106", 321, 48, 7, 3.36e-3, 2047, 197, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 850), 52, 5, 45, (8.4, 5.2, 12.0),
     165, (40.2, 65.1, 46.0), _ALL, None, False, 0.23),
    ("MX-28", 30, 48, 7, 0.0, 0, 230, 1023, 80, 95, 160,
     (1920, 100), (0, 0, 850), 52, 5, 45, (2.5, 1.4, 12.0),
     77, (35.6, 50.6, 35.5), _WITHOUT_CURRENT),
    ("XL330-M288", 1200, 53, 6, 1e-3, 1750, 445, 2047, 70, 35, 70,
     (1600, 180), (0, 0, 400), 53, 5, 46, (0.52, 1.47, 5.0), *_XL330, _ALL, 140, True, 0.25),
    ("XL330-M077", 1190, 53, 6, 1e-3, 1750, 1620, 2047, 70, 35, 70,
     (400, 40), (0, 400, 400), 53, 5, 46, (0.215, 1.47, 5.0), *_XL330, _ALL, 140, True),
    ("XC330-T181", 1210, 53, 6, 1e-3, 910, 510, 2047, 70, 55, 140,
     (1200, 40), (0, 0, 900), 52, 13, 46, (0.76, 0.80, 11.1), *_XC330, _ALL, 255, True),
    ("XC330-T288", 1220, 53, 6, 1e-3, 910, 320, 2047, 70, 55, 140,
     (1200, 40), (0, 0, 900), 52, 13, 46, (0.92, 0.80, 11.1), *_XC330, _ALL, 255, True),
    ("XC330-M181", 1230, 53, 6, 1e-3, 2352, 545, 2047, 70, 35, 70,
     (1400, 100), (500, 0, 1200), 52, 13, 46, (0.60, 1.80, 5.0), *_XC330, _ALL, 140, True),
    ("XC330-M288", 1240, 53, 6, 1e-3, 2352, 350, 2047, 70, 35, 70,
     (1600, 50), (500, 0, 1100), 52, 13, 46, (0.93, 1.80, 5.0), *_XC330, _ALL, 140, True),
    ("XL430-W250", 1060, 48, 7, 0.0, 0, 265, 1023, 72, 60, 140,
     (1000, 100), (4000, 0, 640), 52, 13, 45, (1.5, 1.4, 12.0),
     57.2, (28.5, 46.5, 34.0), _WITHOUT_CURRENT),
)  # fmt: skip
MODELS: Final = {row[0]: ServoModel(*row) for row in _MODELS}


def by_name(name: str) -> ServoModel:
    """Return the model with this name; a connector suffix (``-T``, ``-R``) is optional.

    Raises KeyError if the model is unknown. The message lists the known models.
    """
    plain = name.upper().removesuffix("-T").removesuffix("-R")
    model = MODELS.get(plain)
    if model is None:
        raise KeyError(f"unknown servo model {name!r}; expected one of {', '.join(MODELS)}")
    return model


def name_of(number: int) -> str:
    """Return the name of the model with this ``number``, or the number itself if it is unknown."""
    names = (model.name for model in MODELS.values() if model.number == number)
    return next(names, f"model number {number}")


def _crc_of(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = crc << 1 ^ (0x8005 if crc & 0x8000 else 0)
    return crc & 0xFFFF


_CRCS: Final = [_crc_of(byte) for byte in range(256)]


def crc16(data: bytes, crc: int = 0) -> int:
    """Return the CRC-16 of a packet (polynomial 0x8005, initial value 0)."""
    for byte in data:
        crc = crc << 8 & 0xFF00 ^ _CRCS[crc >> 8 ^ byte]
    return crc
