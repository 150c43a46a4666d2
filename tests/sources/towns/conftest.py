from importlib.util import find_spec
from pathlib import Path

import pytest

from infgen.sources.towns.streets.network import read_network

needs_sumo = pytest.mark.skipif(find_spec("sumo") is None, reason="needs the extra towns")
needs_libsumo = pytest.mark.skipif(
    find_spec("libsumo") is None, reason="needs libsumo, of the extra towns"
)


@pytest.fixture(scope="session")
def crossing():
    """A street of two lanes with an island meets one with parked cars, at a light.

    netconvert wrote the file. East to west (edges e0 and e2): from the middle a metre of
    island, two lanes of 3.5 m, 0.3 m of gutter; north to south (e1 and e3): a lane of 3 m,
    2.2 m for parked cars. Arms end 100 m away; "f" leads outwards, "b" inwards.
    """
    return read_network(Path(__file__).parent / "crossing.net.xml")
