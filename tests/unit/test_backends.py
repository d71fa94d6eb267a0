"""The tables of backends: each name leads to something that can be made."""

from __future__ import annotations

import pytest

from softfinger.daemon.backends import BUILT_IN, Backend
from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.load import load


@pytest.mark.parametrize("table", BUILT_IN.values(), ids=BUILT_IN)
def test_every_place_is_there(table: dict[str, Backend]) -> None:
    for name, backend in table.items():
        assert callable(backend.load()) or name == "none"


def test_settings_take_the_tables_names_and_name_them_when_one_is_wrong() -> None:
    for name in BUILT_IN["shapes"]:
        settings = load(changes=[f"simulation.object_shape={name}"])
        assert settings.simulation.object_shape == name
    with pytest.raises(SettingsError) as caught:
        load(changes=["tactile.backend=flexitack"])
    assert all(f"'{name}'" in str(caught.value) for name in BUILT_IN["tactile"])
