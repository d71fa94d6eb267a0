"""Test that registers changed by another program are reported, corrected or restored."""

import json
from typing import Any

import pytest

from softfinger.daemon.clock import RealClock
from softfinger.daemon.diagnosis import devices
from softfinger.daemon.diagnosis.register_file import restore_registers, save_registers
from softfinger.daemon.errors import ServoError
from softfinger.daemon.servos import control_table as reg
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.servos.control_table import MODELS
from softfinger.daemon.servos.dynamixel import DynamixelServos
from softfinger.daemon.servos.provisioning import provision
from softfinger.daemon.servos.register_table import required_registers
from softfinger.daemon.simulation.servo_model.registers import ControlTable
from tests.conftest import until
from tests.harness.servos import RunningBus, backend_settings, connected

LEFT = "servo 1 (left)"
FIX = "`softfinger doctor --fix`"
# Register values that another program may leave in a servo, each with the status and text of the
# doctor's finding.
EEPROM = [
    (reg.RETURN_DELAY_TIME, 250, "FAIL", "return delay is 500 µs, expected at most 50 µs"),
    (reg.SHADOW_ID, 2, "FAIL", "shadow ID is 2: the servo also executes commands for the servo"),
    (
        reg.HOMING_OFFSET,
        100,
        "FAIL",
        "homing offset is 100 counts, expected 0: it shifts this joint's",
    ),
    (reg.TEMPERATURE_LIMIT, 50, "warn", "temperature limit is 50 °C, expected 70 to 80 °C"),
    (reg.MAX_VOLTAGE_LIMIT, 130, "warn", "max voltage limit is 130 × 0.1 V, expected 160 × 0.1 V"),
    (
        reg.MIN_VOLTAGE_LIMIT,
        110,
        "warn",
        "min voltage limit is 110 × 0.1 V, expected 0 to 95 × 0.1 V",
    ),
    (reg.PWM_LIMIT, 300, "FAIL", "PWM limit is 300, expected 885: the motor does not get"),
    (
        reg.CURRENT_LIMIT,
        100,
        "FAIL",
        "current limit is 0.269 A, expected at least safety.current_max = 1.2 A",
    ),
    (
        reg.VELOCITY_LIMIT,
        5,
        "warn",
        "velocity limit is 0.12 rad/s at the joint, expected at least 3 rad",
    ),
    (
        reg.STARTUP_CONFIGURATION,
        1,
        "FAIL",
        "startup configuration is 1, expected 0: at power-up the servo sw",
    ),
    (
        reg.SHUTDOWN,
        20,
        "warn",
        "shutdown is 20, expected 52: the servo does not switch torque off after overload",
    ),
]
RAM = [
    (reg.POSITION_D_GAIN, 3000),
    (reg.POSITION_I_GAIN, 50),
    (reg.POSITION_P_GAIN, 100),
    (reg.FEEDFORWARD_2ND_GAIN, 7),
    (reg.FEEDFORWARD_1ST_GAIN, 8),
    (reg.GOAL_PWM, 200),
    (reg.PROFILE_ACCELERATION, 2),
    (reg.PROFILE_VELOCITY, 5),
]


def put(bus: RunningBus, address: int, value: int, servo: int = 0) -> None:
    """Set a register, as another program would."""
    bus.call(lambda: bus.servo(servo).table.set(address, value))


def held(bus: RunningBus, address: int, servo: int = 0) -> int:
    return int(bus.call(lambda: bus.servo(servo).table.get(address)))


def told(bus: RunningBus, **servos: Any) -> list[Finding]:
    """Return the doctor's findings about the left servo."""
    settings = backend_settings(bus.port, **servos)
    return [each for each in devices.check_servos(settings) if each.subject == LEFT]


