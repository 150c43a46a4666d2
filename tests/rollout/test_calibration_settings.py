import pytest

from infgen.config import CalibrateSettings
from infgen.errors import ConfigError
from infgen.settings import build


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"method": "guess"}, "method is 'guess'; expected 'odds', 'simulate' or 'none'"),
        ({"add_bias_range": 0.0}, "add_bias_range is 0.0; expected greater than 0"),
        ({"remove_bias_range": -1.0}, "remove_bias_range is -1.0"),
        ({"max_scenes": -1}, "max_scenes is -1; expected greater than or equal to 0"),
        ({"scenes_per_unit": 0}, "scenes_per_unit is 0; expected greater than or equal"),
    ],
)
def test_impossible_values_are_refused(given, said):
    with pytest.raises(ConfigError, match=rf"calibrate\.{said}"):
        build(CalibrateSettings, given, "calibrate")
