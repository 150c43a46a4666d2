import numpy as np
import pytest

from infgen.errors import ConfigError
from infgen.views.scene.view_model import make_view_model
from infgen.views.video.frames import num_frames, paint_frames
from infgen.views.video.layout import Format, make_panes
from tests.exports.replays import replay

pytest.importorskip("aggdraw", reason="the extra video is not installed")
FORM = Format(640, 360, 10)


def like(pixels, colour):
    wanted = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)])
    return np.abs(pixels.astype(int) - wanted).max(axis=-1) < 6


def painted(view_model, form, first, count):
    return [frame.copy() for frame in paint_frames(view_model, form, first, count)]


def test_a_video_lasts_from_now_to_the_end_of_the_longest_showing(view_model):
    assert num_frames(view_model, FORM) == 80
    assert num_frames(view_model, Format(640, 360, 25)) == 200


def test_panes_fill_the_picture_without_overlapping(view_model):
    for size in ((640, 360), (360, 640), (1920, 1080)):
        taken = np.zeros(size[::-1], int)
        for pane in make_panes(view_model, Format(*size)):
            rows = slice(pane.top_px, pane.top_px + pane.height_px)
            taken[rows, pane.left_px : pane.left_px + pane.width_px] += 1
        assert taken.max() == 1
        assert 0.6 < taken.mean() < 0.95


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_the_ego_is_in_the_middle_of_every_pane_in_its_colour(view_model, theme):
    form = Format(960, 540, 10, theme)
    (frame,) = painted(view_model, form, 40, 1)

    for pane in make_panes(view_model, form):
        x = pane.left_px + pane.width_px // 2
        y = pane.top_px + pane.height_px // 2
        assert like(frame[y - 4 : y + 4, x - 4 : x + 4], form.colours.ego).sum() > 8


def test_a_frame_does_not_depend_on_which_others_are_painted_with_it(view_model):
    together = painted(view_model, FORM, 20, 6)

    for at, frame in enumerate(together):
        # A coordinate may be rounded otherwise in its last bit, and a shade by a little.
        (alone,) = painted(view_model, FORM, 20 + at, 1)
        assert np.abs(frame.astype(int) - alone).max() <= 2


def test_time_goes_on_below(view_model):
    early, late = painted(view_model, FORM, 5, 1)[0], painted(view_model, FORM, 70, 1)[0]

    accent = [
        like(frame[-20], FORM.colours.accent).nonzero()[0].mean() for frame in (early, late)
    ]
    assert accent[1] - accent[0] > 0.6 * FORM.width_px


def test_a_showing_that_is_over_stands_back_and_says_so(crossing):
    scene = crossing()
    longer = replay(crossing(steps=131))
    view_model = make_view_model(scene, (longer,))
    log, _ = make_panes(view_model, FORM)
    (before,), (after,) = (
        painted(view_model, FORM, 70, 1),
        painted(view_model, FORM, 110, 1),
    )

    def ego_pixels(frame):
        part = frame[log.top_px :, log.left_px : log.left_px + log.width_px]
        return like(part[: log.height_px], FORM.colours.ego).sum()

    assert ego_pixels(before) > 10 > ego_pixels(after)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"width_px": 641}, "width_px is 641; expected an even number"),
        ({"height_px": 100}, "height_px is 100; expected an even number from 240"),
        ({"fps": 0}, "fps is 0; expected 1 to 60"),
        ({"theme": "blue"}, "theme is 'blue'; expected light or dark"),
    ],
)
def test_what_cannot_be_encoded_is_refused(wrong, message):
    with pytest.raises(ConfigError, match=message):
        Format(**wrong)
