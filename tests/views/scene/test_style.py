import re
from dataclasses import asdict
from itertools import combinations

import numpy as np
import pytest

from infgen.views.scene.drawn_map import RoadLook
from infgen.views.scene.style import STROKES, THEMES

BLINDNESS = {
    "none": np.eye(3),
    "red": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "green": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "blue": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
"""What is seen of linear light (Machado, Oliveira and Fernandes, 2009; severity 1)."""
XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)
WHITE = np.array([0.95047, 1.0, 1.08883])
APART = 20.0
"""Distance in CIELAB; 2 is just seen, and from 10 on colours look unlike."""


def linear(colour):
    share = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def lab(light):
    part = XYZ @ np.clip(light, 0, 1) / WHITE
    x, y, z = np.where(part > 0.008856, np.cbrt(part), 7.787 * part + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def contrast(one, other):
    low, high = sorted(XYZ[1] @ linear(colour) for colour in (one, other))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("blindness", BLINDNESS)
@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize(
    "group", [("ego", "initial", "inserted"), ("stop", "caution", "go")]
)
def test_colours_that_mean_something_are_told_apart_by_the_colour_blind(
    theme, blindness, group
):
    seen = np.array(BLINDNESS[blindness])
    for one, other in combinations(group, 2):
        colours = [getattr(THEMES[theme], name) for name in (one, other)]
        first, second = (lab(seen @ linear(colour)) for colour in colours)
        assert np.linalg.norm(first - second) > APART, (one, other)


@pytest.mark.parametrize("theme", THEMES.values(), ids=THEMES)
def test_words_are_readable(theme):
    assert contrast(theme.ink, theme.panel) > 7
    assert contrast(theme.quiet, theme.panel) > 4.5


@pytest.mark.parametrize("theme", THEMES.values(), ids=THEMES)
def test_every_colour_is_six_digits_and_in_the_style_sheet(theme):
    for name, colour in asdict(theme).items():
        assert re.fullmatch(r"#[0-9a-f]{6}", colour)
        assert f"--{name}: {colour};" in theme.css()


def test_every_look_but_the_stop_sign_has_a_stroke_in_a_colour_that_there_is():
    drawn = {look for stroke in STROKES for look in stroke.looks}

    assert drawn == set(RoadLook) - {RoadLook.STOP_SIGN}
    assert {stroke.colour for stroke in STROKES} <= asdict(THEMES["light"]).keys()
