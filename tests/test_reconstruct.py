"""Rendered images give their true surfaces; bad images a status."""

import dataclasses
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from torchmembrane import MembraneError
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergySettings
from torchmembrane.estimators.paper.bilinear import bilinear_matrix
from torchmembrane.estimators.paper.estimator import PaperSettings, grid_laplacian
from torchmembrane.mechanics.affine_quadrilateral import AffineQuadrilaterals
from torchmembrane.mechanics.cavity import rest_balance
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.results import npz as results
from torchmembrane.results.status import Status
from torchmembrane.sensor.parts import FRICTION, Cavity
from torchmembrane.sensor.sensor import Sensor

EXAMPLES = Path(__file__).parents[1] / "examples"
LEAST = "minimum-energy"
PRESSES = ("press_on_axis", "two_contacts", "flat_plate")


@pytest.fixture(scope="module")
def sensor():
    whole = Sensor.from_file(EXAMPLES / "sensor.toml")
    return dataclasses.replace(whole, membrane=whole.membrane.resampled((17, 17)))


@pytest.fixture(scope="module")
def reconstructor(sensor):
    return Reconstructor(sensor, LEAST)


@pytest.fixture(scope="module")
def images(reconstructor):
    return reconstructor.read(*(EXAMPLES / f"{press}.png" for press in PRESSES))


@pytest.fixture(scope="module")
def result(reconstructor, images):
    with torch.no_grad():
        return reconstructor(images)


def truth(press):
    return np.load(EXAMPLES / f"{press}_truth.npz")


def relative_error(result, index, press):
    """Rms marker error over rms marker displacement."""
    Y, X = truth(press)["dots_deformed"], truth(press)["dots_nominal"]
    miss = result.markers[index].double().numpy() - Y
    return np.sqrt((miss**2).sum() / ((Y - X) ** 2).sum())


def test_shapes_and_status_follow_the_contract(result):
    B, V, D = 3, 289, 121
    shapes = dict(
        vertices=(B, V, 3), displacement=(B, V, 3), normals=(B, V, 3), markers=(B, D, 3), pixels=(B, D, 2), confidence=(B, D),
        traction=(B, V, 3), contact=(B, V), contact_points=(B, 4, 3), force=(B, 3), pressure=(B,), pressure_change=(B,),
        volume_error=(B,), residual=(B,), status=(B,), wrench=(B, 6), contact_force=(B, 4, 3), contact_normal=(B, 4, 3),
        contact_area=(B, 4), contact_slip=(B, 4), contact_curvature=(B, 4, 2), contact_at_rim=(B, 4), coverage=(B,),
        camera_motion=(B, 4), force_deviation=(B, 3), depth_deviation=(B,),
    )  # fmt: skip
    assert {k: tuple(v.shape) for k, v in result._asdict().items()} == shapes
    assert result.status.dtype == torch.int32 and (result.status == Status.OK).all()
    of_tractions = {"force_deviation", "depth_deviation"}  # which minimum energy does not find
    for key in {key for key in shapes if not key.startswith("contact_")}:
        values = result._asdict()[key]
        assert (values.isnan() if key in of_tractions else values.isfinite()).all(), key


@pytest.mark.parametrize("index", range(3))
def test_every_dot_is_found_where_the_truth_is(result, index):
    error = np.linalg.norm(result.pixels[index].numpy() - truth(PRESSES[index])["uv_deformed"], axis=1)
    assert np.median(error) < 0.05 and np.percentile(error, 95) < 0.2 and error.max() < 1


@pytest.mark.parametrize("index", range(3))
def test_minimum_energy_recovers_part_of_a_press_and_keeps_the_volume(result, index):
    """It is poor where something presses along the rays, as its docstring says; it must not be worse than no answer."""
    assert 0.3 < relative_error(result, index, PRESSES[index]) < 0.9
    assert result.volume_error[index].abs() < 1e-5


def test_the_rest_image_gives_the_rest_surface(reconstructor):
    with torch.no_grad():
        rest = reconstructor(reconstructor.read(EXAMPLES / "rest.png"))
    assert rest.status[0] == Status.OK
    assert rest.displacement.abs().max() < 1e-5 and rest.residual.max() < 0.02


def test_surface_lies_on_the_rays_of_the_markers(result):
    assert (result.residual < 0.2).all() and (result.residual > 0).all()


