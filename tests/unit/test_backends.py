"""The tables of backends: each name leads to something that can be made."""

from __future__ import annotations

import pytest

from softfinger.daemon.backends import NONE, SERVOS, SHAPES, TACTILE, Backend
from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.load import load


@pytest.mark.parametrize("backend", [*{*SERVOS.values(), *TACTILE.values(), *SHAPES.values()}])
def test_every_place_is_there(backend: Backend) -> None:
    assert backend is NONE or callable(backend.load())


def test_settings_take_the_tables_names_and_name_them_when_one_is_wrong() -> None:
    for name in SHAPES:
        settings = load(changes=[f"simulation.object_shape={name}"])
        assert settings.simulation.object_shape == name
    with pytest.raises(SettingsError) as caught:
        load(changes=["tactile.backend=flexitack"])
    assert all(f"'{name}'" in str(caught.value) for name in TACTILE)
