"""Drift of the rest image is detected, and nothing else is."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

import torchmembrane as tm
from torchmembrane import track
from torchmembrane.files.images import to_grey
from torchmembrane.markers import drift
from torchmembrane.markers.drift import FEWEST_FRAMES, FRAMES_OF_MEAN, LARGEST_ROUGHNESS, NEAR_REST, DriftWatch
from torchmembrane.mechanics.cavity import rest_balance
from torchmembrane.presets import preset
from torchmembrane.simulate.appearance import noisy
from torchmembrane.simulate.equilibrium import EquilibriumProblem, Liquid, Open
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.simulator import Simulator, Stroke

pytestmark = pytest.mark.usefixtures("quick_images")

SIZE, NOISE = (640, 480), 0.04
D = 150


def watch(seed=0, noise=NOISE):
    """Of markers anywhere in the image, each with its own frozen noise, not the same in all directions."""
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.rand(D, 2, generator=generator, dtype=torch.float64) * torch.tensor(SIZE)
    root = noise * (torch.eye(2) + 0.6 * (torch.rand(D, 2, 2, generator=generator, dtype=torch.float64) - 0.5))
    return DriftWatch(pixels, root @ root.mT, torch.ones(D) > 0, SIZE), pixels, root, generator


def run(watch, displacement, frames=FRAMES_OF_MEAN, root=None, generator=None):
    """What is said after frames of this displacement `[D, 2]`, each with its own noise."""
    watch.forget()
    for _ in range(frames):
        noise = 0 if root is None else root @ torch.randn(D, 2, 1, generator=generator, dtype=torch.float64)
        watch.add(displacement + (0 if root is None else noise[..., 0]), torch.ones(D))
    return watch.drift()


@pytest.mark.parametrize("frames", [FEWEST_FRAMES, 4 * FRAMES_OF_MEAN])
def test_certainty_counts_standard_deviations_of_what_noise_makes(monkeypatch, frames):
    """Frozen noise and that of the frames, of the covariance that is said: a chi-squared of k, its mean and variance."""
    monkeypatch.setattr(drift, "LEAST_DRIFT", 0.0)
    watched, _, root, generator = watch()
    frozen = [(root @ torch.randn(D, 2, 1, generator=generator, dtype=torch.float64))[..., 0] for _ in range(120)]
    certainty = np.array([run(watched, -one, frames, 2 * root, generator).certainty for one in frozen])
    assert abs(certainty.mean()) < 0.35 and certainty.std() == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("threshold, share", [(0.0, 0.406), (1.0, 0.145)])
def test_a_moved_camera_counts_standard_deviations_of_what_noise_makes(monkeypatch, threshold, share):
    """Frozen noise and that of one frame: a chi-squared of 4 over its mean, in standard deviations."""
    monkeypatch.setattr(drift, "LEAST_CERTAINTY", threshold)
    monkeypatch.setattr(drift, "LARGEST_ROUGHNESS", np.inf)
    watched, _, root, generator = watch()
    noise = (root @ torch.randn(600, D, 2, 1, generator=generator, dtype=torch.float64))[..., 0] * 2**0.5
    found = [watched.is_rigid(one, torch.ones(D)) for one in noise]
    assert np.mean(found) == pytest.approx(share, abs=0.05)


def fields(pixels):
    """Smooth ways to drift, rms 1 px."""
    u, v = (2 * pixels / torch.tensor(SIZE) - 1).unbind(-1)
    zero, bowl = torch.zeros_like(u), 1.5 - u**2 - v**2
    ways = {"shift": (zero + 1, zero), "turn": (-v, u), "swelling": (u * bowl, v * bowl), "sag": (bowl, 0.3 * u)}
    each = {name: torch.stack(way, -1) for name, way in ways.items()}
    return {name: field / field.square().sum(-1).mean().sqrt() for name, field in each.items()}


@pytest.mark.parametrize("way", ["shift", "turn", "swelling", "sag"])
@pytest.mark.parametrize("size", [0.1, 0.2, 3.0])
def test_the_size_of_a_drift_is_found_beyond_the_noise(way, size):
    watched, pixels, root, generator = watch()
    frozen = (root @ torch.randn(D, 2, 1, generator=generator, dtype=torch.float64))[..., 0]
    found = run(watched, size * fields(pixels)[way] - frozen, FRAMES_OF_MEAN, root, generator)
    assert found.is_certain and found.size == pytest.approx(size, abs=0.02)


def test_noise_adds_nothing_to_the_size_on_average():
    watched, pixels, root, generator = watch()
    field = 0.05 * fields(pixels)["sag"]
    frozen = [(root @ torch.randn(D, 2, 1, generator=generator, dtype=torch.float64))[..., 0] for _ in range(100)]
    square = np.mean([run(watched, field - one, FEWEST_FRAMES, root, generator).size ** 2 for one in frozen])
    assert square == pytest.approx(0.05**2, rel=0.05)


@pytest.mark.parametrize("noise", [0.002, 0.02])
def test_a_drift_that_does_not_matter_is_none_however_small_the_noise(noise):
    watched, pixels, _, _ = watch(noise=noise)
    for way, field in fields(pixels).items():
        assert not run(watched, 0.8 * drift.LEAST_DRIFT * field).is_certain, way
        assert run(watched, 2.5 * drift.LEAST_DRIFT * field).is_certain, way


def test_the_noise_of_the_rest_image_leaves_as_often_more_as_less_than_it_should_beside_a_smooth_field():
    """Frozen noise on a smooth drift of 0.3 px: in half of the draws there is no roughness, in none there is much."""
    watched, pixels, root, generator = watch()
    smooth = 0.3 * torch.stack([pixels[:, 0] / SIZE[0], 1 - pixels[:, 1] / SIZE[1]], -1)
    frozen = [(root @ torch.randn(D, 2, 1, generator=generator, dtype=torch.float64))[..., 0] for _ in range(80)]
    rough = np.array([run(watched, smooth - one, FEWEST_FRAMES).roughness for one in frozen])
    assert 0.3 < (rough > 0).mean() < 0.7 and rough.max() < LARGEST_ROUGHNESS


def test_what_is_found_does_not_depend_on_the_unit_of_pixels(monkeypatch):
    """Twice the noise, the drift and the image: the same certainty, twice the size."""
    watched, pixels, _, _ = watch()
    doubled = DriftWatch(2 * pixels, 4 * torch.eye(2).expand(D, 2, 2) * NOISE**2, watched.seen, (2 * SIZE[0], 2 * SIZE[1]))
    plain = DriftWatch(pixels, torch.eye(2).expand(D, 2, 2) * NOISE**2, watched.seen, SIZE)
    field = 0.1 * fields(pixels)["swelling"]
    one = run(plain, field)
    monkeypatch.setattr(drift, "LEAST_DRIFT", 2 * drift.LEAST_DRIFT)
    two = run(doubled, 2 * field)
    assert two.certainty == pytest.approx(one.certainty) and two.size == pytest.approx(2 * one.size)


def test_a_touch_leaves_more_than_a_smooth_field():
    """Markers that part in a patch: as many px as a drift's, and none is said."""
    watched, pixels, _, _ = watch()
    away = pixels - torch.tensor([250.0, 200.0])
    touch = away * torch.exp(-away.square().sum(-1, keepdim=True) / (2 * 60.0**2))
    touch = 0.2 * touch / touch.square().sum(-1).mean().sqrt()
    local, everywhere = run(watched, touch), run(watched, 0.2 * fields(pixels)["swelling"])
    assert local.certainty > 50 and local.roughness > 3 * LARGEST_ROUGHNESS and not local.is_certain
    assert everywhere.roughness < LARGEST_ROUGHNESS / 4


