"""Test that profiles are loaded, and that all errors of a profile are listed at once."""

import json
import re
import tomllib
from pathlib import Path

import pytest

from softfinger.daemon.backends import BUILT_IN, Backend, known
from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile import reference
from softfinger.daemon.profile.factory import make_table
from softfinger.daemon.profile.fields import Section, setting
from softfinger.daemon.profile.load import load, names
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.profile.validation import _set_depths, plausibility_warnings

CONFIG = Path(__file__).parents[2] / "config"


def report(tmp_path: Path, text: str, directory: Path | None = None) -> list[str]:
    path = tmp_path / "profile.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SettingsError) as caught:
        load(path, directory)
    lines = str(caught.value).split("\n")
    assert all(line.startswith(f"{path}: ") for line in lines)
    return [line.removeprefix(f"{path}: ") for line in lines]


def test_without_a_file_the_built_in_simulated_hand_is_used():
    assert load() == Settings()
    assert load().servos.backend == "simulated"


def test_sim_profile_contains_every_key_with_its_default():
    path = CONFIG / "sim.toml"
    assert path.read_text(encoding="utf-8") == reference.profile()
    assert load(path) == Settings()
    written = tomllib.loads(reference.profile())
    for name, section in Settings():
        assert list(written[name]) == list(type(section).model_fields), name


def test_the_editor_schema_has_description_unit_and_default_of_every_key():
    schema = json.loads(reference.schema_text())
    keys = reference.every_key()
    assert len(keys) > 180
    for key in keys:
        declared = schema["properties"][key.section]["properties"][key.name]
        assert declared["description"] == key.meaning
        assert declared.get("unit", "") == key.unit
        assert declared["default"] == json.loads(key.default)


@pytest.mark.parametrize(
    ("key", "allowed"),
    [
        ("tip.radius", "0.0001 to 1"),
        ("tactile.noise", "> 0"),
        ("tactile.dead", "integer, 0 to 255"),
        ("estimator.free_gain", '"auto", true, false'),
        ("servos.reply_timeout", "> 0, ≤ 1"),
        ("safety.overruns_fault", "integer, ≥ 1"),
        ("stream.address", ""),
    ],
)
def test_the_reference_lists_the_allowed_values(key, allowed):
    shown = {f"{each.section}.{each.name}": each.allowed for each in reference.every_key()}
    assert shown[key] == allowed


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.toml")), ids=lambda path: path.name)
def test_every_profile_is_valid_and_refers_to_the_schema(path, tmp_path):
    assert path.read_text(encoding="utf-8").startswith("#:schema ./schema.json\n# ")
    settings = load(path, tmp_path)
    assert "{dir}" not in settings.servos.port + "".join(settings.tactile.port)


