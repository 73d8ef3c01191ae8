"""Wrench, force, normal, area, slip and curvature of contacts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchmembrane import Reconstructor, Status
from torchmembrane.estimators.contacts import BESIDE, MOVED, ContactPatches
from torchmembrane.estimators.force_balance.settings import ForceBalanceSettings
from torchmembrane.estimators.force_balance.traction_loss import TractionLoss
from torchmembrane.markers.coverage import Coverage, facings
from torchmembrane.presets import preset
from torchmembrane.results.npz import ADDED, completed
from torchmembrane.results.reconstruction import Reconstruction
from torchmembrane.sensor.parts import FRICTION
from torchmembrane.sensor.working_range import UNLIMITED
from torchmembrane.simulate import Simulator, Sphere, Stroke
from torchmembrane.simulate.appearance import Appearance
from torchmembrane.surface.shapes import spherical_cap

DOME = spherical_cap(12, 9, 3, (33, 33))
PATCHES = ContactPatches(DOME)
SURROUNDINGS = TractionLoss(DOME, 1.0, ForceBalanceSettings(), FRICTION).surroundings


def pressed_by(x, centres, radius=3.0, size=0.02, shear=0.0):
    """Traction of even pushes on discs about the rest vertices nearest to `centres`, with shear along x; and the discs."""
    normals = DOME.normals(x)
    along = torch.tensor([1.0, 0, 0], dtype=x.dtype) - normals[..., :1] * normals
    along = along / along.norm(dim=-1, keepdim=True)
    discs = [(DOME.rest - torch.tensor(c, dtype=x.dtype)).norm(dim=-1) < radius for c in centres]
    disc = torch.stack(discs).any(0)[None, :, None] & ~DOME.fixed[:, None]
    return size * disc * (shear * along - normals), normals, discs


def told(x, traction, normals):
    reference = torch.full_like(x[..., 0], 1e-6)
    return PATCHES.pushes(x, normals, traction, reference, SURROUNDINGS)


@pytest.mark.parametrize("shear", [0.0, 0.5])
def test_patches_of_known_pushes(shear):
    """Two discs: forces add up to the whole, areas are the discs', slip is the shear over the push."""
    x = DOME.rest[None]
    traction, normals, discs = pressed_by(x, [(6.0, 0.0, 11.0), (-6.0, 0.0, 11.0)], shear=shear)
    found = told(x, traction, normals)
    load = traction * DOME.rest_area[:, None]
    torch.testing.assert_close(found.force[0, :2].sum(0), load.sum((0, 1)))
    assert found.points[0, 2:].isnan().all() and found.force[0, 2:].isnan().all() and found.at_rim[0, 2:].isnan().all()
    for k in range(2):
        mine = discs[0] if found.points[0, k, 0] > 0 else discs[1]
        torch.testing.assert_close(found.force[0, k], load[0, mine].sum(0))
        torch.testing.assert_close(found.area[0, k], DOME.vertex_area(x)[0, mine].sum())
        centre = (found.points[0, k] - torch.tensor([0.0, 0, DOME.rest[:, 2].max() - 12.5])) / 12.5  # the cap's own sphere
        torch.testing.assert_close(found.normal[0, k], centre / centre.norm(), atol=0.03, rtol=0)
        assert found.slip[0, k] == pytest.approx(shear, abs=0.02)
    assert (found.at_rim[0, :2] == 0).all()


def test_a_touch_beside_one_tenfold_as_strong_is_told_and_of_five_the_strongest_four():
    """Forces of the patches are those of the discs, strongest first; what is of the fifth adds to the nearest."""
    x = DOME.rest[None]
    strong, normals, (first,) = pressed_by(x, [(5.0, 0.0, 11.0)], radius=3.0)
    weak, _, (second,) = pressed_by(x, [(-6.0, 0.0, 11.0)], radius=1.5, size=0.006)
    found = told(x, strong + weak, normals)
    load = (strong + weak) * DOME.rest_area[:, None]
    forces = torch.stack([load[0, disc].sum(0) for disc in (first, second)])
    assert forces[0].norm() > 9 * forces[1].norm() and found.points[0, 2:].isnan().all()
    torch.testing.assert_close(found.force[0, :2], forces)
    places = [(7.0, 0.0, 10.0), (-7.0, 0.0, 10.0), (0.0, 7.0, 10.0), (0.0, -7.0, 10.0), (0.0, 0.0, 12.0)]
    tractions = [pressed_by(x, [place], radius=1.6, size=0.01 * (k + 1))[0] for k, place in enumerate(places)]
    found, load = told(x, sum(tractions), normals), sum(tractions) * DOME.rest_area[:, None]
    torch.testing.assert_close(found.force[0].sum(0), load[0].sum(0))
    strength = found.force[0].norm(dim=-1)
    assert (strength[:-1] >= strength[1:]).all() and found.points[0].isfinite().all()
    assert (found.points[0] - torch.tensor(places[0]).double()).norm(dim=-1).min() > 3