def test_lost_markers_and_those_not_seen_at_rest_say_nothing():
    """One in three is lost in every frame, in turn: the mean is that of the frames in which it was not."""
    watched, pixels, root, _ = watch()
    seen = torch.arange(D) % 5 > 0
    whole, part = (DriftWatch(pixels, root @ root.mT, seen, SIZE) for _ in range(2))
    field = 0.1 * fields(pixels)["turn"]
    for k in range(FRAMES_OF_MEAN):
        found = seen & (torch.arange(D) % 3 != k % 3)
        part.add(torch.where(found[:, None], field, torch.nan), found.double())
        whole.add(torch.where(seen[:, None], field, torch.nan), seen.double())
    assert part.drift().is_certain and part.drift().size == pytest.approx(whole.drift().size, rel=0.01)


def test_a_frame_is_near_where_its_markers_hardly_leave_the_mean():
    watched, pixels, _, _ = watch()
    field, sure = fields(pixels)["sag"], torch.ones(D)
    assert not watched.is_near(0 * field, sure)  # there is no mean yet
    run(watched, 0.3 * field)
    assert [watched.is_near((0.3 + step) * field, sure) for step in (0.8 * NEAR_REST, 1.2 * NEAR_REST)] == [True, False]


def test_a_frame_is_near_where_the_latest_free_one_was_and_one_with_a_contact_leaves_that_place():
    watched, pixels, _, _ = watch()
    field, sure = fields(pixels)["sag"], torch.ones(D)
    run(watched, 0.0 * field)
    assert not watched.is_near(0.3 * field, sure)
    watched.add(0.3 * field, sure)
    near = [0.3 - 0.8 * NEAR_REST, 0.3 + 0.8 * NEAR_REST, 0.3 + 1.2 * NEAR_REST, 0.3 - 1.2 * NEAR_REST]
    for _ in range(2):
        assert [watched.is_near(size * field, sure) for size in near] == [True, True, False, False]
        watched.add(near[1] * field, sure, is_free=False)
    watched.forget()
    assert watched.free is None