@pytest.mark.parametrize("name", names())
def test_a_bare_name_is_a_packaged_profile_in_any_folder(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load(Path(name), tmp_path) == load(CONFIG / f"{name}.toml", tmp_path)
    # A local file takes precedence over a built-in profile.
    (tmp_path / name).write_text("loop.rate = 123.0\n")
    assert load(Path(name)).loop.rate == 123.0


@pytest.mark.parametrize("table", BUILT_IN.values(), ids=BUILT_IN)
def test_every_backend_is_registered(table):
    for name, backend in table.items():
        assert callable(backend.load()) or name == "none"


def test_an_unknown_name_is_reported_with_the_known_ones():
    with pytest.raises(SettingsError) as caught:
        load(Path("hill"))
    assert str(caught.value) == (
        f"hill: profile not found; expected a file or one of {', '.join(names())}"
    )


def test_all_errors_are_in_one_report_with_key_found_and_expected(tmp_path):
    lines = report(
        tmp_path,
        """
        [hand]
        pivot_seperation = 0.1
        finger_length = "long"
        q_min = [1, 2, 3]
        [servos]
        baud = 1.5
        ids = [1, 300]
        backend = "dynamxl"
        [tip]
        radius = -1
        [lop]
        rate = 3
        [tactile]
        noise = nan
        [scene]
        fingers = "left"
        object_model = 1
        """,
    )
    *most, last = map(repr, known("servos"))
    assert sorted(lines) == sorted(
        [
            "hand.pivot_seperation: unknown key; nearest: pivot_separation",
            'hand.finger_length: found "long", expected a valid number',
            "hand.q_min: found [1, 2, 3], expected at most 2 items after validation, not 3",
            "servos.baud: found 1.5, expected a valid integer",
            "servos.ids.1: found 300, expected less than or equal to 252",
            f'servos.backend: found "dynamxl", expected {", ".join(most)} or {last}',
            "tip.radius: found -1, expected greater than or equal to 0.0001",
            "lop: unknown key; nearest: loop",
            "tactile.noise: found nan, expected a finite number",
            'scene.fingers: found "left", expected a valid tuple',
            "scene.object_model: found 1, expected a valid boolean",
        ]
    )


def test_wrong_values_do_not_hide_contradictions_between_other_keys(tmp_path):
    lines = report(
        tmp_path,
        """
        [hand]
        q_min = [0.5, -0.5]
        q_max = [0.2, 1.0]
        open_angle = [0.0, "wide"]
        [tip]
        radius = 20
        [safety]
        d_max = 0.03
        [servos]
        ids = [3, 3]
        """,
    )
    assert [line.split(":")[0] for line in lines] == [
        "hand.open_angle.1",
        "tip.radius",
        "hand.q_max",
        "servos.ids",
        # safety.d_max is not reported, because its limit depends on the wrong radius.
    ]


def test_only_a_similar_key_is_suggested(tmp_path):
    for key, hint in (("nosie", "; nearest: noise"), ("resolution", ""), ("x", "")):
        (line,) = report(tmp_path, f"[tactile]\n{key} = 1")
        assert line == f"tactile.{key}: unknown key{hint}"


def test_at_most_20_errors_are_told_and_the_others_counted(tmp_path):
    lines = report(tmp_path, "".join(f"x{k} = 1\n" for k in range(30)))
    assert len(lines) == 21
    assert lines[-1] == "10 more errors"


def test_all_contradictions_between_keys_are_reported(tmp_path):
    lines = report(
        tmp_path,
        """
        [scene]
        fingers = ["left", "left"]
        [hand]
        q_min = [0.5, -0.5]
        q_max = [0.2, 1.0]
        open_angle = [0.0, 2.0]
        [servos]
        backend = "dynamixel"
        ids = [3, 3]
        port = "{dir}/servos"
        [loop]
        clock = "virtual"
        [material]
        law = "points"
        strain = [0.0, 0.1]
        stress = [0.0]
        """,
    )
    keys = [line.split(":")[0] for line in lines]
    assert keys == [
        "scene.fingers",
        "servos.backend, tactile.backend",
        "hand.q_max",
        "hand.open_angle",
        "servos.ids",
        "servos.port",
        "material.stress",
        "loop.clock",
    ]


def test_a_missing_or_binary_file_is_reported(tmp_path):
    path = tmp_path / "profile.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SettingsError, match="not UTF-8 text"):
        load(path)
    with pytest.raises(SettingsError, match=r"absent\.toml: can't be read"):
        load(tmp_path / "absent.toml")
    with pytest.raises(
        SettingsError, match=r"No such file .*; `hil` without path and suffix selects"
    ):
        load(tmp_path / "config" / "hil.toml")


def test_dir_sets_the_ports(tmp_path):
    path = tmp_path / "profile.toml"
    path.write_text(
        '[servos]\nport = "{dir}/servos"\n[tactile]\nport = ["{dir}/a", "/dev/b"]\n',
        encoding="utf-8",
    )
    settings = load(path, Path("/tmp/hand"))
    assert settings.servos.port == "/tmp/hand/servos"
    assert settings.tactile.port == ("/tmp/hand/a", "/dev/b")


def test_an_unknown_model_is_reported_with_all_other_errors(tmp_path):
    lines = report(tmp_path, '[servos]\nmodel = "XM999"\nbaud = 1\n[loop]\nrate = 1.0')
    assert [line.split(":")[0] for line in lines] == ["servos.baud", "servos.model", "loop.rate"]
    assert 'found "XM999", expected one of XM430-W350, ' in lines[1]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('[servos]\nbackend = "dynamixel"', "servos.backend, tactile.backend: found dynamixel and"),
        (
            'servos.backend = "none"\ntactile.backend = "none"',
            "servos.backend, tactile.backend: found none and none, expected at least one",
        ),
        ("[loop]\nrate = = 3\n", "not TOML: Invalid value (at line 2"),
        (
            "[servos]\nwatchdog = 0.003",
            "servos.watchdog: found 0.003 s, expected more than 0.00",
        ),
        ('[stream]\naddress = "tcp://127.0.0.1:99999"', "stream.address: found"),
        ('[stream]\naddress = "tcp://*:9872"', "stream.address: found"),
        ('[stream]\naddress = "inproc://x"', "stream.address: found"),
        ('[stream]\nlatest = "tcp://10.0.0.2:9874"', "stream.latest: found"),
        ('[stream]\nlatest = "tcp://127.0.0.1:9872"', "stream.latest: found"),
        ('[commands]\naddress = "tcp://10.0.0.2:9873"', "commands.address: found"),
        ('access.ipc_mode = "0777"', "access.ipc_mode: found"),
        ('[commands]\naddress = "ipc://"', "commands.address: found"),
        ('[commands]\naddress = "ipc://a\\u0000b"', 'commands.address: found "ipc://a?b"'),
        ('[commands]\naddress = "tcp://127.0.0.1:9872"', "commands.address: found"),
        ("servos = 3", "servos: found 3, expected a table"),
        ("[[loop]]\nrate = 100.0", "loop: found [a table], expected a table"),
        (
            "[tactile]\npitch = 1.3",
            "tactile.pitch: found 1.3, expected less than or equal to 0.05 m; 1.3 mm is 0.0013 m",
        ),
        (
            "[tip]\nradius = 20",
            "tip.radius: found 20, expected less than or equal to 1 m; 20 mm is 0.02 m",
        ),
        ("[tactile]\nrate = 1e300", "tactile.rate: found 1e+300, expected less than or equal to"),
        ("[loop]\nrate = 1979-05-27", "loop.rate: found 1979-05-27, expected a valid number"),
        ('"\\u001b[31m" = 1', "?[31m: unknown key"),
        (
            "[tactile]\nrows = 4\ncols = 4\ndead = [[], "
            f"{[[i, j] for i in range(4) for j in range(4)]}]",
            "tactile.dead: found all cells for right, expected at least one",
        ),
        (
            "[safety]\nframe_age_hold = 20.0",
            "safety.frame_age_hold: found 20, expected less than",
        ),
        (
            '[control]\nlaw = "upright"\ndither_torque = 3.0',
            "control.dither_torque: found 3 N·m, expected at most 2.136 N·m",
        ),
        (
            '[control]\nlaw = "upright"\ndither_frequency = 50.0\n[loop]\nrate = 200.0',
            "control.dither_frequency: found 50 Hz, expected at most 25 Hz",
        ),
        (
            '[task]\nname = "demo"\nforce = 500.0',
            "task.force: found 500 N, expected more than 0.5 N and at",
        ),
        (".".join(["x"] * 3000) + " = 1", "tables or arrays are nested too deeply"),
        (
            "[tactile]\nrows = 4\ncols = 4\nblur = 0.005",
            "tactile.blur: found 0.005 m, expected at most 0.0026",
        ),
        ("x = " + "9" * 5000, "not TOML: "),
        (
            "[tip]\nradius = 0.010",
            "safety.d_max: found 0.012 m, expected at most 0.01 m, the tip's radius",
        ),
        (
            '[material]\nlaw = "points"\nstrain = [0.0, 0.2, 0.1]\nstress = [0.0, 1.0, 2.0]',
            "material.strain, material.stress: ",
        ),
        (
            '[material]\nlaw = "points"\nstrain = [0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0]\n'
            "stress = [1e4, 2e4, 3e4, 6e4, 12e4, 18e4, 24e4]\nforce_error_max = 0.01",
            "material.strain, material.stress: the material law deviates from the measured points",
        ),
    ],
)
def test_absurd_settings_are_reported_in_one_line(tmp_path, text, line):
    lines = report(tmp_path, text)
    assert lines[0].startswith(line), lines
    assert all(len(each) < 300 for each in lines)


