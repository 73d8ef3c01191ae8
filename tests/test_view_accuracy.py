"""`check --accuracy` tries several views by the images of all of them."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from test_views import BESIDE, CAMERA, cap

import torchmembrane as tm
from torchmembrane.accuracy.presses import stroke_states
from torchmembrane.accuracy.rig import Rig, press_trials
from torchmembrane.sensor.views import View


@pytest.fixture(scope="module")
def rig():
    return Rig(cap(View("right", CAMERA, BESIDE)), 40.0)


def test_frames_at_rest_of_two_views_show_no_contact(rig):
    trials = rig.rest_trials(3, 0)
    assert [trial.status for trial in trials] == [0] * 3 and not any(trial.contacts for trial in trials)
    assert max(trial.surface for trial in trials) < 0.02 and bool(rig.seen.all())


def test_a_marker_is_lost_where_no_view_sees_it(rig):
    """Those that one view alone sees count as found; errors are those of the results."""
    states = stroke_states(rig.simulator, 0, 2, 0.5, 0)
    (first, *_) = rig.press_trials(states, 0, 0)
    assert first.status == 0 and first.lost == 0.0 and first.force_error < 0.1
    result = rig._reconstructed(states, np.random.default_rng(0))
    confidence = torch.ones_like(result.confidence)
    confidence[:, 0, ::2], confidence[:, 1, 1::2] = 0, 0
    truth = states, rig._displacement(states)
    of_each = press_trials(0, *truth, result._replace(confidence=confidence), rig._normals(), rig.seen, rig._found())
    assert [trial.lost for trial in of_each] == [0.0] * len(states)
    confidence[:, 1] = 0
    of_one = press_trials(0, *truth, result._replace(confidence=confidence), rig._normals(), rig.seen, rig._found())
    assert [trial.lost for trial in of_one] == pytest.approx([25 / 49] * len(states))


def test_a_vertex_is_in_view_where_any_camera_sees_it():
    """Of two cameras that see a part each."""
    left, right = (tm.Camera("pinhole", (100, 120), (100, 100), (column, 59.5)) for column in (100.0, 0.0))
    sensor = cap(View("right", right, BESIDE), camera=left)
    each = []
    for number, camera in enumerate((left, right)):
        pixels = camera.point_to_pixel(sensor.in_view(number).membrane.rest)
        each.append(((pixels > -0.5) & (pixels < torch.tensor(camera.image_size) - 0.5)).all(1))
    found = SimpleNamespace(sensor=sensor, vertex_pixels=left.point_to_pixel(sensor.membrane.rest))
    assert torch.equal(Rig._in_image(SimpleNamespace(reconstructor=found)), each[0] | each[1])
    assert (each[0] & ~each[1]).any() and (each[1] & ~each[0]).any() and not (each[0] | each[1]).all()