@pytest.mark.parametrize(("edge", "rough"), [(1.0, 0.0), (3.0, 0.0), (1.0, 0.8)])
def test_a_flat_plate_is_one_contact(edge, rough):
    """A wide disc, also where its edge bears more than its middle, as a plate's does, and where pushes vary from vertex to
    vertex."""
    x = DOME.rest[None]
    traction, normals, (disc,) = pressed_by(x, [(0.0, 0.0, 12.0)], radius=6.0)
    rim = disc & ((DOME.rest - torch.tensor([0.0, 0.0, 12.0]).double()).norm(dim=-1) > 5)
    vary = 1 + rough * (2 * torch.rand(len(disc), 1, generator=torch.Generator().manual_seed(0)) - 1)
    found = told(x, vary * torch.where(rim[:, None], edge * traction, traction), normals)
    assert found.points[0, 1:].isnan().all()
    assert (found.points[0, 0, :2]).norm() < 0.5


def test_the_area_of_a_contact_is_that_of_the_deformed_surface():
    """The sheet and all on it a tenth larger: the same patch, of 1.21 times the area."""
    traction, normals, _ = pressed_by(DOME.rest[None], [(0.0, 0.0, 12.0)])
    once, larger = told(DOME.rest[None], traction, normals), told(1.1 * DOME.rest[None], traction, normals)
    torch.testing.assert_close(larger.area, 1.21 * once.area, equal_nan=True)
    torch.testing.assert_close(larger.points, 1.1 * once.points, equal_nan=True)


@pytest.mark.parametrize("form", ["dent", "saddle"])
def test_curvatures_are_those_of_the_surface(form):
    """A dent in the shape of a sphere, and a saddle, on a plane: principal curvatures hollow seen from outside are positive."""
    u, v = DOME.rest[:, 0] - 2.0, DOME.rest[:, 1] + 1.0
    height = (u * u + v * v) / 10 if form == "dent" else (u * u - v * v) / 10
    x = torch.stack([u, v, height], -1)[None]
    traction, normals, _ = pressed_by(x, [(2.0, -1.0, 11.5)], radius=2.0)
    found = told(x, traction, normals)
    expected = torch.tensor([0.2, 0.2 if form == "dent" else -0.2])
    torch.testing.assert_close(found.curvature[0, 0].float(), expected, atol=0.02, rtol=0)