def test_command_line_changes_override_the_file_and_are_checked_with_it(tmp_path):
    file = tmp_path / "my.toml"
    file.write_text("loop.rate = 250.0\n[tip]\nradius = 0.015\n")
    changes = ["loop.rate=1000", "tactile.backend=none", 'scene.fingers=["left"]']
    settings = load(file, changes=changes)
    assert (settings.loop.rate, settings.tip.radius) == (1000.0, 0.015)
    assert settings.tactile.backend == "none"
    assert settings.scene.fingers == ("left",)
    with pytest.raises(SettingsError) as report:
        load(file, changes=["loop.rate=fast", "tip.radios=0.02"])
    assert str(report.value).splitlines() == [
        "--set: tip.radios: unknown key; nearest: radius",
        '--set: loop.rate: found "fast", expected a valid number',
    ]
    real = ["servos.backend=dynamixel", "tactile.backend=flexitac"]
    with pytest.raises(SettingsError, match=r"^--set: tactile\.port \(right\): found \"/dev/a\""):
        load(changes=[*real, 'tactile.port=["/dev/a", "/dev/a"]'])


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("servos.ids=[1,300]", "servos.ids.1: found 300, expected less than or equal to 252"),
        ("servos.backend=dynamixel", "servos.backend, tactile.backend: found dynamixel and"),
        ("tip.relaxation=[1,1]", "tip.relaxation.2: not found in [1, 1], expected a value"),
    ],
)
def test_a_change_is_named_as_the_cause_of_its_errors(tmp_path, change, told):
    file = tmp_path / "my.toml"
    file.write_text("servos.ids = [1, 2]\n")
    with pytest.raises(SettingsError, match=f"^--set: {re.escape(told)}"):
        load(file, changes=[change])