class Stream:
    """A sensor, what its camera sees of it as it ages, and a press."""

    def __init__(self):
        sensor = preset("fingertip")
        sensor = replace(sensor, membrane=sensor.surface.membrane((17, 17)))
        self.simulator = Simulator(sensor, grid=(20, 20))
        self.changes, self.clean = {}, {}
        (rest,) = self.images([self.simulator.membrane.rest], seed=99)
        self.reconstructor = tm.Reconstructor(replace(sensor, markers=replace(sensor.markers, rest_image=to_grey(rest))))
        membrane, way = self.simulator.membrane, np.array([0.0, 0.0, -1.0])
        stroke = Stroke(Sphere(3.0).touching(membrane, way), way, 1.2)
        self.pressed = [state.vertices for state in self.simulator.presses(stroke, ("push", "release"), frames=3)]
        self.rest = membrane.rest

    def aged(self, size, swells=True):
        """The membrane after a drift of `size` px: its fluid swells, or its tension falls in an open cavity."""
        if swells not in self.changes:
            self.changes[swells] = self._change(swells)
        moved, length = self.changes[swells]
        return self.rest + size / length * moved

    def _change(self, swells):
        """Where all vertices go, and how far the dots do, rms, px."""
        membrane, elasticity = self.simulator.membrane, self.simulator.elasticity
        p0, load = rest_balance(membrane, elasticity)
        softer = elasticity.for_membrane(membrane)
        softer.prestretch = 0.999 * elasticity.prestretch
        cause = (elasticity, Liquid(1.001 * float(membrane.rest_volume))) if swells else (softer, Open())
        moved = EquilibriumProblem(membrane, *cause, load).solve(self.rest, float(p0)).vertices - self.rest
        at, was = (np.asarray(self.simulator.renderer.dots(self.rest + k * moved).pixels) for k in (1, 0))
        return moved, np.sqrt(np.square(at - was).sum(1).mean())

    def images(self, surfaces, seed=0):
        """Of each surface, rendered once, with noise of its own."""
        rng = np.random.default_rng(seed)
        return [(255 * noisy(self._rendered(x), 35.0, rng)).round().byte().numpy() for x in surfaces]

    def _rendered(self, surface):
        key = surface.numpy().tobytes()
        if key not in self.clean:
            with torch.no_grad():
                self.clean[key] = self.simulator.renderer(surface)
        return self.clean[key]


@pytest.fixture(scope="module")
def stream():
    return Stream()


@pytest.fixture(scope="module")
def at_rest(stream):
    return stream.images([stream.rest] * 25)


def said(tracker, images):
    """What the tracker warns of over these images, and the frame."""
    found = []
    for k, image in enumerate(images):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            tracker(image)
        found += [(k, str(one.message)) for one in caught]
    return found


