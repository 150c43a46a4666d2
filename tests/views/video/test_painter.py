import numpy as np
import pytest

from infgen.views.scene.marks import Mark
from infgen.views.video import painter
from infgen.views.video.painter import Canvas, MissingExtraError, rgb, word_width

pytest.importorskip("aggdraw", reason="the extra video is not installed")
SQUARE = np.array([[2.0, 2.0], [8.0, 2.0], [8.0, 6.0], [2.0, 6.0]])


def test_an_outline_is_filled_and_nothing_else():
    canvas = Canvas.plain(12, 9, "#000000")
    canvas.paint([Mark(SQUARE, "#ff8000")])

    inside = canvas.pixels[2:6, 2:8]
    assert (inside == (255, 128, 0)).all()
    # aggdraw widens what it fills by a quarter of a pixel, and no more.
    assert (canvas.pixels.sum(axis=(0, 1))[0] - 255 * 24) == pytest.approx(
        255 * (6.5 * 4.5 - 24), rel=0.02
    )
    assert not canvas.pixels[[0, 7, 8]].any()
    assert not canvas.pixels[:, [0, 9, 10, 11]].any()


def test_a_shape_may_lie_between_pixels():
    canvas = Canvas.plain(12, 9, "#000000")
    canvas.paint([Mark(SQUARE + (0.25, 0.25), "#ffffff")])  # noqa: RUF005

    assert canvas.pixels[4, [1, 2, 7, 8], 0].tolist() == pytest.approx(
        [0, 255, 255, 127], abs=2
    )


def test_what_is_half_transparent_is_half_seen():
    canvas = Canvas.plain(12, 9, "#000000")
    canvas.paint([Mark(SQUARE, "#ffffff", alpha=0.5)])

    assert canvas.pixels[4, 4].tolist() == pytest.approx([128] * 3, abs=1)


def test_an_open_line_is_not_closed():
    canvas = Canvas.plain(12, 9, "#000000")
    canvas.paint([Mark(SQUARE + 0.5, None, "#ffffff", 1.0, closed=False)])

    assert canvas.pixels[2, 5].min() > 240
    assert canvas.pixels[4, 2].max() < 60


def test_a_second_painting_is_laid_over_the_first():
    canvas = Canvas.plain(12, 9, "#000000")
    canvas.paint([Mark(SQUARE, "#ff0000")])
    canvas.paint([Mark(SQUARE + (3.0, 0.0), "#00ff00")])  # noqa: RUF005

    assert canvas.pixels[4, 3].tolist() == [255, 0, 0]
    assert canvas.pixels[4, 6].tolist() == [0, 255, 0]


def test_words_stand_where_they_should_and_are_as_wide_as_said():
    canvas = Canvas.plain(100, 40, "#ffffff")
    wide = canvas.write("Ego", (10.0, 30.0), 16.0, "#000000")

    dark = np.argwhere(canvas.pixels[..., 0] < 128)
    assert (
        10
        <= dark[:, 1].min()
        <= dark[:, 1].max()
        <= 10 + wide
        == 10 + word_width("Ego", 16.0)
    )
    assert 15 <= dark[:, 0].min() < 30 <= dark[:, 0].max() <= 35  # The g hangs below.


def test_words_end_at_their_place_if_told_so_and_may_run_upwards():
    canvas = Canvas.plain(60, 60, "#ffffff")
    canvas.write("III", (50.0, 30.0), 16.0, "#000000", align=1.0)
    assert np.argwhere(canvas.pixels[..., 0] < 128)[:, 1].max() <= 50

    upright = Canvas.plain(60, 60, "#ffffff")
    upright.write("IIIIII", (30.0, 50.0), 16.0, "#000000", upright=True)
    high, wide = np.ptp(np.argwhere(upright.pixels[..., 0] < 128), axis=0)
    assert high > wide


def test_what_is_beyond_the_edge_is_left_out():
    canvas = Canvas.plain(20, 20, "#ffffff")
    canvas.write("wide words", (-10.0, 5.0), 16.0, "#000000")
    canvas.write("below", (5.0, 90.0), 16.0, "#000000")
    canvas.box(15, 15, 40, 40, "#123456")

    assert canvas.pixels[19, 19].tolist() == rgb("#123456").tolist()


def test_a_missing_package_names_the_extra(monkeypatch):
    def refuse(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(painter, "import_module", refuse)

    with pytest.raises(
        MissingExtraError, match=r"need aggdraw: pip install 'infgen\[video\]'"
    ):
        Canvas.plain(4, 4, "#000000").paint([])
