"""Laws of eq. 29 and of the reconstruct / segment loop."""

import heapq

import numpy as np
import pytest
import torch

from torchmembrane.camera.model import Camera
from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.minimum_energy.flow import FlowInterpolation
from torchmembrane.estimators.minimum_energy.segmentation import PolarAngle, Segmentation, polar_angle
from torchmembrane.estimators.paper.estimator import PaperEstimator, PaperSettings
from torchmembrane.estimators.regions import PERSISTENCE, SHARE, persistent_peaks, persistent_regions
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.quasi_static import carried, press
from torchmembrane.surface.shapes import half_cylinder, spherical_cap

CAMERA = Camera("fisheye", (640, 480), (168, 168), (320, 240))
FAR, FINE = 15.0, (33, 33)
SETTLED = 2e-3  # over the surface's size


def central(points):
    return torch.zeros_like(points), torch.nn.functional.normalize(points, dim=-1)


def polar(membrane):
    return PolarAngle(membrane.rest, membrane.rest_normals, *central(membrane.rest))


def test_polar_angle_is_the_paper_s():
    """Eq. 29's arccos of the image point, of a pinhole of focal distance f."""
    f, u, v = 3.0, torch.tensor([0.3, -2.0, 5.0]), torch.tensor([-0.4, 1.0, 5.0])
    rays = torch.nn.functional.normalize(torch.stack([u, v, torch.full_like(u, f)], -1), dim=-1)
    torch.testing.assert_close(polar_angle(rays), torch.arccos(f / (u**2 + v**2 + f**2).sqrt()))


@pytest.mark.parametrize(("membrane", "printed_sign"), [
    (spherical_cap(12, 9, FAR), False),
    (half_cylinder(10, 30, 80, 4.0), None),
    (spherical_cap(12, 9, 0.2), True),
])  # fmt: skip
def test_an_inward_press_turns_rays_by_the_sign_of_the_geometry(membrane, printed_sign):
    """`d beta = s n.e / t` to first order; the printed sign holds only above the centre of curvature."""
    angle, s = polar(membrane), 1e-6
    oblique = (~membrane.fixed) & (membrane.rest[:, :2].norm(dim=-1) > 2)
    now = central(membrane.rest - s * membrane.rest_normals)[1]
    x, y, z = membrane.rest.unbind(-1)
    planar, t = (x**2 + y**2).sqrt(), membrane.rest.norm(dim=-1)
    growing = torch.stack([x * z / planar, y * z / planar, -planar], -1) / t[:, None]
    want = s * (membrane.rest_normals * growing).sum(-1) / t
    torch.testing.assert_close(angle.change(now)[oblique], want[oblique], rtol=1e-4, atol=1e-14)
    assert (angle.bulge(now)[oblique] > 0).all()
    if printed_sign is not None:
        assert ((angle.change(now)[oblique] < 0) == printed_sign).all()


def test_a_line_of_hills_is_cut_where_they_stand_alone():
    heights = torch.tensor([[[0, 4, 10, 9, 4, 8, 7.2, 7.5, 1, 0, -3, 0.4, 0]]])
    assert persistent_regions(heights, 4, 0.5).tolist() == [[[0, 0, 1, 1, 0, 2, 2, 2, 0, 0, 0, 0, 0]]]
    assert persistent_regions(heights, 1, 0.5).max() == 1
    assert persistent_regions(heights, 4, 9.0).tolist() == [[[0, 0, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]]]
    assert (persistent_regions(-heights.abs(), 4, 0.5) == 0).all()


