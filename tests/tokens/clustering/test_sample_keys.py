import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from infgen.tokens.clustering.sample_keys import item_keys, name_key, smallest_keys


def test_keys_tell_items_apart_by_name_and_every_number():
    tracks, starts = np.divmod(np.arange(2000), 20)
    one = item_keys("a", tracks, starts)
    assert len(np.unique(np.concatenate([one, item_keys("b", tracks, starts)]))) == 4000
    swapped = item_keys("a", starts, tracks)
    assert len(np.intersect1d(one, swapped)) == 20 * 20  # those of the same two numbers


def test_keys_are_the_same_on_every_machine_and_day():
    assert name_key("637f20cafde22ff8") == 0x17C4D4E18C24CCDE
    keys = item_keys("637f20cafde22ff8", np.array([7]), np.array([3]))
    np.testing.assert_array_equal(keys, np.uint64([9259800995701511543]))


def test_an_items_key_does_not_depend_on_the_items_beside_it():
    numbers = np.arange(50)
    keys = item_keys("scene", numbers)
    for number in numbers[::7]:
        assert item_keys("scene", np.array([number]))[0] == keys[number]


def test_the_sample_of_a_thousand_keys_is_spread_over_all_of_them():
    rows = smallest_keys(item_keys("scene", np.arange(100_000)), 1000)
    counts = np.bincount(rows // 10_000, minlength=10)
    assert counts.min() > 60
    assert counts.max() < 140


@given(st.lists(st.integers(0, 2**64 - 1), max_size=60), st.integers(0, 70), st.randoms())
def test_a_sample_of_samples_is_a_sample_of_the_whole(keys, count, random):
    keys = np.array(keys, dtype=np.uint64)
    whole = keys[smallest_keys(keys, count)]
    shuffled = keys[random.sample(range(len(keys)), len(keys))]
    half = len(keys) // 2
    parts = [
        part[smallest_keys(part, count)] for part in (shuffled[:half], shuffled[half:])
    ]
    merged = np.concatenate(parts)
    np.testing.assert_array_equal(merged[smallest_keys(merged, count)], whole)
