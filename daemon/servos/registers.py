"""Addresses of the Dynamixel X series' control table, its operating modes and fixed units.

Names and numbers only, as the servo maker's manuals give them. The real backend and the emulated
servo both read them here; what a model adds or limits stands in :mod:`servos.models`.
"""

from __future__ import annotations

import math
from typing import Final

# EEPROM: kept over a reboot, writable only while torque is off.
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

# RAM: reset at every reboot.
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

# Operating modes, register 11.
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

# Bits of hardware error status (70) and of the shutdown mask (63).
HARDWARE_ERRORS: Final = {
    0: "input voltage out of limits",
    2: "overheating",
    3: "motor encoder",
    4: "electrical shock",
    5: "overload",
}

BAUD_RATES: Final = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)

COUNTS_PER_TURN: Final = 4096
VELOCITY_UNIT: Final = 0.229 * 2.0 * math.pi / 60.0  # rad/s a count
ACCELERATION_UNIT: Final = 214.577 * 2.0 * math.pi / 3600.0  # rad/s² a count
VOLTAGE_UNIT: Final = 0.1  # V a count
RETURN_DELAY_UNIT: Final = 2e-6  # s a count
WATCHDOG_UNIT: Final = 0.020  # s a count
WATCHDOG_MAX: Final = 127
WATCHDOG_ERROR: Final = 0xFF  # register 98 reads -1: goals are refused until 0 is written there


def hardware_error_names(status: int) -> str:
    """What the bits of the hardware error register mean, joined by commas."""
    names = [name for bit, name in HARDWARE_ERRORS.items() if status >> bit & 1]
    return ", ".join(names) or f"unknown error bits 0x{status:02X}"
