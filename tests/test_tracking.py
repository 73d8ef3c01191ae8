"""Frames of a stream against the same frames alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchmembrane as tm
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.simulator import Simulator

pytestmark = pytest.mark.usefixtures("quick_images")

SLACK = 1.2
FRAMES = 6


@pytest.fixture(scope="module")
def stream():
    """A slack bubble, and images of a ball pressed in up to a third of its size."""
    sensor = tm.preset("bubble")
    membrane = sensor.surface.membrane((17, 17))
    sensor = replace(sensor, material=replace(sensor.material, prestretch=SLACK), membrane=membrane)
    simulator, size = Simulator(sensor, (30, 30)), membrane.size
    aim = membrane.rest[membrane.fixed].mean(0).numpy()
    stroke = stroke_to(simulator, Sphere(size / 5), aim, np.array([0.0, 0.1, -1.0]), 0.35 * size)
    rng = np.random.default_rng(0)
    images = [simulator.frame(state, stroke, rng).image for state in simulator.presses(stroke, ("push",), FRAMES)]
    return tm.Reconstructor(sensor, check_rest=False), images


def test_a_frame_followed_is_what_it_is_alone_to_the_last_digit(stream, monkeypatch):
    """Through frames that are searched for alone, but followed are not."""
    reconstructor, images = stream
    matcher, tracker = reconstructor.observer.locator.match, tm.Tracker(reconstructor)
    work, search = [], matcher.search
    monkeypatch.setattr(matcher, "search", lambda *given: work.append("search") or search(*given))
    seen = set()
    for image in images:
        work.clear()
        followed, of_followed = tracker(image), tuple(work)
        work.clear()
        with torch.no_grad():
            alone = reconstructor(image)
        seen.add((of_followed, tuple(work)))
        assert alone.status.tolist() in ([0], [9])
        for name, value in alone._asdict().items():
            assert torch.equal(value.nan_to_num(), getattr(followed, name).nan_to_num()), name
    assert ((), ("search",)) in seen