def test_a_frame_alone_equals_the_frame_in_a_batch(reconstructor, images, result):
    with torch.no_grad():
        alone = reconstructor(images[1:2])
    torch.testing.assert_close(alone.vertices[0], result.vertices[1], rtol=0, atol=1e-4)
    torch.testing.assert_close(alone.pixels[0], result.pixels[1], rtol=0, atol=1e-3)


def test_double_precision_agrees(sensor, images, result):
    with torch.no_grad():
        double = Reconstructor(sensor, LEAST, dtype=torch.float64)(images.double())
    assert (double.vertices - result.vertices).abs().max() < 2e-3
    assert (double.pixels - result.pixels).abs().max() < 5e-3


def test_from_pixels_continues_where_the_image_left_off(reconstructor, result):
    again = reconstructor.from_pixels(result.pixels, result.confidence)
    torch.testing.assert_close(again.vertices, result.vertices, rtol=0, atol=1e-4)


def test_exact_pixels_and_lost_ones(reconstructor):
    pixels = torch.from_numpy(truth("two_contacts")["uv_deformed"].copy())
    full = reconstructor.from_pixels(pixels)
    pixels[[3, 50, 51]] = torch.nan
    some = reconstructor.from_pixels(pixels)
    assert some.status[0] == Status.OK and (some.confidence[0, [3, 50, 51]] == 0).all()
    assert some.pixels[0, [3, 50, 51]].isnan().all() and some.markers.isfinite().all()
    assert (some.vertices - full.vertices).norm(dim=-1).max() < 0.1


def test_colour_and_integer_images_are_the_same_image(reconstructor, images):
    eight_bit = (images * 255).round().to(torch.uint8)
    with torch.no_grad():
        grey, colour = reconstructor(eight_bit), reconstructor(eight_bit.expand(-1, 3, -1, -1))
    torch.testing.assert_close(colour.pixels, grey.pixels, rtol=0, atol=1e-3)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf, 1e30, -2.0])
@pytest.mark.parametrize("part", [np.s_[:], np.s_[200:280, 300:340], np.s_[10, 10]], ids=["whole", "patch", "pixel"])
def test_bad_values_do_no_harm(reconstructor, images, value, part):
    bad = images[:2].clone()
    bad[0, 0][part] = value
    with torch.no_grad():
        displacement, confidence, _, status = reconstructor.observer(bad)
        expected = reconstructor.observer(images[1:2]).confidence
    assert status.tolist() == [Status.BAD_VALUES, Status.OK]
    assert (displacement[0] == 0).all() and (confidence[0] == 0).all()
    torch.testing.assert_close(confidence[1], expected[0], rtol=0, atol=1e-4)


def test_bad_frames_get_a_status_and_the_others_an_answer(reconstructor, images, result):
    noise = torch.rand(480, 640, generator=torch.Generator().manual_seed(0))
    nan = images[0, 0].clone()
    nan[10, 10] = torch.nan
    batch = torch.stack([torch.full_like(nan, 0.4), torch.ones_like(nan), nan, noise, images[1, 0], torch.zeros_like(nan)])
    with torch.no_grad():
        got = reconstructor(batch)
    assert got.status[[0, 1, 2, 5]].tolist() == [Status.BLANK, Status.BLANK, Status.BAD_VALUES, Status.BLANK]
    assert got.status[3] in (Status.TOO_FEW_MARKERS, Status.UNLIKE_REST)
    for bad in (0, 1, 2, 3, 5):
        for key in ("vertices", "normals", "markers", "traction", "contact", "force", "pressure", "residual"):
            assert got._asdict()[key][bad].isnan().all(), key
        assert bad == 3 or (got.confidence[bad] == 0).all()
    assert got.status[4] == Status.OK
    torch.testing.assert_close(got.vertices[4], result.vertices[1], rtol=0, atol=1e-4)
    assert all(Status(int(code)).text for code in got.status)


def test_hidden_dots_are_lost_and_the_shape_hardly_changes(reconstructor, images, result):
    hidden = [20, 37, 58, 83]
    image = images[2, 0].clone()
    for u, v in result.pixels[2, hidden].round().long().tolist():
        patch = image[v - 12 : v + 13, u - 12 : u + 13]
        patch[:] = patch[[0, -1]].mean()
    with torch.no_grad():
        got = reconstructor(image)
    assert (got.confidence[0, hidden] == 0).all() and got.pixels[0, hidden].isnan().all()
    assert (got.confidence[0] > 0).sum() >= 121 - len(hidden) - 2
    assert (got.vertices - result.vertices[2]).norm(dim=-1).max() < 0.3


