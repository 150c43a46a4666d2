import base64
import re
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from infgen.views.player.columns import PayloadError, pack_columns, unpack_columns

COLUMN = st.sampled_from([np.int8, np.int16, np.int32]).flatmap(
    lambda agent_type: arrays(agent_type, st.integers(0, 20))
)


@given(st.dictionaries(st.text(max_size=4), COLUMN, max_size=4))
def test_columns_come_back_as_they_were(columns):
    about, found = unpack_columns(pack_columns({"<a>": ["</script>", 1.5]}, columns))

    assert about == {"<a>": ["</script>", 1.5]}
    assert found.keys() == columns.keys()
    for name, values in columns.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_array_equal(found[name], values)


def test_the_text_holds_no_sign_that_means_something_in_a_page():
    text = pack_columns({"id": "</script><b>&"}, {"a": np.arange(9, dtype=np.int32)})

    assert re.fullmatch(r"[A-Za-z0-9+/=]+", text)


def test_small_numbers_of_four_bytes_take_hardly_more_room_than_of_one():
    values = np.random.default_rng(0).integers(0, 100, 10_000)

    small = pack_columns({}, {"a": values.astype(np.int8)})
    large = pack_columns({}, {"a": values.astype(np.int32)})

    assert len(large) < 1.02 * len(small)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<!>",
        "AAAA",
        base64.b64encode(zlib.compress(b"")).decode(),
        base64.b64encode(zlib.compress(b"\x05\0\0\0nojs!")).decode(),
    ],
)
def test_what_is_no_payload_is_refused(text):
    with pytest.raises(PayloadError, match="no payload"):
        unpack_columns(text)


def test_a_column_that_is_cut_short_is_named():
    whole = zlib.decompress(base64.b64decode(pack_columns({}, {"x": np.arange(9)})))
    cut = base64.b64encode(zlib.compress(whole[:-3])).decode()

    with pytest.raises(PayloadError, match="column x is cut short"):
        unpack_columns(cut)
