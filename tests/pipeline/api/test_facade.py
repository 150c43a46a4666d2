"""``import infgen`` is light, and its names are those of the facade."""

import subprocess
import sys
from dataclasses import fields
from typing import get_type_hints

import pytest

import infgen
from infgen.config import RolloutSettings
from pipeline.api import MODULES
from pipeline.api.overrides import RolloutOverrides


def loaded_by(code: str) -> set[str]:
    """Top-level packages that a fresh process has loaded after some code."""
    listing = f"{code}; import sys; print(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run(
        [sys.executable, "-c", listing], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_importing_loads_nothing_and_opening_scenes_no_torch():
    assert not loaded_by("import infgen") & {"pipeline", "numpy", "torch", "polars"}
    opened = loaded_by("import infgen; infgen.open_scenes('builtin')[0]")
    assert "numpy" in opened
    assert not opened & {"torch", "zarr", "dask", "matplotlib"}


def test_every_name_is_there_and_listed():
    assert set(infgen.__all__) == set(MODULES)
    assert set(infgen.__all__) <= set(dir(infgen))
    for name in infgen.__all__:
        assert getattr(infgen, name).__module__ == f"pipeline.api.{MODULES[name]}"
    with pytest.raises(AttributeError, match="'infgen' has no attribute 'lokal'"):
        infgen.lokal  # noqa: B018


def test_overrides_are_the_settings_of_rollouts():
    named = {f.name for f in fields(RolloutSettings)}

    assert set(get_type_hints(RolloutOverrides)) == named - {"recordings"}
