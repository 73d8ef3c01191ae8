"""A `Reconstructor` works with what learning stacks do to modules."""

import io
from dataclasses import replace
from pathlib import Path

import grasp
import pytest
import torch
import torch.distributed as dist
from torch import nn
from torch.func import functional_call
from torch.nn.parallel import DistributedDataParallel

import torchmembrane as tm
from torchmembrane import state_dict as kept_state
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergySettings
from torchmembrane.markers.dots import locator
from torchmembrane.markers.noise import pixel_noise

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def images(reconstructor):
    return reconstructor.read(EXAMPLES / "two_contacts.png", EXAMPLES / "press_on_axis.png")


def all_buffers(module):
    """A state as it was when it held every constant."""
    return {name: buffer.clone() for name, buffer in module.named_buffers(remove_duplicate=False)}


def assert_same(got, expected, **tolerance):
    for key, value in expected._asdict().items():
        torch.testing.assert_close(got._asdict()[key], value, equal_nan=True, **tolerance)


def test_the_state_is_small_and_carries_the_material(sensor, reconstructor, images):
    file = io.BytesIO()
    other = tm.Reconstructor(sensor)
    other.estimator.set_prestretch(torch.tensor(1.31))
    torch.save(other.state_dict(), file)
    assert file.tell() < 40_000
    file.seek(0)
    fresh = tm.Reconstructor(sensor)
    fresh.load_state_dict(torch.load(file, weights_only=True))
    with torch.no_grad():
        assert_same(fresh(images), other(images))
        assert (reconstructor(images).force - fresh(images).force).abs().max() > 1e-3


def test_a_state_that_holds_every_constant_still_loads(sensor, reconstructor, images):
    other = tm.Reconstructor(sensor)
    other.estimator.set_prestretch(torch.tensor(1.31))
    fresh = tm.Reconstructor(sensor)
    assert fresh.load_state_dict(all_buffers(other)) == ([], [])
    with torch.no_grad():
        assert_same(fresh(images), other(images))


@pytest.mark.parametrize("assign", [False, True])
def test_a_state_of_another_precision_takes_that_of_the_module(sensor, reconstructor, images, assign):
    """Assigned, too, where torch would keep the state's precision beside that of the constants that the state lacks."""
    fresh = tm.Reconstructor(sensor)
    fresh.load_state_dict(tm.Reconstructor(sensor, dtype=torch.float64).state_dict(), assign=assign)
    assert {buffer.dtype for buffer in fresh.camera.buffers()} == {torch.float32}
    with torch.no_grad():
        assert_same(fresh(images), reconstructor(images))


def test_the_state_of_another_grid_or_sensor_is_refused_in_words(sensor, reconstructor):
    finer = replace(sensor, membrane=sensor.surface.membrane((11, 11)))
    with pytest.raises(tm.MembraneError, match="another sensor or grid; build the Reconstructor"):
        reconstructor.load_state_dict(tm.Reconstructor(finer).state_dict())
    moved = reconstructor.state_dict()
    moved[kept_state.IDENTITY] = moved[kept_state.IDENTITY] + torch.tensor([0.0, 0.0, 0.5])
    with pytest.raises(tm.MembraneError, match="rest_markers up to 0.5 off this sensor's"):
        reconstructor.load_state_dict(moved)


def test_the_state_of_another_modulus_is_refused_and_of_another_prestretch_or_camera_is_said(sensor, reconstructor, recwarn):
    state = reconstructor.state_dict()
    stiffer = replace(sensor, material=replace(sensor.material, shear_modulus=2 * sensor.material.shear_modulus))
    with pytest.raises(tm.MembraneError, match="of another shear modulus or thickness than this sensor's"):
        tm.Reconstructor(stiffer).load_state_dict(state)
    with pytest.raises(tm.MembraneError, match="of another shear modulus"):  # as a part of a model
        nn.ModuleDict({"eye": tm.Reconstructor(stiffer)}).load_state_dict({f"eye.{key}": each for key, each in state.items()})
    tm.Reconstructor(sensor).load_state_dict(state)
    assert not recwarn
    fresh = tm.Reconstructor(sensor)
    fresh.estimator.set_prestretch(torch.tensor(1.31))
    fresh.camera.centre += 1.0
    with pytest.warns(
        UserWarning, match=r"camera.centre, .*prestretch differ from this sensor's; the state's are used from now"
    ):
        tm.Reconstructor(sensor).load_state_dict(fresh.state_dict())


def test_a_part_of_a_larger_model_keeps_its_parameters_and_a_small_state(reconstructor):
    model = nn.ModuleDict({"eye": reconstructor, "head": nn.Linear(6, 1)})
    names = set(model.state_dict())
    assert {"head.weight", "head.bias", "eye.rest_markers"} < names and len(names) < 40
    assert model.load_state_dict(model.state_dict()) == ([], [])


