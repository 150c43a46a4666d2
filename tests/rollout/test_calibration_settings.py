import pytest

from infgen.config import CalibrateSettings
from infgen.errors import ConfigError


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"by": "guess"}, r"calibrate\.by is 'guess'; expected odds, play or none"),
        (
            {"add_bias_range": 0.0},
            r"calibrate\.add_bias_range is 0.0; .*calibrate\.by=odds",
        ),
        ({"remove_bias_range": -1.0}, r"calibrate\.remove_bias_range is -1.0"),
        ({"scenes": -1}, r"calibrate\.scenes is -1; expected 0 or more"),
        ({"scenes_per_unit": 0}, r"calibrate\.scenes_per_unit is 0; expected 1 or more"),
    ],
)
def test_what_cannot_be_is_refused_with_the_way_out(given, told):
    with pytest.raises(ConfigError, match=told):
        CalibrateSettings(**given)
