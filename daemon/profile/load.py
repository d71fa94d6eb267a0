"""Load a TOML profile, validate it as `Settings`, and report all of its errors at once.

`profile.settings` defines the allowed values of each key. `profile.validation` checks combinations
of keys.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

import softfinger
from softfinger.daemon.backends import BUILT_IN, backend, known
from softfinger.daemon.errors import SettingsError, nearest
from softfinger.daemon.own_files import read_file
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.profile.validation import plausibility_warnings, problems, shown

__all__ = ["load"]

_PROFILES = Path(softfinger.__file__).parent / "config"
# Maximum file size [bytes]. The reference profile, which contains all keys, is 21 kB long.
_FILE_SIZE_MAX = 256 << 10
_DEPTH_MAX = 8  # maximum nesting depth of tables and arrays
_ERROR_COUNT_MAX = 20  # maximum number of errors reported per load
# Pattern for dotted keys with 16 or more parts. tomllib takes minutes to parse keys with thousands
# of parts.
_DEEP_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){16}""")
_WORD = re.compile(r"\w+")
_MESSAGE_START = re.compile(r"\w+ should (be |have )?")  # start of pydantic's messages


def load(
    path: Path | None = None, directory: Path | None = None, changes: Sequence[str] = ()
) -> Settings:
    """Load and validate a profile.

    Parameters
    ----------
    path
        File or one of `names`; None selects the built-in simulated hand.
    directory
        Replacement for ``{dir}`` in the port names.
    changes
        Settings such as ``loop.rate=1000``, which override the file.

    Raises
    ------
    SettingsError
        One line for each error found by `examine`, at most 20.
    """
    return _without_errors(_profile(path, directory, changes))


def examine(
    path: Path | None = None, directory: Path | None = None, changes: Sequence[str] = ()
) -> tuple[Settings, list[str], list[str]]:
    """Return a profile's settings, its errors, and warnings about settings that are probably wrong.

    An error is an unknown key, a wrong type, a violated bound or a contradiction between other
    keys. Settings whose values cannot be used have their defaults. The arguments are the same as
    for `load`. Raises SettingsError if the profile can't be read.
    """
    found = _profile(path, directory, changes)
    warnings = _without_words(plausibility_warnings(found.settings), found.unused)
    return found.settings, found.errors, [f"{found.name}: {line}" for line in warnings]


def checked(data: dict[str, Any]) -> Settings:
    """Validate the sections in ``data``. Raises SettingsError like `load`."""
    return _without_errors(_examined(data, "settings"))


class _Examined(NamedTuple):
    name: str  # name of the profile
    settings: Settings
    errors: list[str]
    unused: set[str]  # names of the keys and sections whose values cannot be used


def _profile(path: Path | None, directory: Path | None, changes: Sequence[str]) -> _Examined:
    name = str(path) if path else "built-in settings"
    data = _read(find(path), name) if path else {}
    changed = {_change(data, change) for change in changes}
    return _examined(data, name, changed, directory)


def _without_errors(found: _Examined) -> Settings:
    lines, more = found.errors[:_ERROR_COUNT_MAX], len(found.errors) - _ERROR_COUNT_MAX
    if more > 0:
        lines.append(f"{found.name}: {more} more errors")
    if lines:
        raise SettingsError("\n".join(lines))
    return found.settings


def _examined(
    data: dict[str, Any],
    name: str,
    changed: Collection[str] = (),
    directory: Path | None = None,
) -> _Examined:
    unused: set[str] = set()
    found: list[str] = []
    try:
        settings = Settings.model_validate(data)
    except ValidationError as error:
        wrong = error.errors(include_url=False)
        found = [_line(details) for details in wrong]
        unused = {str(part) for details in wrong for part in details["loc"][:2][-1:]}
        settings = Settings.model_validate(_without(data, wrong))
    if directory is not None:
        settings = _with_directory(settings, directory)
    found += _without_words((*problems(settings), *_plugin_problems(settings)), unused)
    errors = []
    for problem in found:
        # A problem may name several keys, the index of a value, or a finger in parentheses.
        keys = re.split("[:(]", problem)[0].strip().split(", ")
        is_set = any(f"{key}.".startswith(f"{each}.") for key in keys for each in changed)
        errors.append(f"{'--set' if is_set else name}: {problem}")
    return _Examined(name, settings, errors, unused)


def _without_words(lines: Iterable[str], words: set[str]) -> list[str]:
    return [line for line in lines if not words & set(_WORD.findall(line))]


def _without(data: dict[str, Any], wrong: Sequence[ErrorDetails]) -> dict[str, Any]:
    """Return a copy of ``data`` without invalid keys and invalid sections."""
    kept: dict[Any, Any] = {
        name: dict(keys) if isinstance(keys, dict) else keys for name, keys in data.items()
    }
    for section, *inside in (details["loc"] for details in wrong):
        if inside and isinstance(kept.get(section), dict):
            kept[section].pop(inside[0], None)
        else:
            kept.pop(section, None)
    return kept


def names() -> list[str]:
    """Return the names of the packaged profiles."""
    return sorted(path.stem for path in _PROFILES.glob("*.toml"))


def find(path: Path) -> Path:
    """Return the path of a profile. ``path`` is a file or the name of a packaged profile.

    A name with neither folder nor suffix must match a packaged profile or a file. Raises
    SettingsError if there is no match.
    """
    if path.suffix or path.parent != Path() or (path.exists() and not path.is_dir()):
        return path
    file = _PROFILES / f"{path.name}.toml"
    if not file.exists():
        raise SettingsError(
            f"{path}: profile not found; expected a file or one of {', '.join(names())}"
        )
    return file