@pytest.mark.parametrize("step", [6, pytest.param(1, marks=pytest.mark.full)])
def test_noise_alone_is_no_drift(stream, at_rest, step):
    """From the sensor's rest image, and from every so many of the frames in turn, with the noise that the locator says."""
    r = stream.reconstructor
    tracker = tm.Tracker(r)
    assert np.isnan(tracker.drift) and said(tracker, at_rest) == [] and tracker.drift < 0.01
    with torch.no_grad():
        flow = r.observer(r.grey(np.stack(at_rest)))
    for k in range(0, len(at_rest), step):
        own = flow.covariance[k] - r.observer.rest_covariance
        watched = DriftWatch(r.rest_pixels, own, r.observer.seen_at_rest, r.image_size)
        for displacement, confidence in zip(flow.displacement, flow.confidence, strict=True):
            watched.add(displacement - flow.displacement[k], confidence)
            assert not watched.drift().is_certain


@pytest.mark.parametrize("swells", [True, pytest.param(False, marks=pytest.mark.full)])
def test_a_membrane_that_has_changed_is_said_once_and_nulled_by_rezero(stream, at_rest, swells):
    tracker, aged = tm.Tracker(stream.reconstructor), stream.images([stream.aged(0.15, swells)] * 60, seed=1)
    assert said(tracker, at_rest[:FEWEST_FRAMES]) == []
    ((frame, words),) = said(tracker, aged[:40])
    assert frame < 12 and "px (rms) off the rest image" in words and "Tracker.rezero()" in words and "camera's" not in words
    assert tracker.drift == pytest.approx(0.15, abs=0.03)
    tracker.rezero()
    assert np.isnan(tracker.drift)
    assert said(tracker, aged[40:]) == [] and tracker.drift < 0.015
    ((_, again),) = said(tracker, at_rest)  # what it was before is a drift now
    assert "rezero" in again


@pytest.mark.parametrize("k", [0, pytest.param(1, marks=pytest.mark.full)])
def test_rezero_knows_the_noise_of_its_frame(stream, k):
    """Much more than that of the rest image, which was averaged."""
    with torch.no_grad():
        clean = stream.simulator.renderer(stream.rest)
    images = [(255 * noisy(clean, 22.0, np.random.default_rng([7, i]))).round().byte().numpy() for i in range(24)]
    sensor = stream.reconstructor.sensor
    averaged = replace(sensor, markers=replace(sensor.markers, rest_image=clean.numpy().astype(np.float32)))
    tracker = tm.Tracker(tm.Reconstructor(averaged))
    tracker.rezero(images[k])
    assert said(tracker, images[2:]) == [] and tracker.drift < 0.015


def test_the_same_stream_says_the_same_again(stream, at_rest):
    tracker, images = tm.Tracker(stream.reconstructor), at_rest[:8] + stream.images([stream.aged(0.2)] * 12, seed=2)
    first, drifted = said(tracker, images), tracker.drift
    tracker.reset()
    assert np.isnan(tracker.drift)
    assert said(tracker, images) == first != [] and tracker.drift == drifted


@pytest.mark.parametrize("shift", [0.2, 3.0])
def test_a_moved_camera_is_a_drift_and_one_that_is_found_is_named(stream, at_rest, shift):
    moved = [ndimage.shift(image / 255, (0.0, shift), order=3, mode="nearest").clip(0, 1) for image in at_rest[:16]]
    tracker = tm.Tracker(stream.reconstructor)
    ((_, words),) = said(tracker, moved)
    assert tracker.drift == pytest.approx(shift, rel=0.06)
    named = [float(du) for du in re.findall(r"it is a moved camera's: ([\d.]+), ", words)]
    assert named == ([] if shift < 1 else [pytest.approx(shift, abs=0.15)])


def test_a_moved_camera_is_told_from_a_touch_and_from_noise(stream):
    r, rng = stream.reconstructor, torch.Generator().manual_seed(3)
    pixels, seen = r.rest_pixels.double(), torch.ones(len(r.rest_pixels))
    watch = DriftWatch(r.rest_pixels, 0.02**2 * torch.eye(2).expand(len(pixels), 2, 2), seen > 0, r.image_size)
    noise = 0.02 * 2**0.5 * torch.randn(pixels.shape, generator=rng, dtype=torch.float64)
    off = pixels - pixels.mean(0)
    turned = 1e-3 * torch.stack([-off[:, 1], off[:, 0]], -1)
    for moved in (torch.tensor([0.2, 0.0]).expand_as(pixels), turned, 1e-3 * off):
        assert watch.is_rigid(moved + noise, seen)
    touch = 0.2 * torch.exp(-off.square().sum(-1) / 2 / 60**2)[:, None] * torch.tensor([1.0, 0.5])
    for moved in (0 * pixels, touch, 0.2 * off.abs() / off.abs().max()):
        assert not watch.is_rigid(moved + noise, seen)