def test_wrong_sizes_and_shapes_are_refused_with_both_sizes(reconstructor):
    with pytest.raises(MembraneError, match="512 x 384 px, expected 640 x 480"):
        reconstructor(torch.zeros(1, 1, 384, 512))
    with pytest.raises(MembraneError, match="other than one or three channels"):
        reconstructor(torch.zeros(1, 2, 480, 640))
    with pytest.raises(MembraneError, match="one pixel for each marker"):
        reconstructor.from_pixels(torch.zeros(1, 7, 2))


def test_dots_may_be_found_in_the_rest_image(sensor, result):
    found = dataclasses.replace(sensor.markers, positions=None, sizes=None)
    reconstructor = Reconstructor(dataclasses.replace(sensor, markers=found), LEAST)
    listed = sensor.markers.positions
    gap = np.linalg.norm(reconstructor.rest_markers.double().numpy()[:, None] - listed, axis=2)
    assert len(gap) >= 0.97 * len(listed) and gap.min(1).max() < 0.3
    with torch.no_grad():
        got = reconstructor(reconstructor.read(EXAMPLES / "two_contacts.png"))
    assert got.status[0] == Status.OK
    assert (got.vertices[0] - result.vertices[1]).norm(dim=-1).max() < 0.25


def test_without_a_rest_image_dots_are_located_from_their_list_alone(sensor, images):
    bare = dataclasses.replace(sensor, markers=dataclasses.replace(sensor.markers, rest_image=None))
    with torch.no_grad():
        got = Reconstructor(bare, LEAST)(images[:1])
    error = np.linalg.norm(got.pixels[0].numpy() - truth(PRESSES[0])["uv_deformed"], axis=1)
    assert got.status[0] == Status.OK and np.nanmedian(error) < 0.15


def test_a_gas_without_modulus_is_a_liquid_and_says_so_once(sensor, result, images):
    bare = dataclasses.replace(sensor.material, shear_modulus=None)
    gas = dataclasses.replace(sensor, material=bare, cavity=Cavity("gas", pressure=1013.0))
    with pytest.warns(UserWarning, match="acts as a liquid") as caught:
        reconstructor = Reconstructor(gas, LEAST)
    assert len(caught) == 1
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("error")
        got = reconstructor(images)
    torch.testing.assert_close(got.vertices, result.vertices, rtol=0, atol=1e-4)


def test_the_friction_of_the_material_is_that_of_the_force_balance(sensor, images):
    """With more friction, more shear is accepted under a push."""
    found = []
    for friction in (FRICTION, 4 * FRICTION):
        made = Reconstructor(dataclasses.replace(sensor, material=dataclasses.replace(sensor.material, friction=friction)))
        assert made.estimator.equations.loss.friction == friction
        found.append(made(images))
    shear = [(result.traction - (result.traction * result.normals).sum(-1, keepdim=True) * result.normals) for result in found]
    less, more = (torch.linalg.vector_norm(field, dim=-1).sum() for field in shear)
    assert more > less


def test_gas_pressure_is_in_the_sensors_units(sensor):
    gas = Reconstructor(dataclasses.replace(sensor, cavity=Cavity("gas", pressure=1000.0))).estimator.cavity.gas
    torch.testing.assert_close(gas[0], torch.tensor(0.1))
    assert float(gas[1]) == pytest.approx(sensor.membrane.cavity_volume, rel=1e-5)


@pytest.mark.parametrize("options", [dict(estimator=LEAST, model="harmonic"), dict(estimator="paper")], ids=str)
def test_estimators_of_least_energy_agree_with_each_other(sensor, options, images, result):
    with torch.no_grad():
        got = Reconstructor(sensor, **options)(images)
    assert (got.status == Status.OK).all()
    assert (got.vertices - result.vertices).norm(dim=-1).max() < 1.5
    assert ((got.displacement * result.displacement).sum((1, 2)) > 0).all()


