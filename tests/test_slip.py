"""The page on slip finds the simulator's friction."""

import re
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("quick_images")

PAGE = Path(__file__).parents[1] / "docs" / "slip.md"
CODE = "\n".join(re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S))


@pytest.fixture(scope="module")
def page():
    """What the page's code has defined after it ran."""
    names: dict = {}
    exec(compile(CODE, PAGE.name, "exec"), names)
    return names


def test_the_slip_ratio_is_that_of_the_simulated_tractions(page):
    np.testing.assert_allclose(page["slip"], page["true"], rtol=0, atol=0.03)


def test_a_contact_that_slides_bears_its_friction_and_one_that_sticks_less(page):
    share, true = np.array(page["sliding"]), np.array(page["true"])
    assert (share[: page["pushed"]] < 0.01).all() and (share[-5:] > 0.999).all()
    partial = (share > 0.05) & (share < 0.95)
    assert partial.sum() >= 2 and (np.diff(true[partial]) > 0).all() and (true[partial] < page["friction"]).all()
    np.testing.assert_allclose(true[share > 0.999], page["friction"], rtol=0.03)


def test_friction_and_onset_are_found(page):
    assert page["plateau"] == pytest.approx(page["friction"], rel=0.08)
    assert page["true_onset"] - 1 < page["onset"] < page["true_onset"] + 1


def test_what_was_touched_goes_along_until_it_slides(page):
    step = 1.8 / page["dragged"]
    assert 0.8 * step < page["stuck"] < 1.1 * step and abs(page["slid"]) < 0.2 * step


def test_an_even_rise_and_a_plateau_are_found_exactly(page):
    """Whatever the frame at which they meet."""
    frame = np.arange(14)
    for meet in (2.5, 4.0, 7.3, 10.5):
        onset, plateau = page["onset_of_slip"](np.minimum(0.02 + 0.1 * frame, 0.02 + 0.1 * meet))
        assert (onset, plateau) == pytest.approx((meet, 0.02 + 0.1 * meet), abs=1e-9)


def test_the_page_says_what_it_gives(page):
    said = [float(number) for line in re.findall(r'print\(f".*"\)  # (.*)', CODE) for number in re.findall(r"-?[\d.]+", line)]
    given = [page[name] for name in ("plateau", "friction", "onset", "true_onset", "stuck", "slid")]
    assert said == pytest.approx(given, abs=0.06)
    assert said[0] == pytest.approx(given[0], abs=0.006) and said[4:] == pytest.approx(given[4:], abs=0.006)
