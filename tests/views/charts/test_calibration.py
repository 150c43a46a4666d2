import xml.etree.ElementTree as ET

import numpy as np
import pytest

from infgen.views.charts.calibration import (
    Bins,
    binomial_interval,
    calibration_chart,
    overall,
)

SVG = "{http://www.w3.org/2000/svg}"


def bins(count, predicted, happened):
    """Bins by the mean probability of each."""
    count = np.array(count, float)
    return Bins(count, count * np.array(predicted, float), np.array(happened, float))


def chart(**runs):
    return ET.fromstring(calibration_chart(runs, title="Leaving"))


def dots(root):
    """Places of the dots of bins; the last of each run is in the lines below."""
    return [
        (float(c.get("cx")), float(c.get("cy")))
        for c in root.iter(f"{SVG}circle")
        if c.get("r") == "3.5"
    ]


def texts(root):
    return [element.text for element in root.iter(f"{SVG}text")]


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
    root = chart(a=bins([100, 100, 100], [0.2, 0.5, 0.9], [20, 50, 90]))
    (diagonal,) = [p for p in root.iter(f"{SVG}path") if p.get("class") == "diagonal"]
    x0, y0, x1, y1 = map(
        float, diagonal.get("d").replace("M", "").replace("L", " ").split()
    )

    assert len(dots(root)) == 3
    for x_px, y_px in dots(root):
        share = (x_px - x0) / (x1 - x0)
        assert y_px == pytest.approx(y0 + share * (y1 - y0), abs=0.1)


def test_too_much_predicted_lies_below_the_diagonal():
    ((_, right),) = dots(chart(a=bins([100], [0.5], [50])))
    ((_, less),) = dots(chart(a=bins([100], [0.5], [20])))

    assert less > right  # Pixels count downwards.


def test_low_rates_stand_on_logarithmic_axes_and_none_at_their_end():
    root = chart(a=bins([9000, 900, 90], [0.001, 0.01, 0.1], [0, 9, 9]))

    (nothing, middle, right) = dots(root)
    assert middle[0] - nothing[0] == pytest.approx(right[0] - middle[0], abs=0.2)
    assert nothing[1] > middle[1] > right[1]
    assert "0.01" in texts(root)


def test_empty_bins_are_left_out_and_the_others_say_how_many_they_hold():
    root = chart(a=bins([12345, 0, 7], [0.1, 0.5, 0.9], [1200, 0, 6]))

    assert len(dots(root)) == 2
    assert {"12.3k", "7"} <= set(texts(root))


def test_a_line_compares_what_was_predicted_with_what_was_logged():
    found = bins([60, 40], [0.1, 0.5], [6, 14])

    assert overall(found) == "predicted 0.2600, logged 0.2000, ratio 1.300"
    root = chart(one=found, two=bins([10], [0.5], [0]))
    assert "one: predicted 0.2600, logged 0.2000, ratio 1.300" in texts(root)
    assert "two: predicted 0.5000, logged 0.0000, ratio unknown" in texts(root)


def test_a_chart_without_decisions_is_still_a_chart():
    svg = calibration_chart({"<a>": bins([0, 0], [0, 0], [0, 0])}, title="Adding")

    assert "nan" not in svg.lower()
    assert dots(ET.fromstring(svg)) == []
    assert "<a>" not in svg