class Solved(NamedTuple):
    """A harmonic reconstructor in double precision, what it finds from the exact pixels of a press, and on which rays.

    `vertices [V, 3]`, `volume_error` and `pressure []`; the vertices' ray origins and directions `[V, 3]`, on the rim where it
    rests and zero; ranges at rest `t_rest [V, 1]` and the change of them `psi [V, 1]`; `flow [D, 2]` of the markers, px;
    `relaxed [V, 1]`, first contacts, which the paper's smoother leaves alone.
    """

    made: Reconstructor
    vertices: torch.Tensor
    volume_error: torch.Tensor
    pressure: torch.Tensor
    origins: torch.Tensor
    directions: torch.Tensor
    t_rest: torch.Tensor
    psi: torch.Tensor
    flow: torch.Tensor
    relaxed: torch.Tensor


def solved(sensor, estimator, settings, status):
    made = Reconstructor(sensor, estimator, model="harmonic", settings=settings, locator="fit", dtype=torch.float64)
    got = made.from_pixels(torch.from_numpy(truth("two_contacts")["uv_deformed"].copy()))
    assert got.status.tolist() == [status] and (got.confidence == 1).all()
    membrane, x, flow = made.estimator.membrane, got.vertices[0], got.pixels[0] - made.rest_pixels
    rays, rest = made.observation(flow[None], got.confidence), made.camera.pixel_to_ray(made.vertex_pixels)
    rim = membrane.fixed[:, None]
    origins, directions = torch.where(rim, membrane.rest, rays.origins[0]), torch.where(rim, 0.0, rays.directions[0])
    t_rest = ((membrane.rest - rest.origin) * rest.direction).sum(-1, keepdim=True)
    psi = torch.where(rim, 0.0, ((x - origins) * directions).sum(-1, keepdim=True) - t_rest)
    relaxed = made.estimator.segmentation.by_polar_angle(rays.directions).region[0, :, None] > 0
    return Solved(made, x, got.volume_error[0], got.pressure[0], origins, directions, t_rest, psi, flow, relaxed)


@pytest.fixture(scope="module")
def plain(sensor):
    return solved(sensor, LEAST, MinimumEnergySettings(60), Status.OK)


@pytest.fixture(scope="module")
def papers(sensor):
    """Everything as the paper has it, the smoother stronger than by default, one round."""
    return solved(sensor, "paper", PaperSettings(smoothing=2.0, rounds=1), Status.NOT_CONVERGED)


def test_the_linear_volume_reaches_the_estimator_and_is_off_by_what_it_leaves_out(plain, papers):
    """Eq. 21, about the rest ranges on the rays now: the cubic's second and third order are left out, and nothing else."""
    membrane = papers.made.estimator.membrane

    def volume(share):
        return membrane.volume(papers.origins + (papers.t_rest + share * papers.psi) * papers.directions)

    second = torch.func.grad(torch.func.grad(volume))
    zero = torch.zeros((), dtype=torch.float64)
    quadratic, cubic = second(zero) / 2, torch.func.grad(second)(zero) / 6
    error = papers.volume_error * membrane.rest_volume
    assert abs(plain.volume_error) < 1e-12 and abs(papers.volume_error) > 1e-6
    torch.testing.assert_close(error, quadratic + cubic, rtol=1e-4, atol=0)
    torch.testing.assert_close(error, quadratic, rtol=0.1, atol=0)


def test_bilinear_flow_reaches_the_estimator(plain, papers):
    """Section 5: the vertices lie on the rays of their rest pixels moved by the bilinear matrix, not by the smooth flow."""
    made, free = papers.made, papers.made.estimator.membrane.free_vertices
    moved = made.vertex_pixels + torch.from_numpy(bilinear_matrix(made.estimator.membrane, made.marker_points)) @ papers.flow
    seen, smooth = (made.camera.point_to_pixel(one.vertices)[free] for one in (papers, plain))
    torch.testing.assert_close(seen, moved[free], rtol=0, atol=1e-6)
    assert (smooth - moved[free]).abs().max() > 0.2


@pytest.mark.parametrize(("which", "element", "smoothing"), [("plain", "triangle", 0.0), ("papers", "quadrilateral", 2.0)])
def test_element_and_smoother_reach_the_estimator(sensor, request, which, element, smoothing):
    """No force is left along the rays of the energy asked for, built here: of another element or weight there is."""
    one = request.getfixturevalue(which)
    membrane, x = one.made.estimator.membrane, one.vertices
    triangles = ElasticEnergy(membrane, "harmonic", sensor.material.prestretch, sensor.material.modulus)
    energies = {"triangle": triangles, "quadrilateral": AffineQuadrilaterals(membrane, triangles.tension)}
    start = one.origins + one.t_rest * one.directions
    bend = torch.where(one.relaxed, 0.0, grid_laplacian(one.psi, membrane.grid))
    bend = grid_laplacian(bend, membrane.grid)[:, 0]

    def left_over(energy, weight):
        load = rest_balance(membrane, energy)[1]
        of_fluid = one.pressure * membrane.volume_gradient(start if which == "papers" else x)
        force = ((energy.gradient(x) - load - of_fluid) * one.directions).sum(-1)
        return float((force + weight * triangles.tension * bend)[membrane.free_vertices].abs().max())

    found = {(name, weight): left_over(energy, weight) for name, energy in energies.items() for weight in (0.0, 0.1, 2.0)}
    right = found.pop((element, smoothing))
    assert right < 1e-7 < 1e-3 < min(found.values()), (right, found)


