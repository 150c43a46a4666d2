import numpy as np
import pytest

from infgen.views.player.columns import PayloadError, pack_columns
from infgen.views.player.payload import pack, unpack
from infgen.views.scene.view_model import make_view_model


def test_a_film_comes_back_to_a_centimetre_and_a_hundredth_of_a_radian(view_model, same):
    same(view_model, unpack(pack(view_model)))


def test_so_does_one_with_gaps_without_lights_and_without_a_map(crossing, build_map, same):
    scene = crossing(road_map=build_map([]))

    same(make_view_model(scene, ()), unpack(pack(make_view_model(scene, ()))))


def test_the_same_film_is_the_same_text(view_model):
    assert pack(view_model) == pack(view_model)


def test_thirty_seconds_of_four_crowds_are_far_below_two_megabytes(busy_film):
    assert [len(showing.id) for showing in busy_film.showings] == [128] * 4
    assert busy_film.num_steps == 311
    assert len(pack(busy_film)) < 1.2e6


def test_a_payload_of_another_version_is_refused():
    text = pack_columns({"version": 99}, {"a": np.arange(2)})

    with pytest.raises(PayloadError, match="payload version 99, expected 1"):
        unpack(text)