def test_a_functional_call_gives_the_derivative_of_a_camera_parameter(reconstructor, images):
    pixels = reconstructor(images).pixels.detach()

    module, name = FromPixels(reconstructor), "reconstructor.camera.focal"
    focal = reconstructor.camera.focal
    leaf = focal.clone().requires_grad_()
    (slope,) = torch.autograd.grad(functional_call(module, {name: leaf}, (pixels,)).vertices.sum(), leaf)
    assert slope.isfinite().all() and slope.abs().max() > 0 and not reconstructor.camera.focal.requires_grad
    with torch.no_grad():
        assert torch.equal(functional_call(module, {name: focal}, (pixels,)).vertices, module(pixels).vertices)


class FromPixels(nn.Module):
    """The reconstruction from markers, as a module of its own."""

    def __init__(self, reconstructor):
        super().__init__()
        self.reconstructor = reconstructor

    def forward(self, pixels):
        return self.reconstructor.from_pixels(pixels)


@pytest.mark.parametrize("estimator", [pytest.param("force-balance", marks=pytest.mark.full), "minimum-energy"])
def test_torch_export_takes_the_reconstruction_from_markers_and_agrees(sensor, images, few_steps, estimator):
    """In double precision, in which the exported elimination and LAPACK's hardly differ by rounding."""
    settings = few_steps if estimator == "force-balance" else MinimumEnergySettings(steps=3)
    reconstructor = tm.Reconstructor(sensor, estimator, settings=settings).double()
    with torch.no_grad():
        expected = reconstructor(images.double())
        program = torch.export.export(FromPixels(reconstructor), (expected.pixels,), strict=False)
        assert_same(program.module()(expected.pixels), reconstructor.from_pixels(expected.pixels), rtol=1e-4, atol=1e-4)
    assert expected.displacement.norm(dim=-1).max() > 0.1


@pytest.mark.full
@pytest.mark.parametrize("all_steps", [False, True])
def test_torch_export_takes_the_reconstruction_and_agrees(sensor, images, few_steps, all_steps):
    """The same from images."""
    settings = None if all_steps else few_steps
    reconstructor, images = tm.Reconstructor(sensor, settings=settings).double(), images.double()
    with torch.no_grad():
        program = torch.export.export(reconstructor, (images,), strict=False)
        assert_same(program.module()(images), reconstructor(images), rtol=1e-4, atol=1e-4)


@pytest.fixture
def one_process(tmp_path):
    dist.init_process_group("gloo", init_method=f"file://{tmp_path}/rendezvous", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


class Grasp(nn.Module):
    """A linear head on the wrench that a reconstruction finds."""

    def __init__(self, reconstructor):
        super().__init__()
        self.reconstructor, self.head = reconstructor, nn.Linear(6, 1)

    def forward(self, images):
        return self.head(self.reconstructor(images).wrench)


@pytest.mark.parametrize("autocast", [False, True])
def test_a_model_around_it_trains_as_ddp_does_and_under_autocast(reconstructor, images, one_process, autocast):
    plain, model = Grasp(reconstructor), None
    plain(images).sum().backward()
    expected = plain.head.weight.grad.clone()
    plain.zero_grad()
    model = DistributedDataParallel(plain)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        model(images).sum().backward()
    torch.testing.assert_close(plain.head.weight.grad, expected, rtol=0.02 if autocast else 1e-5, atol=1e-6)


def test_two_processes_find_the_gradients_of_the_joined_batch(images, tmp_path, quick_processes):
    whole = grasp.grasp()
    with torch.no_grad():
        found, rest = whole.reconstructor(images).pixels, whole.reconstructor.rest_pixels
    pixels = torch.cat([found, rest + 0.7 * (found - rest)])
    torch.save(pixels, tmp_path / "pixels.pt")
    other = quick_processes.Process(target=grasp.train, args=(1, 2, tmp_path))
    other.start()
    grasp.train(0, 2, tmp_path)
    other.join(120)
    assert other.exitcode == 0
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in range(2))
    for here, there, expected in zip(first, second, grasp.gradients(whole, pixels), strict=True):
        torch.testing.assert_close(here, there, rtol=0, atol=0)
        torch.testing.assert_close(here, expected, rtol=1e-6, atol=1e-9)
        assert expected.abs().max() > 0


def test_the_gradient_of_an_image_takes_its_noise_for_given(reconstructor, images, monkeypatch):
    def slope():
        image = images[:1].clone().requires_grad_()
        reconstructor(image).displacement.square().sum().backward()
        return image.grad

    expected, noise = slope(), pixel_noise(images[:1])
    monkeypatch.setattr(locator, "pixel_noise", lambda _: noise)
    torch.testing.assert_close(slope(), expected)


def test_gradients_of_markers_are_the_finite_differences(sensor, images):
    """They are those of the fixed point of the steps, to which the steps are taken here."""
    settings = tm.ForceBalanceSettings(steps=(400, 2, 2), settled_step_tol=1e-11)
    double = tm.Reconstructor(sensor, dtype=torch.float64, settings=settings)
    with torch.no_grad():
        first = double(images)
    direction = torch.randn(first.pixels.shape, generator=torch.manual_seed(0))

    def found(pixels):
        result = double.from_pixels(pixels)
        return result.force.square().sum() + result.displacement.square().sum()

    pixels = first.pixels.clone().requires_grad_()
    (slope,) = torch.autograd.grad(found(pixels), pixels)
    with torch.no_grad():
        above, below = (found(first.pixels + step * direction) for step in (1e-5, -1e-5))
    assert (slope * direction).sum().item() == pytest.approx((above - below).item() / 2e-5, rel=1e-4)


