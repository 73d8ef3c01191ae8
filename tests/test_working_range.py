"""A result beyond the validated range gets status 9."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_batch import Denting, images, reconstruct  # noqa: F401  (images is a fixture)
from test_spec_sheet import trial

import torchmembrane as tm
from torchmembrane.accuracy.statistics import working_range
from torchmembrane.cli.describe import described
from torchmembrane.jobs.local import FrameCounts
from torchmembrane.results.reconstruction import Reconstruction
from torchmembrane.sensor.working_range import GENERAL, UNLIMITED, WorkingRange, range_file
from torchmembrane.surface.shapes import spherical_cap

CAP = spherical_cap(12.0, 9.0, 3.0, grid=(17, 17))
NONE = torch.zeros(1, len(CAP.rest), 3, dtype=CAP.rest.dtype)


def dented(depth):
    """The cap pushed in along its normals by as much, over its size, at the pole."""
    off2 = (CAP.rest - CAP.rest[CAP.rest[:, 2].argmax()]).square().sum(-1) / CAP.size**2
    x = CAP.rest - depth * CAP.size * torch.exp(-off2 / 0.05)[:, None] * CAP.rest_normals * ~CAP.fixed[:, None]
    return x[None]


def beyond(limits, x=CAP.rest[None], normals=CAP.rest_normals[None], traction=NONE):
    return limits.is_beyond(x, normals, traction, CAP).tolist()


@pytest.mark.parametrize("depth", [0.05, 0.2])
def test_a_dent_is_beyond_a_depth_that_it_exceeds_and_a_bulge_is_not(depth):
    assert beyond(WorkingRange(0.99 * depth), dented(depth)) == [True]
    assert beyond(WorkingRange(1.01 * depth), dented(depth)) == [False]
    assert beyond(WorkingRange(0.01), dented(-depth)) == [False]


def test_a_turn_of_more_than_a_share_of_the_vertices_is_beyond():
    """Of 289 vertices six may have turned further: a single one beside the rim says nothing."""
    turned = CAP.rest_normals.clone()[None].repeat(2, 1, 1)
    axis = torch.nn.functional.normalize(
        torch.linalg.cross(CAP.rest_normals, torch.ones(3, dtype=turned.dtype).expand(289, 3)), dim=-1
    )
    new = np.cos(np.radians(50)) * CAP.rest_normals + np.sin(np.radians(50)) * torch.linalg.cross(axis, CAP.rest_normals)
    turned[0, :5], turned[1, :6] = new[:5], new[:6]
    assert WorkingRange(1.0, 49.0).is_beyond(CAP.rest.expand(2, -1, 3), turned, NONE, CAP).tolist() == [False, True]
    assert WorkingRange(1.0, 51.0).is_beyond(CAP.rest.expand(2, -1, 3), turned, NONE, CAP).tolist() == [False, False]


def test_a_force_is_that_of_the_tractions():
    even = NONE + torch.tensor([0.0, 0.0, -2.0], dtype=CAP.rest.dtype)
    total = 2 * float(CAP.rest_area.sum())
    assert [beyond(WorkingRange(1.0, force=limit), traction=even) for limit in (0.99 * total, 1.01 * total)] == [
        [True],
        [False],
    ]


def test_where_nothing_is_found_nothing_is_beyond():
    assert beyond(GENERAL, torch.nan * NONE, torch.nan * NONE, torch.nan * NONE) == [False]


@pytest.fixture(scope="module")
def sensor(small_sensor):
    return tm.Sensor.from_file(small_sensor / "sensor.toml")


@pytest.fixture(scope="module")
def press(sensor, small_images):
    """The deepest press, and what is found in it without limits."""
    reconstructor = tm.Reconstructor(replace(sensor, range=UNLIMITED))
    image = reconstructor.read(small_images[-1])
    with torch.no_grad():
        return reconstructor, image, reconstructor(image)


def test_beyond_the_range_the_answer_is_kept_with_status_9(press, sensor):
    reconstructor, image, plain = press
    depth = float(plain.indentation(sensor.membrane).max()) / sensor.membrane.size
    assert plain.status.tolist() == [tm.Status.OK]
    for limit, status in ((0.99 * depth, tm.Status.OUT_OF_RANGE), (1.01 * depth, tm.Status.OK)):
        reconstructor.range = WorkingRange(limit)
        with torch.no_grad():
            found = reconstructor(image)
        assert found.status.tolist() == [status] and status.has_surface
        assert all(
            torch.equal(a, b) or name == "status"
            for name, a, b in zip(plain._fields, plain, found, strict=True)
            if not a.isnan().any()
        )
    reconstructor.range = UNLIMITED


def test_every_other_status_comes_first(press):
    """5, 4, 1, 2, 6, 7, 8, 3, 9, 0, the first that holds: what is out of range and has not converged is not converged."""
    reconstructor, image, _ = press
    reconstructor.range = WorkingRange(1e-6)
    estimator = reconstructor.estimator
    with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
        assert reconstructor(image).status.tolist() == [9]
        patch.setattr(type(estimator), "is_converged", lambda self, found: torch.zeros_like(found.pressure, dtype=torch.bool))
        assert reconstructor(image).status.tolist() == [3]
        assert reconstructor(torch.zeros_like(image)).status.tolist() == [4]
    reconstructor.range = UNLIMITED


def test_a_sensor_file_s_range_is_taken_while_it_is_of_that_sensor(sensor, tmp_path):
    path = sensor.to_file(tmp_path)
    own = WorkingRange(0.25, 70.0, 12.5, sensor.fingerprint)
    own.to_file(range_file(path))
    read = tm.Sensor.from_file(path)
    assert read.range == own and read.fingerprint == sensor.fingerprint
    assert read.range.for_fingerprint(read.fingerprint) == own and read.range.for_fingerprint("of another sensor") == GENERAL
    deep = f"up to {0.25 * sensor.membrane.size:.3g} mm deep, the surface turned by 70 degrees"
    assert any(f"{deep}, 12.5 N, as `check --accuracy` has shown" in line for line in described(read))
    assert any("of another state of this file" in line for line in described(replace(read, name="other")))
    range_file(path).write_text(range_file(path).read_text() + "width = 3\n")
    with pytest.raises(tm.MembraneError, match="sensor_range.toml.*width"):
        tm.Sensor.from_file(path)


def test_a_spec_sheet_s_range_ends_before_the_shallowest_wrong_press():
    presses = [trial(depth=depth, force=10 * depth, turn=20 * depth) for depth in (0.1, 1.0, 2.0, 3.0)]
    noisy = trial(depth=0.2, force=2.0, surface_error=0.9)  # so light that noise decides
    assert working_range([*presses, noisy], 10.0, "f") == WorkingRange(0.3, GENERAL.turn, 30.0, "f")
    for wrong in (dict(surface_error=0.3), dict(force_error=0.3)):
        found = working_range([*presses, trial(depth=2.5, force=1.0, **wrong)], 10.0, "f")
        assert found == WorkingRange(0.2, GENERAL.turn, 20.0, "f")
    for fine in (dict(force_error=0.3, at_rim=True), dict(surface_error=0.3, status=7)):  # said of itself
        assert working_range([*presses, trial(depth=2.5, force=1.0, **fine)], 10.0, "f").depth == 0.3
    assert working_range([trial(depth=3.0, turn=85.0)], 10.0, "f").turn == 85.0
    assert working_range([noisy], 10.0, "f") is None


def test_frames_out_of_range_are_finished_and_counted(images, tmp_path):  # noqa: F811
    class Deep(Denting):
        def __call__(self, batch):
            found = super().__call__(batch)
            return Reconstruction(**found._asdict() | {"status": torch.full_like(found.status, 9)})

    counts, lines, _ = reconstruct(images, tmp_path / "out", reconstructor=Deep())
    assert counts == FrameCounts(5, 0, 0, 0, 5, 0, 0) and lines == []
    assert reconstruct(images, tmp_path / "out")[0].skipped == 5
