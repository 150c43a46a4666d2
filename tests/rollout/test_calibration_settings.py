import pytest

from infgen.config import CalibrateSettings, ConfigError


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"by": "guess"}, r"calibrate\.by is 'guess'; expected odds, play or none"),
        ({"add_reach": 0.0}, r"calibrate\.add_reach is 0.0; .*calibrate\.by=odds"),
        ({"leave_reach": -1.0}, r"calibrate\.leave_reach is -1.0"),
        ({"scenes": -1}, r"calibrate\.scenes is -1; expected 0 or more"),
        ({"scenes_per_task": 0}, r"calibrate\.scenes_per_task is 0; expected 1 or more"),
    ],
)
def test_what_cannot_be_is_refused_with_the_way_out(given, told):
    with pytest.raises(ConfigError, match=told):
        CalibrateSettings(**given)