def profile_text(path: Path) -> str:
    """Return a profile's text.

    Raises the same errors as `read_file`. Raises UnicodeDecodeError if the file is not UTF-8 text.
    Raises RecursionError if a key has too many parts.
    """
    text = read_file(path, _FILE_SIZE_MAX).decode("utf-8-sig")
    if _DEEP_KEY.search(text):
        raise RecursionError
    return text


def without_files(settings: Settings) -> Settings:
    """Remove all file paths from settings that were loaded from another user's file."""
    return settings.changed(
        tactile={"calibration": ("", ""), "recording": ("", "")},
        control={"envelope": ""},
        access={"keys": ""},
    )


def _read(path: Path, name: str) -> dict[str, Any]:
    try:
        raw = tomllib.loads(profile_text(path))
        return {key: _tuples(item) for key, item in raw.items()}
    except OSError as error:
        hint = (
            f"; `{path.stem}` without path and suffix selects the packaged profile"
            if path.stem in names()
            else ""
        )
        raise SettingsError(f"{name}: can't be read: {error.strerror}{hint}") from None
    except UnicodeDecodeError as error:
        raise SettingsError(f"{name}: not UTF-8 text: {error.reason}") from None
    except RecursionError:
        raise SettingsError(f"{name}: tables or arrays are nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, or ValueError for an integer with 5000 digits
        raise SettingsError(f"{name}: not TOML: {error}") from None


def _change(data: dict[str, Any], change: str) -> str:
    """Apply one ``section.key=value`` change and return the changed key. Raises SettingsError."""
    key, equals, text = change.partition("=")
    *sections, inner = key.strip().split(".")
    if not (equals and sections and all(sections) and inner):
        raise SettingsError(f"--set: found {change!r}, expected section.key=value")
    try:
        value = _tuples(tomllib.loads(f"value = {text}")["value"])
    except (ValueError, RecursionError):
        value = text.strip()  # The shell removes the quotes around a string.
    held = data
    for section in sections:
        held = held.setdefault(section, {})
        if not isinstance(held, dict):
            raise SettingsError(
                f"--set: found {change!r}, but {section} is not a table; expected section.key=value"
            )
    held[inner] = value
    return key.strip()


def _tuples(value: Any, depth: int = 0) -> Any:
    """Convert lists to tuples in nested tables and lists.

    Raises RecursionError if the nesting is deeper than `_DEPTH_MAX`. Raises ValueError if an
    integer is outside TOML's range.
    """
    if depth > _DEPTH_MAX:
        raise RecursionError
    if isinstance(value, dict):
        return {key: _tuples(item, depth + 1) for key, item in value.items()}
    if isinstance(value, list):
        return tuple(_tuples(item, depth + 1) for item in value)
    # Reject large integers here, because Python refuses to print an integer with 5000 digits.
    if isinstance(value, int) and value.bit_length() > 63:
        raise ValueError("an integer of more than 64 bits")
    return value


def _plugin_problems(settings: Settings) -> Iterator[str]:
    """Yield the errors in plugin tables."""
    tables = settings.plugins.tables
    for each in (
        backend("servos", settings.servos.backend),
        backend("tactile", settings.tactile.backend),
        backend("shapes", settings.simulation.object_shape),
    ):
        try:
            each.options(tables)
        except ValidationError as error:
            above = ["plugins", each.name]
            yield from (_line(every, above, each.section) for every in error.errors())
        if each.name in tables and each.section is None:
            yield (
                f"plugins.{each.name}: found settings, but {each.source} does not accept "
                "settings; remove them"
            )
    for name in tables:
        if not any(name in known(kind) for kind in BUILT_IN):
            yield (
                f"plugins.{name}: found settings, but no plugin of this name is installed; "
                "install it or remove the settings"
            )


def _line(
    details: ErrorDetails, above: Sequence[str] = (), model: type[BaseModel] | None = Settings
) -> str:
    """Format one error. ``above`` is the path of the table that ``model`` describes."""
    inside = [str(part) for part in details["loc"]]
    location = [*above, *inside]
    key = shown(".".join(location))[1:-1]
    if details["type"] == "extra_forbidden":
        return f"{key}: unknown key{nearest(location[-1], _fields(inside[:-1], model))}"
    if details["type"] in ("model_type", "model_attributes_type", "dict_type"):
        return f"{key}: found {shown(details['input'])}, expected a table"
    if details["type"] == "missing":
        return f"{key}: not found in {shown(details['input'])}, expected a value"
    expected = _MESSAGE_START.sub("", details["msg"], count=1)
    if details["type"] == "less_than_equal" and not above and _is_length(location):
        metres = 1e-3 * float(details["input"])
        expected += f" m; {details['input']:g} mm is {metres:g} m" if metres < 1.0 else " m"
    return f"{key}: found {shown(details['input'])}, expected {expected}"


def _is_length(location: list[str]) -> bool:
    extra = _fields(location[:1], Settings)[location[1]].json_schema_extra
    return isinstance(extra, dict) and extra.get("unit") == "m"


def _fields(location: list[str], model: Any) -> dict[str, Any]:
    """Return the fields of the table at the path ``location`` within ``model``.

    Returns an empty dict if the path leads through a list or an optional table of a plugin.
    """
    for part in location:
        model = model.model_fields[part].annotation
        if not (isinstance(model, type) and issubclass(model, BaseModel)):
            return {}
    return model.model_fields  # type: ignore[no-any-return]


def _with_directory(settings: Settings, directory: Path) -> Settings:
    servo, left, right = (
        port.replace("{dir}", str(directory))
        for port in (settings.servos.port, *settings.tactile.port)
    )
    return settings.changed(servos={"port": servo}, tactile={"port": (left, right)})
