"""CI runs a share of the slow tests, drawn by the seed of the order of tests."""

from types import SimpleNamespace

import pytest

from tests.conftest import pytest_collection_modifyitems


class Item(SimpleNamespace):
    def get_closest_marker(self, name):
        return name if name == "slow" and self.slow else None


ITEMS = [Item(nodeid=f"test_a.py::test_kill[{case}]", slow=True) for case in range(9)]
ITEMS += [Item(nodeid="test_a.py::test_alone", slow=True)]
ITEMS += [Item(nodeid=f"test_b.py::test_fast[{case}]", slow=False) for case in range(3)]
ITEMS += [Item(nodeid="test_a.py::test_kill[fast]", slow=False)]


@pytest.fixture
def collected():
    def collect(seed, share=1.0, *, order=1):
        items, left_out = ITEMS[::order], []
        options = {"slow_share": share, "randomly_seed": seed}
        hook = SimpleNamespace(pytest_deselected=lambda items: left_out.extend(items))
        config = SimpleNamespace(getoption=lambda name, *_: options[name], hook=hook)
        pytest_collection_modifyitems(config, items)
        assert {one.nodeid for one in [*items, *left_out]} == {i.nodeid for i in ITEMS}
        return {one.nodeid for one in items}

    return collect


def test_one_case_of_each_slow_test_is_left_and_every_fast_one(collected):
    kept = collected(0)

    assert len(kept) == 1 + 1 + 3 + 1
    assert {"test_a.py::test_alone", "test_a.py::test_kill[fast]"} < kept


def test_all_processes_draw_the_same_cases_in_whatever_order_they_see_them(collected):
    assert collected(5) == collected(5, order=-1)


def test_of_half_the_slow_tests_there_is_one_case_each(collected):
    assert len(collected(0, 0.5)) == 1 + 3 + 1
    assert len(collected(0, 0.0)) == 3 + 1


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_every_case_is_drawn_by_some_seed(collected, share):
    drawn = set.union(*(collected(seed, share) for seed in range(99)))

    assert drawn == collected(0, None)