@pytest.mark.parametrize("rounds", [3, pytest.param(5, marks=pytest.mark.full)])
def test_presses_in_between_are_no_drift(stream, at_rest, rounds):
    tracker, pressed = tm.Tracker(stream.reconstructor), stream.images(stream.pressed * rounds, seed=3)
    images = [image for k in range(rounds) for image in (*at_rest[4 * k : 4 * k + 4], *pressed[6 * k : 6 * k + 6])]
    assert said(tracker, images) == [] and tracker.drift < 0.015


SOON = 14


@pytest.fixture
def soon(monkeypatch):
    """A contact holds still for a few frames only before it is asked about."""
    monkeypatch.setattr(track, "STEADY", SOON)


def test_a_press_that_is_held_is_no_drift(stream, at_rest, soon):
    tracker = tm.Tracker(stream.reconstructor)
    for pressed in stream.pressed[:2]:
        assert said(tracker, at_rest[:12] + stream.images([pressed] * (SOON + 3), seed=9)) == [] and tracker.drift < 0.01


@pytest.fixture
def touched_from(stream, monkeypatch):
    """A contact is found in every frame from a given one on."""

    def begin(first):
        forward, frames = type(stream.reconstructor).forward, []

        def touched(*inputs):
            frames.append(1)
            result = forward(stream.reconstructor, *inputs)
            return (
                result._replace(contact_points=0 * result.pressure[:, None, None].expand(1, 4, 3))
                if len(frames) > first
                else result
            )

        monkeypatch.setattr(stream.reconstructor, "forward", touched)

    return begin


def test_a_rest_image_that_had_aged_before_the_stream_is_said(stream, soon, touched_from):
    touched_from(0)
    aged, tracker = stream.images([stream.aged(0.15)] * 36, seed=5), tm.Tracker(stream.reconstructor)
    ((frame, words),) = said(tracker, aged[:18])
    assert frame == SOON - 1 and "from the beginning" in words and "if nothing touches, it has aged" in words
    assert tracker.drift == pytest.approx(0.15, abs=0.03)
    tracker.rezero()
    assert said(tracker, aged[18:]) == []


def test_a_contact_that_moves_or_is_large_is_no_drift(stream, soon, touched_from):
    touched_from(0)
    light, large = (stream.images([stream.aged(size)] * (SOON + 3), seed=6) for size in (0.15, 0.4))
    other = stream.images([stream.rest - (stream.aged(0.15) - stream.rest)] * (SOON - 2), seed=7)
    assert said(tm.Tracker(stream.reconstructor), light[: SOON - 2] + other + light[: SOON - 2]) == []
    assert said(tm.Tracker(stream.reconstructor), large) == []


def test_a_slow_drift_is_said_even_where_it_is_taken_for_a_contact(stream, touched_from):
    """From the twentieth frame on every frame is one with a contact."""
    moved = stream.aged(0.1) - stream.rest
    images = stream.images([stream.rest + k / 5 * moved for k in range(5)], seed=4)
    touched_from(20)
    ((frame, words),) = said(tm.Tracker(stream.reconstructor), [image for image in images for _ in range(10)])
    assert 20 < frame < 40 and "without contact" in words


def test_a_frame_with_a_contact_is_no_free_one_however_near_it_is(stream, at_rest, touched_from):
    touched_from(15)
    tracker = tm.Tracker(stream.reconstructor)
    assert said(tracker, at_rest[:15]) == []
    free = tracker._watch.free
    assert said(tracker, at_rest[15:18]) == []
    assert tracker._watch.frames == 18 and torch.equal(tracker._watch.free, free)


def test_what_comes_at_once_may_well_be_a_contact(stream, at_rest, touched_from):
    touched_from(20)
    (aged,) = stream.images([stream.aged(0.1)], seed=8)
    assert said(tm.Tracker(stream.reconstructor), at_rest[:20] + [aged] * 20) == []