def test_gradients_flow_from_the_surface_to_the_image(reconstructor, images):
    image = images[1:2].clone().requires_grad_()
    reconstructor(image).displacement.square().sum().backward()
    assert image.grad.isfinite().all() and image.grad.abs().max() > 0


def test_state_dict_round_trip(sensor, reconstructor, images, result):
    other = Reconstructor(sensor, LEAST, model="harmonic")
    fresh = Reconstructor(sensor, LEAST)
    fresh.load_state_dict(reconstructor.state_dict())
    with torch.no_grad():
        torch.testing.assert_close(fresh(images).vertices, result.vertices)
        assert (other(images).vertices - result.vertices).abs().max() > 1e-3


def test_an_unknown_estimator_is_refused(sensor):
    with pytest.raises(MembraneError, match="expected one of"):
        Reconstructor(sensor, estimator="guess")


def test_results_survive_the_disk_and_foreign_files_do_not(result, tmp_path):
    results.save_frame(tmp_path / "a.npz", result.frame(1))
    again = results.stack_frames([results.load_frame(tmp_path / "a.npz")])
    for key, value in again._asdict().items():
        assert value.dtype == (torch.int32 if key == "status" else torch.float32)
        torch.testing.assert_close(value[0], result._asdict()[key][1], equal_nan=True)
    np.savez(tmp_path / "b.npz", other=1)
    (tmp_path / "c.npz").write_bytes(b"not a zip")
    (tmp_path / "d.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:5000])
    np.save(tmp_path / "e.npy", np.ones(3))
    (tmp_path / "e.npy").rename(tmp_path / "e.npz")
    for name in ("b", "c", "d", "e", "missing"):
        with pytest.raises(MembraneError, match=f"{name}.npz"):
            results.load_frame(tmp_path / f"{name}.npz")


def test_senseless_pixels_give_no_surface_and_say_so(reconstructor):
    pixels = reconstructor.rest_pixels.clone()[None].repeat(2, 1, 1)
    pixels[0] = pixels[0] * 1e30
    got = reconstructor.from_pixels(pixels)
    assert got.status.tolist() == [Status.TOO_FEW_MARKERS, Status.OK]
    assert got.vertices[0].isnan().all() and got.vertices[1].isfinite().all()


def test_what_is_found_without_gradients_can_be_used_where_they_are_taken(sensor):
    reconstructor = Reconstructor(sensor)
    with torch.no_grad():
        found = reconstructor(reconstructor.read(EXAMPLES / "press_on_axis.png"))
    leaf = found.pixels.clone().requires_grad_()
    (reconstructor.from_pixels(leaf, found.confidence).force * found.force).sum().backward()
    assert leaf.grad.abs().max() > 0


def test_an_image_is_saturated_where_nearly_all_of_it_is_white_and_dark_where_it_is_black(reconstructor):
    """A hundredth of the pixels are of the other kind: white dots on black are seen, a white image is not."""
    few = torch.rand(1, 1, 480, 640) < 0.01
    status = reconstructor.observer.check(torch.cat([few, ~few, torch.rand(1, 1, 480, 640) < 0.5]).float())
    assert status.tolist() == [Status.OK, Status.BLANK, Status.OK]


def test_the_noise_of_a_rest_state_falls_with_the_number_of_its_images(reconstructor):
    image = reconstructor.read(EXAMPLES / "rest.png")
    one, four = (reconstructor.observer.rest_of(image.expand(count, -1, -1, -1)) for count in (1, 4))
    torch.testing.assert_close(four.pixels, one.pixels, rtol=0, atol=1e-3)
    torch.testing.assert_close(four.covariance, one.covariance / 4, rtol=1e-3, atol=1e-9)