@pytest.mark.parametrize("change", ["loop.rate", "rate=3", "=", ".=1", "loop.=1", "loop.rate.x=1"])
def test_a_change_without_a_key_is_reported(change):
    with pytest.raises(SettingsError, match=r"^--set: found .* expected section\.key=value"):
        load(Path("sim"), changes=[change])


@pytest.mark.parametrize("text", ["sub.gian=1", "subs=[{gian=1}]", "named={a={gian=1}}"])
def test_an_unknown_key_in_a_nested_table_of_a_plugin_is_reported(monkeypatch, text):
    class Sub(Section):
        gain: float = 1.0

    class Own(Section):
        sub: Sub | None = None
        subs: tuple[Sub, ...] = ()
        named: dict[str, Sub] = setting({}, "", "")

    own = Backend(lambda: None, name="own", source="plugin own", section=Own)
    monkeypatch.setitem(BUILT_IN["tactile"], "own", own)
    changes = ["servos.backend=none", "tactile.backend=own", f"plugins.own.{text}"]
    with pytest.raises(SettingsError, match=r"plugins\.own\.[a-z0.]*\.gian: unknown key"):
        load(changes=changes)


def test_addresses_outside_this_machine_require_keys(tmp_path):
    path = tmp_path / "far.toml"
    path.write_text('commands.address = "tcp://10.0.0.2:9873"\n', encoding="utf-8")
    with pytest.raises(SettingsError, match=r"require access\.keys"):
        load(path)
    for address in ("tcp://10.0.0.2:9873", "tcp://*:9873", "tcp://hand.lan:9873", "tcp://[::]:9"):
        path.write_text(
            f'commands.address = "{address}"\naccess.keys = "/etc/softfinger/keys"\n',
            encoding="utf-8",
        )
        assert load(path).commands.address == address


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ([], ""),
        (["control.force_default=24", "safety.d_max=0.007"], "control.force_default: found 24 N, "
         "which compresses the tip by 7.27 mm"),
        (["task.name=demo", "task.force=26", "safety.current_max=1"], "task.force: found 26 N, "
         "expected at most 22.2 N, the force at safety.current_max = 1 A on this finger"),
        (["servos.model=XL330-M288"], "safety.force_max: found 30 N, which allows a grip "
         "force of 27 N, but the stall torque of XL330-M288 limits the force of this finger "
         "to 6.5 N"),
        (["servos.model=XL330-M288", "servos.backend=none"], ""),
        (["control.joint_friction=0.26"], ""),
        (["control.joint_friction=0.27"], "control.approach_current: found 0.15 A (0.267 N·m), "
         "expected a torque above control.joint_friction = 0.27 N·m; increase it"),
        (["control.joint_friction=0.27", "servos.backend=none"], ""),
    ],
)  # fmt: skip
def test_forces_that_the_hand_does_not_have_are_warned_of(changes, told):
    settings = load(changes=changes)
    warnings = plausibility_warnings(settings)
    assert len(warnings) == bool(told)
    assert " ".join(warnings).startswith(told)


@pytest.mark.parametrize("law", ["constant", "table_i"])
def test_the_displacement_at_a_force_is_the_contact_tables(law):
    settings = load(changes=[f"material.law={law}"])
    table = make_table(settings)
    for force in (0.6, 5.0, 26.0):
        changes = [f"material.law={law}", f"control.force_default={force}"]
        ((_, _, d),) = _set_depths(load(changes=changes))
        assert table(d, 0.0).force == pytest.approx(force, rel=0.03)