@pytest.mark.parametrize(("address", "value", "status", "text"), EEPROM)
def test_changed_eeprom_registers_are_reported_and_repaired(bus, address, value, status, text):
    put(bus, address, value)
    (found,) = [each for each in told(bus) if each.status == status and each.text.startswith(text)]
    assert found.fix.startswith(FIX)
    if status == "FAIL":
        with pytest.raises(ServoError, match=text[:20]):
            connected(bus)
    fixed = [each for each in provision(backend_settings(bus.port)) if each.subject == LEFT]
    assert [each.status for each in fixed] == ["fixed"]
    connected(bus).close()
    assert [each.status for each in told(bus)] == ["pass"]


@pytest.mark.parametrize("reboots", [False, True])
def test_arm_overwrites_changed_ram_registers(bus, connect, reboots):
    if not reboots:
        for address, value in RAM:
            put(bus, address, value)
        notes = [each for each in told(bus) if each.status == "note"]
        assert len(notes) == len(RAM)
        assert notes[-1].text == (
            "profile velocity is 5, expected 0: set by another program; `arm` corrects it"
        )
    backend = connect(bus)
    if reboots:
        backend.torque_on()
        bus.call(lambda: bus.servo(0).reboot(bus.now()))
        until(lambda: bus.call(lambda: bus.servo(0).awake(bus.now())))
        for address, value in RAM:  # Another program immediately writes to the servo.
            put(bus, address, value)
    backend.torque_on()
    model = MODELS["XM430-W350"]
    d, i, p = model.position_gains
    expected = [d, i, p, 0, 0, 885, 0, 0]
    assert [held(bus, address) for address, _ in RAM] == expected


def test_factory_settings_of_every_model_pass_the_checks():
    """Only mode and return delay may fail, because their factory settings never suit the hand."""
    for name, model in MODELS.items():
        mode = "current-based position" if model.senses_current else "position"
        small = {"current_max": min(1.2, model.stall_current)}
        settings = backend_settings("none", model=name, mode=mode)
        settings = settings.changed(safety=small)
        table = ControlTable(model, model.firmware)
        table.set(reg.GOAL_PWM, 885)
        wrong = {
            row.register.name
            for row in required_registers(model, settings, 0, model.firmware)
            if row.wrong_in(bytes(table.memory)) is not None
        }
        assert wrong <= {"return delay", "operating mode"}, name


def test_stall_torques_fit_current_speed_and_gears():
    """If servos have the same motor, their torque constants are inversely proportional to speed."""
    for name, model in MODELS.items():
        torque, current, voltage = model.stall
        assert 0.5 < torque * model.no_load_speed / (voltage * current) < 1.2, name
    found, same_motor = MODELS["XW430-T200"], MODELS["XH430-W210"]
    constant = same_motor.torque_constant * same_motor.no_load_speed / found.no_load_speed
    assert found.torque_constant == pytest.approx(constant, rel=0.05)


def test_registers_are_saved_and_restored(bus, tmp_path):
    path, settings = tmp_path / "servos.json", backend_settings(bus.port)
    put(bus, reg.PWM_LIMIT, 300)
    put(bus, reg.PROFILE_VELOCITY, 5)
    put(bus, reg.HOMING_OFFSET, -77)
    before = bus.memory(0)[: reg.RAM]
    assert [each.status for each in save_registers(settings, path)] == ["note", "note"]
    stored = json.loads(path.read_text(encoding="utf-8"))["servos"]
    assert (stored[0]["id"], stored[0]["model"]) == (1, "XM430-W350")
    assert stored[0]["registers"]["homing offset"] == -77
    provision(settings)
    assert held(bus, reg.HOMING_OFFSET) == held(bus, reg.PROFILE_VELOCITY) == 0
    done = [str(each) for each in restore_registers(settings, path)]
    assert done == [
        f"{LEFT}: homing offset 0 → -77",
        f"{LEFT}: PWM limit 885 → 300",
        f"{LEFT}: profile velocity 0 → 5",
    ]
    assert bus.memory(0)[: reg.RAM] == before


