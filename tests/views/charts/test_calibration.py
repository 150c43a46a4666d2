import xml.etree.ElementTree as ET

import numpy as np
import pytest

from infgen.views.charts.calibration import (
    Bins,
    binomial_interval,
    calibration_chart,
    overall,
)


def bins(count, predicted, happened):
    """Bins by the mean probability of each."""
    count = np.array(count, float)
    return Bins(count, count * np.array(predicted, float), np.array(happened, float))


def chart(**runs):
    return calibration_chart(runs, title="Leaving")


def dots(drawn):
    """Places of the dots of bins: predicted and logged rate."""
    (axes,) = drawn.figure.axes
    marked = [line for line in axes.get_lines() if line.get_marker() == "o"]
    return np.concatenate([line.get_xydata() for line in marked])


def texts(drawn):
    root = ET.fromstring(drawn.to_svg())
    return [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]


def test_the_interval_of_ten_in_a_hundred_is_the_published_one():
    (low,), (high,) = binomial_interval(np.array([10.0]), np.array([100.0]))

    assert (low, high) == pytest.approx((0.05522, 0.17437), abs=1e-5)


def test_an_interval_of_none_or_all_ends_at_the_rate_itself():
    low, high = binomial_interval(np.array([0.0, 7.0]), np.array([7.0, 7.0]))

    assert low[0] == pytest.approx(0.0, abs=1e-12)
    assert high[1] == pytest.approx(1.0, abs=1e-12)
    assert 0 < high[0] < 0.5
    assert 0.5 < low[1] < 1


def test_an_interval_holds_the_true_rate_19_times_out_of_20():
    drawn = np.random.default_rng(0).binomial(500, 0.04, size=4000).astype(float)

    low, high = binomial_interval(drawn, np.full(4000, 500.0))

    assert ((low <= 0.04) & (high >= 0.04)).mean() == pytest.approx(0.95, abs=0.015)


def test_a_calibrated_model_lies_on_the_diagonal():
    drawn = chart(a=bins([100, 100, 100], [0.2, 0.5, 0.9], [20, 50, 90]))

    assert dots(drawn) == pytest.approx(np.array([[0.2, 0.2], [0.5, 0.5], [0.9, 0.9]]))
    diagonal = drawn.figure.axes[0].get_lines()[0].get_xydata()
    assert diagonal.tolist() == [[0.0, 0.0], [1.0, 1.0]]


def test_low_rates_stand_on_logarithmic_axes_and_none_at_their_end():
    drawn = chart(a=bins([9000, 900, 90], [0.001, 0.01, 0.1], [0, 9, 9]))
    (axes,) = drawn.figure.axes

    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert dots(drawn)[0, 1] == axes.get_ylim()[0]
    assert "0.01" in texts(drawn)


def test_empty_bins_are_left_out_and_the_others_say_how_many_they_hold():
    root = chart(a=bins([12345, 0, 7], [0.1, 0.5, 0.9], [1200, 0, 6]))

    assert len(dots(root)) == 2
    assert {"12.3k", "7"} <= set(texts(root))


def test_a_line_compares_what_was_predicted_with_what_was_logged():
    found = bins([60, 40], [0.1, 0.5], [6, 14])
    words = texts(chart(one=found, two=bins([10], [0.5], [0])))

    assert overall(found) == "predicted 0.2600, logged 0.2000, ratio 1.300"
    assert "● one: predicted 0.2600, logged 0.2000, ratio 1.300" in words
    assert "● two: predicted 0.5000, logged 0.0000, ratio unknown" in words


@pytest.mark.filterwarnings("error")
def test_a_chart_without_decisions_is_still_a_chart():
    svg = calibration_chart({"<a>": bins([0, 0], [0, 0], [0, 0])}, title="Adding").to_svg()

    ET.fromstring(svg)
    assert "nan" not in svg.lower()
    assert "<a>" not in svg
