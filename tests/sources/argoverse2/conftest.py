"""Small folders of Argoverse 2's layout, written by the example that writes them."""

import importlib
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.fixture(scope="session")
def made():
    """The module ``examples/other_sources.py``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        return importlib.import_module("other_sources")
