"""A stream of several views is followed; drift is noticed."""

import numpy as np
import pytest
import torch
from test_views import BESIDE, CAMERA, cap

import torchmembrane as tm
from torchmembrane.camera.motion import motion_of_pixels
from torchmembrane.markers.drift import DriftWatch
from torchmembrane.sensor.views import View
from torchmembrane.simulate import Simulator, Sphere
from torchmembrane.simulate.dataset import stroke_to

SIZES = (160, 120), (320, 240)


@pytest.fixture(scope="module")
def stream():
    """A reconstructor of two views, their images at rest, and those of two presses."""
    simulator = Simulator(cap(View("right", CAMERA, BESIDE)))
    stroke = stroke_to(simulator, Sphere(3.0), np.array([0.0, 1.0, 18.0]), np.array([0.0, 0.0, -1.0]), 1.0)
    rng = np.random.default_rng(0)
    frames = [simulator.images(state.vertices, rng) for state in simulator.presses(stroke, ["push"], 2)]
    return tm.Reconstructor(simulator.at_rest()), simulator.images(simulator.membrane.rest, rng), frames


def test_a_frame_followed_is_what_it_is_alone(stream):
    reconstructor, rest, frames = stream
    tracker = tm.Tracker(reconstructor)
    for frame in (rest, *frames, np.stack(frames[1])):
        followed = tracker(frame)
        with torch.no_grad():
            alone = reconstructor(frame)
        for name, value in alone._asdict().items():
            assert torch.equal(value.nan_to_num(), getattr(followed, name).nan_to_num()), name
    assert float(followed.displacement.norm(dim=-1).max()) > 0.5


def test_one_frame_of_every_view_is_taken(stream):
    reconstructor, rest, _ = stream
    for wrong, said in ((rest[0], "expected a list of 2 batches"), ([np.stack([image] * 2) for image in rest], "2 frames")):
        with pytest.raises(tm.MembraneError, match=said):
            tm.Tracker(reconstructor)(wrong)


@pytest.mark.parametrize("form", [lambda a: a[..., None], lambda a: np.stack([a] * 3), lambda a: np.stack([a] * 3, -1)])
def test_an_image_of_a_view_may_have_one_channel_or_colours_first_or_last(stream, form):
    reconstructor, _, frames = stream
    expected, found = (tm.Tracker(reconstructor)(frame) for frame in (frames[1], [form(image) for image in frames[1]]))
    torch.testing.assert_close(found.vertices, expected.vertices, rtol=0, atol=1e-3)


def test_a_view_that_moves_is_named_and_taken_for_rest(stream):
    """The right camera alone is knocked by 2 px: said once, by its name; `rezero` takes it out of the markers too."""
    reconstructor, (left, right), frames = stream
    tracker, knocked = tm.Tracker(reconstructor), [left, np.roll(right, 2, axis=1)]
    with pytest.warns(UserWarning, match="the moved camera's of view 'right': 2.0, 0.0 px"):
        for _ in range(10):
            tracker(knocked)
    assert abs(tracker.drift - 2 / 2**0.5) < 0.1  # rms over both views
    tracker.rezero()
    for _ in range(10):
        result = tracker(knocked)
    assert tracker.drift < 0.05 and float(result.camera_motion[0, :, :2].abs().max()) < 0.1
    pressed = tracker([frames[1][0], np.roll(frames[1][1], 2, axis=1)])
    with torch.no_grad():
        unmoved = reconstructor(frames[1])
    assert float((pressed.vertices - unmoved.vertices).norm(dim=-1).max()) < 0.05


@pytest.mark.parametrize("is_blank", [True, False])
def test_a_view_without_a_picture_keeps_its_rest_state(stream, is_blank):
    """The other one, which has moved by a pixel, is taken for rest."""
    reconstructor, (left, right), frames = stream
    observer, tracker = reconstructor.observer, tm.Tracker(reconstructor)
    with pytest.warns(UserWarning, match="view right: rest image 0: .*; this view keeps the rest state of its rest image"):
        tracker.rezero([np.roll(left, 1, axis=1), np.zeros_like(right) if is_blank else None])
    (moved,) = observer.by_view((tracker._rest_pixels - observer.measured_rest)[None])
    assert torch.equal(moved[1], torch.zeros_like(moved[1]))
    torch.testing.assert_close(moved[0].median(0).values, torch.tensor([1.0, 0.0]), rtol=0, atol=0.05)
    assert tracker([np.roll(frames[1][0], 1, axis=1), frames[1][1]]).status.tolist() == [tm.Status.OK]


def test_a_frame_without_any_picture_is_no_rest_state_of_any_view(stream):
    reconstructor, rest, _ = stream
    with pytest.raises(tm.MembraneError, match="view left: rest image 0: .*; view right: rest image 0: "):
        tm.Tracker(reconstructor).rezero([np.zeros_like(image) for image in rest])


def watch_of(views, generator):
    """A watch over views of 40 markers each, and their pixels."""
    pixels = [torch.rand(40, 2, generator=generator).double() * torch.tensor(SIZES[w]) for w in views]
    noise = 0.05**2 * torch.eye(2).expand(40 * len(views), 2, 2)
    watch = DriftWatch(torch.cat(pixels), noise, torch.ones(40 * len(views)) > 0, *(SIZES[w] for w in views))
    return watch, pixels


def test_the_drifts_of_two_views_add_up():
    """The squared size over both is the mean of each one's; a field of one view says nothing of the other's."""
    both, pixels = watch_of((0, 1), torch.Generator().manual_seed(0))
    alone = [DriftWatch(p, 0.05**2 * torch.eye(2).expand(40, 2, 2), torch.ones(40) > 0, SIZES[w]) for w, p in enumerate(pixels)]
    fields = [0.3 + 1e-3 * pixels[0], 0.2 - 1e-6 * pixels[1] ** 2]
    for _ in range(12):
        both.add(torch.cat(fields), torch.ones(80))
        for watch, field in zip(alone, fields, strict=True):
            watch.add(field, torch.ones(40))
    sizes = [watch.drift().size for watch in alone]
    assert both.drift().size ** 2 == pytest.approx((sizes[0] ** 2 + sizes[1] ** 2) / 2, rel=1e-9)
    assert both.drift().is_certain and both.drift().roughness == 0


def test_each_views_camera_moves_by_itself():
    watch, pixels = watch_of((0, 1), torch.Generator().manual_seed(1))
    turns = torch.tensor([[0.0, 0.0, 3.0, 0.0], [1.0, -2.0, 0.0, 0.0]]).double()
    for w in (0, 1):
        moved = [motion_of_pixels(p, SIZES[v]) @ turns[v] * (v == w) for v, p in enumerate(pixels)]
        assert watch.is_rigid(torch.cat(moved), torch.ones(80))
    one_motion = torch.cat([motion_of_pixels(p, SIZES[0]) @ turns[0] for p in pixels]) + torch.cat(moved)
    assert watch.is_rigid(one_motion, torch.ones(80))
    bent = torch.cat([0.02 * (pixels[0] - 80) ** 2 / 80, 0 * pixels[1]])
    assert not watch.is_rigid(bent, torch.ones(80))