def test_movement_is_that_of_the_farthest_point_and_infinite_where_one_comes_or_goes():
    membrane, lost = spherical_cap(12, 9, FAR), [torch.nan] * 3
    segmentation = Segmentation(membrane, central(membrane.rest))
    before = torch.tensor([[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], lost]] * 4)
    after = before.clone()
    after[1, 0] += torch.tensor([0.3, 0.0, 0.4])
    after[1, 1] += torch.tensor([0.0, 0.1, 0.0])
    after[2, 2] = torch.tensor([7.0, 8.0, 9.0])
    after[3, 1] = torch.nan
    expected = torch.tensor([0.0, 0.5 / float(membrane.size), torch.inf, torch.inf])
    torch.testing.assert_close(segmentation.moved(before, after).float(), expected)


def neighbours(vertex, shape):
    """The up to eight around a vertex, numbered row by row."""
    i, j = divmod(vertex, shape[1])
    rows, columns = range(max(i - 1, 0), min(i + 2, shape[0])), range(max(j - 1, 0), min(j + 2, shape[1]))
    return [r * shape[1] + c for r in rows for c in columns if (r, c) != (i, j)]


def flooded(height, count, least):
    """Peaks that stand for themselves, highest first, by flooding: vertices join in order of height, and where hills meet the
    lower ones end, unless they stand above the pass. `height [m, n]`; vertices, numbered row by row."""
    h, hill, standing = height.ravel(), {}, []
    for vertex in np.argsort(-h, kind="stable").tolist():
        if h[vertex] == -np.inf:
            break
        around = sorted({hill[k] for k in neighbours(vertex, height.shape) if k in hill}, key=lambda top: (-h[top], top))
        if not around:
            standing.append(vertex)
        hill[vertex] = around[0] if around else vertex
        for lower in around[1:]:
            if h[lower] - h[vertex] < PERSISTENCE * h.max():
                standing.remove(lower)
                hill |= {k: around[0] for k, top in hill.items() if top == lower}
    return [top for top in standing if h[top] >= least][:count]


def best_paths(height, peak):
    """The lowest height on the best path to a peak, `[m n]`, by Dijkstra's algorithm: the vertex with the best path is next."""
    h, best, front = height.ravel(), np.full(height.size, -np.inf), [(-height.ravel()[peak], peak)]
    while front:
        level, vertex = heapq.heappop(front)
        if best[vertex] == -np.inf:
            best[vertex] = -level
            for k in neighbours(vertex, height.shape):
                if best[k] == -np.inf and h[k] > -np.inf:
                    heapq.heappush(front, (max(level, -h[k]), k))
    return best