def test_invalid_register_files_are_refused(bus, tmp_path):
    path, settings = tmp_path / "servos.json", backend_settings(bus.port)
    with pytest.raises(ServoError, match="No such file"):
        restore_registers(settings, path)
    strange = '{"servos": [{"id": 1, "model": "X", "firmware": 1, "registers": {"a": 1}}]}'
    for text in ("{}", "[", strange):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(
            ServoError, match="expected a file written by `softfinger doctor --save`"
        ):
            restore_registers(settings, path)
    path.unlink()
    save_registers(settings, path)
    other = path.read_text(encoding="utf-8").replace("XM430-W350", "XM430-W210", 1)
    path.write_text(other, encoding="utf-8")
    left, *right = restore_registers(settings, path)
    assert left.text.endswith("contains the registers of an XM430-W210, found XM430-W350")
    assert right == []


# Servos in unexpected states or of unexpected types


def test_extra_turns_of_the_position_are_removed_by_a_reboot(bus, connect):
    bus.call(lambda: setattr(bus.servo(0)._joint, "_turns", -2))
    (found,) = [each for each in told(bus) if each.status == "FAIL"]
    assert "the servo has counted 2 turns too many" in found.text
    assert (
        found.fix
        == "reboot the servo: switch its supply off and on again, or run `softfinger doctor --fix`"
    )
    (fixed,) = [each for each in provision(backend_settings(bus.port)) if each.subject == LEFT]
    assert "rebooted (position wrong by at least one turn" in fixed.text
    assert [each.status for each in told(bus)] == ["pass"]


def test_an_error_that_a_wrong_limit_causes_is_corrected_with_the_limit(bus):
    put(bus, reg.MIN_VOLTAGE_LIMIT, 140)
    until(lambda: held(bus, reg.HARDWARE_ERROR_STATUS) == 1)
    supply = [each for each in told(bus) if each.text.startswith("supply voltage is ")]
    assert [each.fix for each in supply] == [FIX]
    fixed = [each.text for each in provision(backend_settings(bus.port)) if each.subject == LEFT]
    assert fixed == [
        "min voltage limit 140 → 95",
        "rebooted (hardware error: input voltage outside its limits)",
    ]
    assert [each.status for each in told(bus)] == ["pass"]


def test_an_error_that_a_reboot_does_not_clear_is_reported(bus):
    bus.fault("undervoltage=1")
    until(lambda: held(bus, reg.HARDWARE_ERROR_STATUS) == 1)
    (left,) = [each for each in provision(backend_settings(bus.port)) if each.subject == LEFT]
    assert left.text == "hardware error: input voltage outside its limits, even after a reboot"
    assert left.fix == "remove the cause, and run the command again"


def test_no_reboot_is_advised_for_a_reversed_drive_mode(bus):
    put(bus, reg.DRIVE_MODE, 1)
    fixes = [each.fix for each in told(bus) if each.status == "FAIL"]
    assert fixes == ["run `softfinger calibrate joints`, because the drive mode is reversed"]
    assert provision(backend_settings(bus.port)) == []


def test_a_servo_with_protocol_1_is_recognised(bus):
    put(bus, reg.PROTOCOL_TYPE, 1)
    text = "replies in Protocol 1.0, expected Protocol 2.0"
    (found,) = told(bus, open_timeout=0.1)
    assert (found.status, found.text) == ("FAIL", text)
    backend = DynamixelServos(backend_settings(bus.port, reply_timeout=0.3), RealClock())
    with pytest.raises(ServoError, match=f"left\\): {text}"):
        backend.connect()
    backend.close()


def test_the_registers_of_another_model_are_not_compared(running):
    bus = running(servos={"model": "XL330-M288"})
    assert [each.text for each in told(bus)] == ["is an XL330-M288, expected an XM430-W350"]


def test_an_unknown_model_lists_the_known_ones(bus):
    put(bus, reg.MODEL_NUMBER, 9999)
    (found,) = [each for each in told(bus) if each.status == "FAIL"]
    assert found.text == "has unknown model number 9999, expected 1020 (XM430-W350)"
    assert all(name in found.fix for name in ("XH540-W270", "MX-64", "XC330-M181"))
