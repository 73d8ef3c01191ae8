"""Lost markers and frames leave gradients finite and others alone."""

from pathlib import Path

import pytest
import torch

import torchmembrane as tm

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def reconstructor():
    return tm.Reconstructor.from_file(EXAMPLES / "sensor.toml")


@pytest.fixture(scope="module")
def images(reconstructor):
    return reconstructor.read(EXAMPLES / "press_on_axis.png", EXAMPLES / "two_contacts.png")


@pytest.fixture(scope="module")
def cold(reconstructor, images):
    with torch.no_grad():
        return reconstructor(images)


@pytest.fixture(scope="module")
def after_black(reconstructor, images):
    """Results before: of a black frame, and of the second image."""
    with torch.no_grad():
        return reconstructor(torch.stack([torch.zeros_like(images[0]), images[1]]))


def test_gradients_are_finite_where_all_of_a_neighbourhood_is_lost(reconstructor, cold):
    pixels = cold.pixels[0].clone()
    lost = (pixels - pixels[60]).norm(dim=-1).argsort()[:30]
    pixels[lost] = torch.nan
    pixels.requires_grad_()
    result = reconstructor.from_pixels(pixels)
    (gradient,) = torch.autograd.grad(result.vertices.square().sum(), pixels)
    found = torch.ones(len(pixels), dtype=torch.bool).index_fill(0, lost, False)
    assert gradient.isfinite().all() and (gradient[found].abs().sum(-1) > 0).all() and not gradient[lost].any()


def test_a_frame_without_a_surface_has_no_standard_deviations(reconstructor, after_black):
    with torch.no_grad():
        deviations = reconstructor.standard_deviations(after_black)
    assert after_black.status.tolist() == [tm.Status.BLANK, tm.Status.OK]
    for of_each in deviations:
        assert of_each[0].isnan().all() and of_each[1].isfinite().all()


def test_after_a_frame_without_a_surface_a_frame_is_solved_as_from_rest(reconstructor, images, cold, after_black):
    with torch.no_grad():
        result = reconstructor(images, after_black)
        of_second = reconstructor(images[1:], after_black._replace(**{k: v[1:] for k, v in after_black._asdict().items()}))
    assert (result.vertices[0] - cold.vertices[0]).abs().max() < 1e-3  # mm; from rest in a tracker's few steps: 0.08
    torch.testing.assert_close(result.force[0], cold.force[0], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(result.vertices[1], of_second.vertices[0], rtol=0, atol=1e-3)