def regions_by_hand(height, count, least):
    """The regions by their definition: of the peaks to which the way is best, the nearest; above half of that one."""
    peaks, n = flooded(height, count, least), height.shape[1]
    region = np.zeros(height.size, int)
    paths = [best_paths(height, peak) for peak in peaks]
    for vertex in range(height.size if peaks else 0):
        best = max(path[vertex] for path in paths)
        near = [(vertex // n - peak // n) ** 2 + (vertex % n - peak % n) ** 2 for peak in peaks]
        k = min((k for k in range(len(peaks)) if paths[k][vertex] == best), key=lambda k: near[k])
        region[vertex] = (k + 1) * (best > SHARE * height.ravel()[peaks[k]])
    return region.reshape(height.shape)


def smooth_hills(seed, shape, knots=7):
    field = torch.randn(1, 1, knots, knots, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(field, shape, mode="bicubic", align_corners=True)[0, 0]


def winding_ridge(shape, along):
    """A ridge one vertex wide, to and fro over the rows with one row between, of heights as its length goes on; else 0."""
    m, n = shape
    path = []
    for row in range(0, m, 2):
        columns = range(n) if row % 4 == 0 else range(n - 1, -1, -1)
        path += [(row, j) for j in columns] + [(row + 1, columns[-1])] * (row + 1 < m)
    height = torch.zeros(shape)
    for place, (i, j) in zip(np.linspace(0, 1, len(path)), path, strict=True):
        height[i, j] = along(place)
    return height


def rippled(seed, knots=24):
    tops = np.random.default_rng(seed).uniform(0.5, 1, knots)
    return lambda place: float(np.interp(place * (knots - 1), np.arange(knots), tops))


def mesas(seed, shape, count=9):
    """Flat tops of different heights, some over others."""
    rng, height = np.random.default_rng(seed), torch.zeros(shape)
    for top in rng.permutation(np.linspace(0.3, 1, count)):
        i, j, a, b = rng.integers(0, shape[0] - 2), rng.integers(0, shape[1] - 2), *rng.integers(1, 9, 2)
        height[i : i + a, j : j + b] = height[i : i + a, j : j + b].clamp_min(float(top))
    return height


def noise(seed, shape):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def hills_with_holes(seed, shape):
    return torch.where(smooth_hills(20 + seed, shape, 9) < -0.2, -torch.inf, smooth_hills(seed, shape, 9))


FIELDS = {
    "smooth hills": (smooth_hills, [(25, 29), (33, 33), (17, 40), (41, 12)] * 2),
    "noise": (noise, [(5, 7), (9, 6)] * 10),
    "a winding ridge of ups and downs": (
        lambda seed, shape: winding_ridge(shape, rippled(seed)),
        [(17, 17), (9, 40), (33, 9)] * 2,
    ),
    "mesas": (mesas, [(20, 31), (33, 12)] * 4),
    "hills with holes": (hills_with_holes, [(15, 22)] * 6),
}


@pytest.mark.parametrize("kind", FIELDS)
def test_regions_are_those_of_flooding_and_of_the_best_paths(kind):
    make_field, shapes = FIELDS[kind]
    several = 0
    for seed, shape in enumerate(shapes):
        height = make_field(seed, shape)
        expected = regions_by_hand(height.numpy(), 4, 0.01)
        assert persistent_regions(height[None], 4, 0.01)[0].tolist() == expected.tolist()
        several += expected.max() > 1
    assert several > len(shapes) / 2


def peaks_by_hand(height, count, least, apart):
    """Peaks that stand, highest first: one after the other, above the best paths to those that stand already."""
    h, standing = height.ravel(), []
    tops = [k for k in range(h.size) if h[k] > max(h[j] for j in neighbours(k, height.shape))]
    for top in sorted(tops, key=lambda k: -h[k]):
        passes = [best_paths(height, higher)[top] for higher in standing]
        if h[top] >= least * h.max() and all(h[top] - each >= apart * h[top] for each in passes):
            standing.append(top)
    return standing[:count]


@pytest.mark.parametrize("apart", [0.1, 0.3])
def test_peaks_stand_by_a_share_of_themselves_above_the_passes_to_those_that_stand(apart):
    several = 0
    for seed in range(8):
        height = smooth_hills(seed, (19, 23), 8) + 0.5
        expected = peaks_by_hand(height.numpy(), 4, 0.1, apart)
        top, place = persistent_peaks(height[None], 4, 0.1, apart)
        assert place[0, top[0] > -torch.inf].tolist() == expected
        several += len(expected) > 1
    assert several > 4


def test_all_of_one_long_winding_ridge_is_one_region():
    """The way up from its end has more than 128 steps."""
    for shape in ((17, 17), (9, 27)):
        height = winding_ridge(shape, lambda place: 1 - 0.4 * place)
        assert torch.equal(persistent_regions(height[None], 4, 0.01)[0], (height > 0).long())


def test_frames_that_are_no_surfaces_break_no_others():
    """Heights NaN or minus infinity, all or some: nothing is found where they are, and in other frames what is found alone.

    Also where one frame is a thousand times as high as the others.
    """
    good, part, hollow = (smooth_hills(seed, (12, 19)) for seed in (1, 2, 3))
    part[3:6, 4:9], hollow[:5] = torch.nan, -torch.inf
    nothing = torch.full_like(good, torch.nan), torch.full_like(good, -torch.inf), torch.full_like(good, -1.0)
    frames = [nothing[0], good, part, nothing[1], hollow, nothing[2], 1024 * good]
    region = persistent_regions(torch.stack(frames), 4, 0.01)
    assert (region[[0, 3, 5]] == 0).all() and (region[2][part.isnan()] == 0).all()
    assert (region >= 0).all() and (region <= 4).all()
    for k, height in ((1, good), (4, hollow), (6, good)):
        assert region[k].tolist() == regions_by_hand(height.numpy(), 4, 0.01).tolist() and region[k].max() > 0


def make(base_z):
    dome = spherical_cap(12, 9, base_z, (17, 17))
    return Segmentation(dome, central(dome.rest))


def looped(segmentation, rays, smoothing=0.3, rounds=8):
    """The paper's loop."""
    dome, settings = segmentation.membrane, PaperSettings(smoothing)
    estimator = PaperEstimator(dome, ElasticEnergy(dome, "harmonic", 1.3), central(dome.rest), settings=settings)
    origins, directions = rays
    return estimator.reconstruct_and_segment(Observation(origins, directions, directions[..., 0]), rounds)


def observed(base_z, *presses):
    """Rays of the 17 x 17 grid from noisy markers of balls pressed on a 33 x 33 one, and the balls' contact points."""
    fine, dome = spherical_cap(12, 9, base_z, FINE), spherical_cap(12, 9, base_z, (17, 17))
    paths = []
    for direction, depth in presses:
        travel = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=-1)
        ball = Sphere(3.0, translation=(0, 0, base_z - 3.5)).touching(fine, travel)
        paths.append([ball, ball.moved(depth * travel)])
    state = press(fine, ElasticEnergy(fine, "neo_hookean", 1.3), paths)
    dots = spherical_cap(12, 9, base_z, (13, 13)).rest.reshape(13, 13, 3)[1:-1, 1:-1].reshape(-1, 3)
    pixel = CAMERA.point_to_pixel
    noise = 0.05 * torch.randn(len(dots), 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    displacement = pixel(carried(state.vertices, fine, dots)) - pixel(dots) + noise
    flow = FlowInterpolation(dome, dome.closest_points(dots.numpy()))(displacement, torch.ones(len(dots)).double())
    return CAMERA.pixel_to_ray(pixel(dome.rest) + flow), state.contact_points


def batch(rays):
    return (a[None] for a in rays)


@pytest.fixture(scope="module")
def off_axis():
    return observed(FAR, ((-0.55, 0.1, -0.83), 3.0))


def test_one_contact_off_the_axis(off_axis):
    """The sign of the geometry finds it, the printed one does not, and the loop comes nearer."""
    rays, (place,) = off_axis
    segmentation = make(FAR)
    got = looped(segmentation, batch(rays))

    def miss(contacts):
        return float((contacts.points[0, 0] - place).norm())

    assert got.contacts.points[0, 1:].isnan().all() and got.first.points[0, 1:].isnan().all()
    assert miss(got.contacts) < miss(got.first) < 3
    segmentation.polar.sign = -segmentation.polar.sign
    assert miss(segmentation.by_polar_angle(rays.direction[None])) > 10
    assert got.moved.max() < SETTLED and got.surface.vertices.shape == (1, 289, 3)


def test_the_paper_s_own_loop_ends_where_contact_and_surface_agree(off_axis):
    """Section 5.1 around the paper's estimator, the smoother relaxed at the contact.

    It comes nearer than eq. 29 alone, and ends in a fixed point: the contact is the surface's, the surface the contact's.
    """
    rays, (place,) = off_axis
    dome, segmentation = make(FAR).membrane, make(FAR)
    settings = PaperSettings(smoothing=0.3, rounds=8)
    papers = PaperEstimator(dome, ElasticEnergy(dome, "harmonic", 1.3), central(dome.rest), settings=settings)
    observation = Observation(*batch(rays), torch.ones(1, 289, dtype=torch.float64))
    got = papers.reconstruct_and_segment(observation, 8)
    first, last = (float((contacts.points[0, 0] - place).norm()) for contacts in (got.first, got.contacts))
    assert last < first < 3 and got.contacts.points[0, 1:].isnan().all() and got.moved.max() < SETTLED
    assert torch.equal(segmentation.by_normals(got.surface.vertices).region, got.contacts.region)
    region = got.contacts.region
    relaxed, plain = (
        papers.solve(observation, region > 0),
        papers.solve(observation, torch.zeros_like(region, dtype=torch.bool)),
    )
    torch.testing.assert_close(got.surface.vertices, relaxed.vertices, rtol=0, atol=1e-9)
    torch.testing.assert_close(got.surface.vertices, papers(observation).vertices, rtol=0, atol=1e-9)
    assert (got.surface.vertices - plain.vertices).norm(dim=-1).max() > 1e-3


def test_two_contacts():
    rays, places = observed(FAR, ((-0.6, 0.0, -0.8), 2.0), ((0.6, 0.0, -0.8), 2.0))
    got = looped(make(FAR), batch(rays)).contacts.points[0]
    gap = torch.cdist(got[:2], places)
    assert gap.amin(0).max() < 2.5 and gap.argmin(0).tolist() in ([0, 1], [1, 0])
    assert got[2:].isnan().all()


@pytest.mark.parametrize("base_z", [3.0, 24.0])
def test_a_press_along_the_axis_is_divergent_flow(base_z, off_axis):
    rays, (place,) = observed(base_z, ((0.0, 0.0, -1.0), 2.0))
    segmentation = make(base_z)
    assert segmentation.divergence(rays.direction[None]) > 0.9
    first = segmentation.by_polar_angle(rays.direction[None]).points[0]
    assert first[0, :2].norm() < 0.3 and (first[0] - place).norm() < 2.5 and first[1:].isnan().all()
    assert make(FAR).divergence(off_axis[0].direction[None]) < 0.8


def mirrored_dent(tilt, depth, n=33):
    """A dome with its part beyond a plane mirrored in it: dome, surface, axis, which vertices, how far they are beyond it.

    A sphere's normal `n` becomes `2 (n.e) e - n` there, so that the mean of both runs along the plane's normal `e` everywhere.
    """
    dome = spherical_cap(12, 9, FAR, (n, n))
    axis = torch.tensor([np.sin(tilt), 0.0, np.cos(tilt)], dtype=torch.float64)
    beyond = (dome.rest - torch.tensor([0.0, 0.0, FAR + 9 - 12.5])) @ axis - (12.5 - depth)
    dent = beyond > 0
    return dome, dome.rest - 2 * beyond.clamp_min(0)[:, None] * axis, axis, dent, beyond


def test_a_steep_dent_bulges_along_the_mean_of_both_normals():
    """The sphere's mirror image, 35 degrees off the axis: a displacement known exactly, along the mean normals exactly.

    Along the rest normals its edge would seem a quarter shallower.
    """
    dome, x, axis, dent, beyond = mirrored_dent(np.deg2rad(35), 2.5)
    rays = central(dome.rest)
    got = Segmentation(dome, rays).by_normals(x[None])
    well_inside = dent & (beyond > 0.4)
    along_rest = -((x - dome.rest) * dome.rest_normals).sum(-1)
    assert well_inside.sum() > 60 and (along_rest / (2 * beyond))[well_inside].min() < 0.85
    torch.testing.assert_close(got.bulge[0, well_inside], 2 * beyond[well_inside], rtol=0.01, atol=0)
    assert torch.equal(got.region[0] > 0, got.bulge[0] > 0.5 * got.bulge.max()) and got.points[0, 1:].isnan().all()
    place = got.points[0, 0] - torch.tensor([0.0, 0.0, FAR + 9 - 12.5])
    assert (place - (place @ axis) * axis).norm() < 0.1
    weight = torch.where(got.region[0] > 0, beyond * dome.rest_area, 0.0)  # the point lies in the dent, not above it at rest
    torch.testing.assert_close(got.points[0, 0], weight @ x / weight.sum(), rtol=0, atol=0.02)
    assert (got.points[0, 0] - weight @ dome.rest / weight.sum()).norm() > 2


def test_no_flow_is_no_contact_and_a_batch_is_its_frames(off_axis):
    """Also where another frame goes round in circles."""
    segmentation = make(FAR)
    still = central(segmentation.membrane.rest)
    restless, _ = observed(FAR, ((-0.3, 0.2, -0.8), 2.0), ((0.4, 0.0, -0.8), 1.0))
    both = looped(segmentation, [torch.stack(three) for three in zip(still, off_axis[0], restless, strict=True)], 1.0)
    assert both.contacts.points[0].isnan().all() and (both.contacts.region[0] == 0).all()
    assert both.moved[0] == 0
    alone = looped(segmentation, batch(off_axis[0]), 1.0)
    torch.testing.assert_close(both.contacts.points[1:2], alone.contacts.points, rtol=0, atol=1e-9, equal_nan=True)
    torch.testing.assert_close(both.surface.vertices[1:2], alone.surface.vertices, rtol=0, atol=1e-9)


def test_the_smoother_leaves_contacts_alone(off_axis):
    """Eq. 28 with the rows of S at a contact struck out, against the dense KKT system."""
    dome = spherical_cap(12, 9, FAR, (9, 9))
    rays = central(dome.rest)
    estimator = PaperEstimator(dome, ElasticEnergy(dome, "harmonic", 1.3), rays, settings=PaperSettings(2.0))
    bent = torch.nn.functional.normalize(rays[1] + 0.02 * torch.sin(dome.rest[:, [1, 2, 0]]) * (~dome.fixed)[:, None], dim=-1)
    relaxed = torch.zeros(len(dome.rest), dtype=torch.bool)
    relaxed[[30, 31, 40]] = True
    free, t0 = dome.free_vertices, dome.rest.norm(dim=-1)
    index = torch.arange(81).reshape(9, 9)
    pairs = torch.cat([torch.stack([index[1:].flatten(), index[:-1].flatten()], -1),
                       torch.stack([index[:, 1:].flatten(), index[:, :-1].flatten()], -1)])  # fmt: skip
    weight = 1 - 0.5 * (dome.fixed[pairs].all(-1)).double()
    S = torch.zeros(81, 81, dtype=torch.float64)
    for (a, b), w in zip(pairs.tolist(), weight.tolist(), strict=True):
        for p, q, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            S[p, q] += sign * w
    start = torch.where(dome.fixed[:, None], dome.rest, t0[:, None] * bent)
    Q = estimator.energy.q_matrix(bent)
    v = (dome.volume_gradient(start) * bent).sum(-1)[free]
    smooth = 2.0 * estimator.elasticity.tension * S.T @ ((~relaxed).double()[:, None] * S)
    K = (Q.T @ Q + smooth)[free][:, free]
    load = ((estimator.rest_load - estimator.energy.gradient(start)) * bent).sum(-1)[free]
    kkt = torch.cat([torch.cat([K, v[:, None]], 1), torch.cat([v, torch.zeros(1).double()])[None]])
    psi = torch.linalg.solve(kkt, torch.cat([load, (dome.rest_volume - dome.volume(start))[None]]))[:-1]
    t = t0.clone()
    t[free] += psi
    x = torch.where(dome.fixed[:, None], dome.rest, t[:, None] * bent)
    observation = Observation(rays[0][None], bent[None], torch.ones_like(t)[None])
    torch.testing.assert_close(estimator.solve(observation, relaxed[None]).vertices[0], x, rtol=0, atol=1e-9)
    assert (estimator.solve(observation, torch.zeros_like(relaxed[None])).vertices[0] - x).abs().max() > 1e-5