@pytest.fixture(scope="module")
def double(sensor):
    return tm.Reconstructor(sensor, dtype=torch.float64)


@pytest.fixture(scope="module")
def pixels(double, images):
    with torch.no_grad():
        return double(images.double()).pixels


def test_second_derivatives_are_refused_in_words(double, pixels):
    leaf = pixels.clone().requires_grad_()
    (slope,) = torch.autograd.grad(double.from_pixels(leaf).force.sum(), leaf, create_graph=True)
    with pytest.raises(tm.MembraneError, match="second derivatives of a reconstruction"):
        torch.autograd.grad(slope.sum(), leaf)


def test_transforms_of_functions_give_the_gradients_of_a_reconstruction(double, pixels):
    def force(shift):
        return double.from_pixels(pixels[:1] + shift).force[0]

    rest = torch.zeros(2, dtype=torch.float64)
    expected = torch.autograd.functional.jacobian(force, rest)
    assert expected.abs().max() > 0.1
    torch.testing.assert_close(torch.func.jacrev(force)(rest), expected)
    torch.testing.assert_close(torch.func.grad(lambda shift: force(shift)[2])(rest), expected[2])


def of_what_is_found(result):
    """A loss that leaves out what was not found."""
    return sum(each.nan_to_num().square().sum() for each in (result.displacement, result.force, result.contact_area))


def too_far(rest, times):
    """Pixels of markers that all moved away from the middle."""
    return (rest.mean(0) + times * (rest - rest.mean(0)))[None]


def test_frames_without_a_surface_pass_no_gradient_to_what_they_share(sensor, double, pixels):
    """Nor do they change that of others: of a shift of all pixels, and of the prestretch."""
    rest, other = double.rest_pixels, tm.Reconstructor(sensor, dtype=torch.float64)
    bad = [torch.full_like(rest[None], torch.nan), too_far(rest, 1e3), too_far(rest, 3.0)]

    def slopes(frames):
        shift, stretch = (torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in ([0.0, 0.0], 1.2))
        other.estimator.set_prestretch(stretch)
        result = other.from_pixels(frames + shift)
        of_what_is_found(result).backward()
        return result, shift.grad, stretch.grad

    result, *found = slopes(torch.cat([pixels[:1], *bad]))
    Status = tm.Status
    assert result.status.tolist() == [Status.OK, Status.TOO_FEW_MARKERS, Status.TOO_FEW_MARKERS, Status.NO_SOLUTION]
    assert not result.vertices[1:].isfinite().any() and result.confidence[3].max() > 0
    for got, expected in zip(found, slopes(pixels[:1])[1:], strict=True):
        assert expected.abs().max() > 0
        torch.testing.assert_close(got, expected)


def test_a_frame_that_has_not_converged_passes_finite_gradients(sensor, pixels, monkeypatch):
    """Markers far from any surface, so that the limits of what is plausible are lifted: they would be said first."""
    monkeypatch.setattr("torchmembrane.reconstruct.LARGEST_RESIDUAL", float("inf"))
    few = tm.ForceBalanceSettings(steps=(8, 4, 4), largest_shared_misfit=100.0, unexplained_per_displacement=1e5)
    reconstructor = tm.Reconstructor(sensor, settings=few, dtype=torch.float64)
    rest = reconstructor.rest_pixels
    leaf = (rest + 20 * (pixels[:1] - rest)).requires_grad_()
    result = reconstructor.from_pixels(leaf)
    assert result.status.tolist() == [tm.Status.NOT_CONVERGED]
    (slope,) = torch.autograd.grad(of_what_is_found(result), leaf)
    assert slope.isfinite().all() and slope.abs().max() > 0


def test_images_without_a_surface_pass_no_gradient(sensor, images):
    """Nor do they change that of the prestretch; an image with NaN gets NaN itself."""
    noise = torch.rand(images[:1].shape, generator=torch.manual_seed(0))
    reconstructor = tm.Reconstructor(sensor, dtype=torch.float64)

    def slopes(*given):
        leaf, stretch = torch.cat(given).double().requires_grad_(), torch.tensor(1.2, requires_grad=True)
        reconstructor.estimator.set_prestretch(stretch)
        result = reconstructor(leaf)
        of_what_is_found(result).backward()
        assert not result.vertices[1:].isfinite().any()
        return result.status.tolist(), leaf.grad, stretch.grad

    Status, nan = tm.Status, torch.nan * noise
    status, of_images, of_stretch = slopes(images[:1], 0 * noise, noise, nan)
    assert status == [Status.OK, Status.BLANK, Status.TOO_FEW_MARKERS, Status.BAD_VALUES]
    assert (of_images[1:3] == 0).all() and of_images[0].isfinite().all() and of_images[0].abs().max() > 0
    torch.testing.assert_close(of_stretch, slopes(images[:1])[2])
    assert of_stretch.abs() > 0