def test_curvatures_do_not_depend_on_the_frame():
    """The surface turned in space has the same curvatures, also where its tangent plane is steep."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
    turn = turn * torch.det(turn)
    u, v = DOME.rest[:, 0], DOME.rest[:, 1]
    x = torch.stack([u, v, u * u / 8 - v * v / 20 + 0.02 * u * v], -1)[None]
    traction, normals, _ = pressed_by(x, [(0.0, 0.0, 12.0)], radius=2.5)
    once, turned = told(x, traction, normals), told(x @ turn.mT, traction @ turn.mT, normals @ turn.mT)
    torch.testing.assert_close(once.curvature, turned.curvature, atol=1e-4, rtol=1e-4, equal_nan=True)
    torch.testing.assert_close(once.slip, turned.slip, equal_nan=True)
    torch.testing.assert_close(once.normal @ turn.mT, turned.normal, equal_nan=True)


def test_curvatures_are_a_sphere_s_from_a_plane_that_is_not_its_tangent():
    """The height over a plane tilted by 0.4: its slopes and its mixed derivative count."""
    u, v = (0.15 * DOME.rest[:, k] for k in (0, 1))
    x = torch.stack([u, v, 10 - (100 - u * u - v * v).sqrt()], -1)[None]
    tilted = torch.nn.functional.normalize(torch.tensor([[[0.3, 0.25, 1.0]]], dtype=torch.float64), dim=-1)
    share = torch.full((1, 1, len(DOME.rest)), 1 / len(DOME.rest), dtype=torch.float64)
    curvature, _ = PATCHES._curvature(x, tilted, share, share)
    torch.testing.assert_close(curvature, torch.full((1, 1, 2), 0.1, dtype=torch.float64), rtol=0.03, atol=0)


def test_a_patch_of_fewer_than_two_grid_steps_has_no_curvature():
    x = DOME.rest[None]
    traction, normals, _ = pressed_by(x, [(0.0, 0.0, 12.0)], radius=0.5)
    found = told(x, traction, normals)
    assert found.curvature[0, 0].isnan().all() and found.area[0, 0] > 0


def test_a_patch_at_the_rim_says_so_and_one_clear_of_it_does_not():
    """Discs pushed by one length unit, less near the rim, the sheet around them with them; it takes push and movement there."""
    rest, rim = DOME.rest[None], DOME.rest[DOME.fixed].double()
    near = (torch.cdist(DOME.rest, rim).amin(1) / (0.1 * DOME.size)).clamp_max(1)
    said = []
    for centre in DOME.rest[::37]:
        if (centre - rim).norm(dim=-1).min() < 1.0:
            continue
        traction, normals, (disc,) = pressed_by(rest, [centre.tolist()], radius=2.0)
        disc = disc & ~DOME.fixed
        beyond = torch.cdist(DOME.rest, DOME.rest[disc]).amin(1)
        depth = (1 - beyond / (0.05 * DOME.size)).clamp_min(0) * near
        pushed = rest - depth[:, None] * normals
        away = torch.cdist(DOME.rest[disc], rim).min() / DOME.size
        if away < 0.02:
            assert told(pushed, traction, normals).at_rim[0, 0] == 1
            assert told(rest, traction, normals).at_rim[0, 0] == 0
            said.append(True)
        if away > 0.12:
            assert told(pushed, traction, normals).at_rim[0, 0] == 0
            said.append(False)
    assert set(said) == {True, False}


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_on_a_coarse_grid_the_rim_is_reached_by_movement_that_grows_with_the_distance_from_it(share):
    """No vertex is as near the rim as `BESIDE`: of the nearest is asked so many times more as it is farther away."""
    dome = spherical_cap(12, 9, 3, (7, 7))
    patches, inner = ContactPatches(dome, spacing=dome.size), (~dome.fixed).nonzero()[:, 0]
    from_rim = torch.cdist(dome.rest[inner], dome.rest[dome.fixed]).amin(1)
    vertex, farther = inner[from_rim.argmin()], float(from_rim.min() / (BESIDE * dome.size))
    assert farther > 1.2
    x, normals = dome.rest[None].clone(), dome.normals(dome.rest)[None]
    x[0, dome.rest[:, 2].argmax(), 2] -= 1.0
    x[0, vertex, 2] -= share * MOVED * farther
    touched = torch.zeros(1, len(dome.rest), dtype=torch.float64)
    touched[0, vertex] = 1
    found = patches(x, normals, -normals * touched[..., None], touched, x[:, vertex, None].mT, touched[:, None])
    assert bool(found.at_rim[0, 0] == 1) == (share > 1)


def test_a_push_in_the_middle_of_a_sheet_that_moves_as_a_whole_is_clear_of_the_rim():
    rest = DOME.rest[None]
    traction, normals, _ = pressed_by(rest, [(0.0, 0.0, 12.0)], radius=2.0)
    assert told(rest - 0.5 * normals * ~DOME.fixed[:, None], traction, normals).at_rim[0, 0] == 0


def test_coverage_is_the_share_of_area_near_found_markers():
    """Half of the markers lost: half of the area; a lone lost one among found ones hides nothing; those unseen do not count."""
    u, v = torch.meshgrid(torch.linspace(-9, 9, 12), torch.linspace(-9, 9, 12), indexing="ij")
    positions = torch.stack([u, v, 0 * u], -1).reshape(-1, 3).double()
    flat = spherical_cap(12, 0.5, 3, (33, 33))
    positions[:, 2] = 3
    seen = torch.ones(len(positions), dtype=torch.bool)
    facing = torch.ones(len(positions), dtype=torch.float64)
    coverage = Coverage(flat, positions, seen, facing)
    found = torch.ones(3, len(positions), dtype=torch.float64)
    found[1, positions[:, 0] > 0] = 0
    found[2, 66] = 0
    everything, half, lone = coverage(found).tolist()
    assert everything == pytest.approx(1) and lone == pytest.approx(1) and half == pytest.approx(0.57, abs=0.04)
    assert Coverage(flat, positions, positions[:, 0] < 0, facing)(found)[1] == pytest.approx(1)


@pytest.fixture(scope="module")
def fingertip():
    sensor = preset("fingertip")
    sensor = replace(sensor, membrane=sensor.surface.membrane((17, 17)))
    return Simulator(sensor, grid=(31, 31), appearance=Appearance(noise=35.0)), Reconstructor(sensor)


@pytest.fixture(scope="module")
def pressed(fingertip):
    """A ball with friction pressed into the side: the state, its image, the truth and what is found."""
    simulator, reconstructor = fingertip
    way = np.array([0.5, 0.2, -1.0]) / np.linalg.norm([0.5, 0.2, -1.0])
    stroke = Stroke(Sphere(5.0).touching(simulator.membrane, way), way, 2.0)
    (state,) = simulator.presses(stroke, ("push",))
    frame = simulator.frame(state, stroke, np.random.default_rng(0))
    with torch.no_grad():
        return state, frame, reconstructor(frame.image)


def test_wrench_and_patch_against_the_simulator(fingertip, pressed):
    simulator, (state, _, got) = fingertip[0], pressed
    load = state.traction * simulator.membrane.vertex_area(state.vertices)[:, None]
    force, moment = load.sum(0), torch.linalg.cross(state.vertices, load).sum(0)
    torch.testing.assert_close(force, state.force, rtol=1e-6, atol=1e-9)
    assert (got.wrench[0, :3] - force).norm() < 0.1 * force.norm()
    assert (got.wrench[0, 3:] - moment).norm() < 0.5 * force.norm()  # mm
    assert got.contact_points[0, 1:].isnan().all() and (got.contact_force[0, 0] - force).norm() < 0.1 * force.norm()
    assert got.contact_slip[0, 0] < 0.1 and got.contact_at_rim[0, 0] == 0
    touched = state.contact
    normal = torch.nn.functional.normalize(simulator.membrane.normals(state.vertices)[touched].mean(0), dim=0)
    assert (got.contact_normal[0, 0] * normal).sum() > 0.995
    area = float(simulator.membrane.vertex_area(state.vertices)[touched].sum())
    assert 0.55 * area < got.contact_area[0, 0] < 1.8 * area  # whole vertices of a coarse grid
    assert float(got.contact_curvature[0, 0].mean()) == pytest.approx(1 / 5.0, rel=0.25)


def test_traction_splits_into_push_and_shear(pressed):
    got = pressed[2]
    push, shear = got.split_traction()
    torch.testing.assert_close(shear - push[..., None] * got.normals, got.traction)
    assert (shear * got.normals).sum(-1).abs().max() < 1e-5 * got.traction.abs().max()


def test_a_marker_faces_the_camera_by_the_cosine_between_its_normal_and_its_line_of_sight():
    normal = torch.tensor([[0.0, 0.6, 0.8], [0.0, 0.0, 3.0], [0.0, 2.0, -1.0]])
    point = torch.tensor([[0.0, 0.0, 5.0]]).expand(3, 3)
    torch.testing.assert_close(facings(point, normal), torch.tensor([0.8, 1.0, -(5**-0.5)]))


def test_a_marker_is_turned_away_where_it_is_from_every_view_that_saw_it_at_rest():
    """Of two views; half of the markers are lost. A view that did not see a marker at rest has no say."""
    u, v = torch.meshgrid(torch.linspace(-9, 9, 12), torch.linspace(-9, 9, 12), indexing="ij")
    positions = torch.stack([u, v, 0 * u + 3], -1).reshape(-1, 3).double()
    lost, ones = positions[:, 0] > 0, torch.ones(2, len(positions), dtype=torch.float64)
    found = torch.where(lost, 0.0, ones)

    def in_view(seen, *turned):
        coverage = Coverage(spherical_cap(12, 0.5, 3, (33, 33)), positions, seen.flatten(), ones.flatten())
        facing = torch.stack([torch.where(lost, 0.1 if away else 0.9, 1.0) for away in turned]).double()
        return float(coverage.in_view((found * seen).flatten()[None], facing.flatten()[None]))

    both, first = ones > 0, torch.stack([torch.ones(144), torch.zeros(144)]) > 0
    whole, hidden = pytest.approx(1.0), pytest.approx(0.57, abs=0.04)
    assert [in_view(both, *turned) for turned in ((True, True), (True, False), (False, False))] == [whole, hidden, hidden]
    assert [in_view(first, *turned) for turned in ((True, False), (False, True))] == [whole, hidden]


def test_markers_that_the_press_turns_away_are_not_hidden(fingertip, monkeypatch):
    """Of a dent whose walls are seen at a grazing angle: lost markers on the walls are its doing, as many others are not."""
    reconstructor = fingertip[1]
    monkeypatch.setattr(reconstructor, "range", UNLIMITED)
    net, rest = reconstructor.estimator, reconstructor.estimator.membrane.rest
    off2 = (rest - rest[rest[:, 2].argmax()]).square().sum(-1) / net.size**2
    dent = 1.4 * net.size * torch.exp(-off2 / 0.08)[:, None] * net.membrane.rest_normals * ~net.membrane.fixed[:, None]
    u, (_, pressure, moved) = -dent[None], net.at_rest(torch.ones(1, len(reconstructor.rest_markers)))
    seen = torch.ones(1, len(reconstructor.rest_markers))
    observation = reconstructor.observation(torch.zeros(1, seen.shape[1], 2), seen)
    found = net.equilibrium(u, pressure, moved, u, net.equations.bearings.measured(observation))
    none = {name: 0 * pressure for name in ("misfit", "unexplained", "shared_misfit")}  # it is no equilibrium
    found = found._replace(volume=net.membrane.rest_volume[None], **none)
    markers = reconstructor.rest_markers + reconstructor.marker_shares @ u
    moved_by = reconstructor.camera.point_to_pixel(markers) - reconstructor.rest_pixels
    facing = facings(markers, reconstructor.marker_shares @ net.membrane.normals(rest + u))
    walls, number = facing < 0.4, int((facing < 0.4).sum())
    others = torch.zeros_like(walls)
    others[0, facing[0].argsort(descending=True)[:number]] = True
    for lost, status in ((walls, Status.OK), (others, Status.HIDDEN)):
        confidence = torch.where(lost, 0.0, seen)
        told = reconstructor.result(found, observation, moved_by, confidence, torch.zeros(1))
        assert int(told.status) == status and float(told.coverage) < 0.85


@pytest.mark.parametrize("off, status", [(1.4, Status.OK), (1.6, Status.UNEXPLAINED)])
def test_a_residual_of_pixels_is_never_ok(fingertip, off, status):
    """Whatever the other numbers of the frame say: here all are those of a surface at rest that is explained."""
    reconstructor = fingertip[1]
    seen = torch.ones(1, len(reconstructor.rest_markers))
    rest = torch.zeros(1, seen.shape[1], 2)
    observation = reconstructor.observation(rest, seen)
    found = reconstructor.estimator(observation)
    told = reconstructor.result(found, observation, rest + torch.tensor([0.6 * off, 0.8 * off]), seen, torch.zeros(1))
    assert int(told.status) == status
    torch.testing.assert_close(told.residual, torch.tensor([off]), rtol=0.02, atol=0)


def test_a_hidden_part_is_said(fingertip, pressed):
    reconstructor, image = fingertip[1], pressed[1].image
    covered = image.copy()
    covered[:, : image.shape[1] * 2 // 5] = np.median(image)
    with torch.no_grad():
        got = reconstructor(np.stack([image, covered]))
    assert got.status.tolist() == [Status.OK, Status.HIDDEN]
    assert got.vertices.isfinite().all() and got.coverage[0] > 0.99 and 0.4 < got.coverage[1] < 0.85


def test_frames_of_before_are_read_with_what_they_lack_as_nan(pressed):
    frame = pressed[2].frame(0)
    old = {key: value for key, value in frame.items() if key not in ADDED}
    again = completed(old)
    assert list(again) == list(Reconstruction._fields)
    for key, value in frame.items():
        assert again[key].shape == value.shape and again[key].dtype == value.dtype
        assert np.isnan(again[key]).all() if key in ADDED else np.array_equal(again[key], value, equal_nan=True)
    with pytest.raises(KeyError):
        completed({key: value for key, value in frame.items() if key != "force"})
