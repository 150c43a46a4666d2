"""Films that the views are drawn from."""

import numpy as np
import pytest

from benchmarks.player import busy_film as made_busy_film
from infgen.sources.towns import builtin_records
from infgen.sources.womd import iter_scenes
from infgen.views.scene.view_model import ViewModel, make_view_model
from tests.exports.replays import replay, with_newcomer


@pytest.fixture(scope="session")
def town():
    """The first scene of the smallest built-in records."""
    source = min(builtin_records(), key=lambda path: path.stat().st_size)
    return next(iter(iter_scenes(source)))


@pytest.fixture(scope="session")
def view_model(town) -> ViewModel:
    """The log, and two rollouts that replay it with someone new."""
    played = tuple(with_newcomer(replay(town, at, 0.5 * at), 30 + at) for at in range(2))
    return make_view_model(town, played)


@pytest.fixture
def same():
    """``same(film, other)``: equal to a centimetre and a milliradian."""

    def check(view_model: ViewModel, other: ViewModel) -> None:
        assert (view_model.scenario_id, view_model.now) == (other.scenario_id, other.now)
        np.testing.assert_array_equal(view_model.drawn_map.look, other.drawn_map.look)
        np.testing.assert_array_equal(view_model.drawn_map.bridge, other.drawn_map.bridge)
        np.testing.assert_array_equal(view_model.drawn_map.offsets, other.drawn_map.offsets)
        np.testing.assert_allclose(
            view_model.drawn_map.xy_m, other.drawn_map.xy_m, atol=0.006
        )
        np.testing.assert_array_equal(view_model.lights.state, other.lights.state)
        np.testing.assert_allclose(view_model.lights.xy_m, other.lights.xy_m, atol=0.006)
        for mine, read in zip(view_model.showings, other.showings, strict=True):
            assert (mine.name, mine.ego) == (read.name, read.ego)
            for field in ("id", "agent_type", "role", "valid", "last_step"):
                np.testing.assert_array_equal(getattr(mine, field), getattr(read, field))
            np.testing.assert_allclose(mine.size_lw_m, read.size_lw_m, atol=0.006)
            away = (mine.pose - read.pose)[mine.valid]
            assert np.abs(away[:, :2]).max() < 0.01
            turned = (away[:, 2] + np.pi) % (2 * np.pi) - np.pi
            assert np.abs(turned).max() < 0.01

    return check


@pytest.fixture(scope="session")
def busy_film():
    """Log and three rollouts of 128 agents each, 2,000 map tokens, 30 s."""
    return made_busy_film()
