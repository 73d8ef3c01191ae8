"""The paper's estimator obeys its equations stage by stage."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from affine_maps import affine_fit
from axisymmetric import harmonic, least_energy

import torchmembrane as tm
from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergy, MinimumEnergySettings
from torchmembrane.estimators.paper.estimator import FLOWS, OCCUPIED, PaperEstimator, PaperSettings, grid_laplacian
from torchmembrane.mechanics.affine_quadrilateral import AffineQuadrilaterals
from torchmembrane.mechanics.cavity import rest_balance
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.sensor.factories import cavity_filling, elastic_energy
from torchmembrane.sensor.parts import Cavity
from torchmembrane.solve.stencil import inner
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import disc_grid, ellipsoid_cap
from torchmembrane.surface.topology import corners

EXAMPLES = Path(__file__).parents[1] / "examples"
GRIDS = [(9, 9), (10, 8), (6, 11)]


def rest_rays(membrane):
    return torch.zeros_like(membrane.rest), torch.nn.functional.normalize(membrane.rest, dim=-1)


def make(grid=(9, 9), hole=False, **options):
    cap = ellipsoid_cap((12, 9, 12), 2, grid)
    if hole:
        fixed = cap.fixed.clone()
        fixed[grid[0] // 2 * grid[1] + grid[1] // 2] = True
        cap = Membrane(cap.rest.reshape(*grid, 3).numpy(), fixed.reshape(grid).numpy())
    filling, gas = options.pop("filling", "liquid"), options.pop("gas", None)
    elasticity = ElasticEnergy(cap, "harmonic", 1.2)
    return PaperEstimator(cap, elasticity, rest_rays(cap), filling, gas, PaperSettings(**options))


def observed(membrane, size=0.03, batch=2):
    """Rays turned smoothly, not at the rim."""
    origins, directions = rest_rays(membrane)
    phase = torch.rand(batch, 1, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    turn = torch.sin(5 * membrane.rest[:, [1, 2, 0]] / membrane.size + 6 * phase) * (~membrane.fixed)[:, None]
    directions = torch.nn.functional.normalize(directions + size * turn, dim=-1)
    return Observation(origins.expand_as(directions), directions, torch.ones_like(directions[..., 0]))


def some_relaxed(membrane, batch=2):
    relaxed = torch.zeros(batch, len(membrane.rest), dtype=torch.bool)
    relaxed[1, membrane.free_vertices[5:9]] = True
    return relaxed


def dense(estimator, q, relaxed):
    """`Q [B, rows, V]` and `S` with the rows of contacts struck out, `[B, V, V]`."""
    membrane = estimator.membrane
    index = corners(torch.arange(len(membrane.rest))[:, None], membrane.grid)[..., 0].reshape(-1, 4)
    Q = torch.zeros(len(q), len(index), 6, len(membrane.rest), dtype=torch.float64)
    for k, vertices in enumerate(index.tolist()):
        Q[:, k][..., vertices] = q.flatten(1, 2)[:, k]
    S = grid_laplacian(torch.eye(len(membrane.rest), dtype=torch.float64), membrane.grid)
    return Q.flatten(1, 2), S * (~relaxed)[..., None]


@pytest.mark.parametrize(("grid", "hole"), [*((grid, False) for grid in GRIDS), ((9, 10), True)])
def test_one_frame_through_the_chain(grid, hole):
    """Maps (15-17), Q (18), smoother (28), volume (21), eq. 22 and its KKT system (25-27), from the rays to the surface."""
    weight = 0.3
    estimator = make(grid, hole, smoothing=weight)
    membrane, energy, free = estimator.membrane, estimator.energy, estimator.membrane.free_vertices
    observation, relaxed = observed(membrane), some_relaxed(membrane)
    programme, (origins, directions) = estimator.programme(observation, relaxed)
    t = estimator.rest_range + 0.1 * torch.sin(torch.arange(len(membrane.rest)).double())

    # each quadrilateral's map is the least-squares fit of its corners, eqs. 15-17, in its own rest plane
    x = t[:, None] * directions
    maps = (energy.local_maps(directions) * corners(t[:, None], membrane.grid).mT[..., None, :]).sum(-1)
    p = corners(membrane.rest, membrane.grid)
    axis = torch.nn.functional.normalize(p[..., 2, :] - p[..., 0, :], dim=-1)
    normal = torch.linalg.cross(p[..., 2, :] - p[..., 0, :], p[..., 3, :] - p[..., 1, :])
    across = torch.nn.functional.normalize(torch.linalg.cross(normal, axis), dim=-1)
    plane = p @ torch.stack([axis, across], -1)
    torch.testing.assert_close(maps, affine_fit(plane.expand(2, *plane.shape), corners(x, membrane.grid)).A)

    # eq. 18: |Q t|^2 is twice the energy of those maps, and Q^T Q = K
    Q, S = dense(estimator, programme.q, relaxed)
    twice = energy.tension * (energy.area * (maps**2).sum((-1, -2))).sum((-1, -2))
    torch.testing.assert_close((Q @ t).square().sum(-1), twice)
    torch.testing.assert_close(Q[0], energy.q_matrix(directions[0]))

    # eq. 25: stationary, K psi + s S^T S psi - load = -lambda v; eq. 26: the linear volume is kept
    found = estimator.solve(observation, relaxed)
    psi = torch.zeros_like(found.vertices[..., 0])
    psi[:, free] = ((found.vertices - origins) * directions).sum(-1)[:, free] - estimator.rest_range[free]
    start = origins + estimator.rest_range[:, None] * directions
    gamma = -(Q @ estimator.rest_range[:, None]).squeeze(-1) - offset(estimator, Q, origins)
    smooth = weight * energy.tension * (S.mT @ (S @ psi[..., None])).squeeze(-1)
    left = (Q.mT @ (Q @ psi[..., None]).squeeze(-1)[..., None]).squeeze(-1) - (Q.mT @ gamma[..., None]).squeeze(-1) + smooth
    left = left - (estimator.rest_load * directions).sum(-1)
    v = (membrane.volume_gradient(start) * directions).sum(-1)
    torch.testing.assert_close(left[:, free], found.pressure[:, None] * v[:, free], rtol=1e-8, atol=1e-9)
    torch.testing.assert_close((v * psi).sum(-1), membrane.rest_volume - membrane.volume(start))
    assert (found.vertices[:, membrane.fixed] == membrane.rest[membrane.fixed]).all() and psi.abs().max() > 1e-3


def offset(estimator, Q, origins):
    """What the vertices that stay add to Q t: the maps of the origins, weighted as Q's rows."""
    energy = estimator.energy
    maps = energy.affine_maps(origins) * (energy.tension * energy.area).sqrt()[..., None, None]
    return maps.flatten(1)


def test_the_stencil_is_that_of_the_dense_matrix():
    estimator = make((8, 9))
    observation, relaxed = observed(estimator.membrane), some_relaxed(estimator.membrane)
    programme, _ = estimator.programme(observation, relaxed)
    Q, S = dense(estimator, programme.q, relaxed)
    M = Q.mT @ Q + 0.1 * estimator.energy.tension * S.mT @ S
    free = estimator.membrane.free_vertices
    b = torch.randn(2, 1, len(free), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    solved = estimator.system.substitute(estimator.system.factor(programme.stencil), b)
    torch.testing.assert_close(solved, torch.linalg.solve(M[:, free][:, :, free], b.mT).mT)
    torch.testing.assert_close(programme.stencil[:, 0], inner(M.diagonal(dim1=1, dim2=2)[..., None], (8, 9)).squeeze(-1))


@pytest.mark.parametrize("options", [{}, dict(filling="open"), dict(filling="gas", gas=(0.1, 2500.0))], ids=str)
def test_the_solve_is_that_of_the_dense_kkt_system(options):
    """Eqs. 22, 25-27: with a liquid `v.psi = c`; with a gas the pressure falls as its law says, linear about rest ranges; an
    open cavity keeps its pressure."""
    estimator = make((13, 13), **options)
    cap, observation, weight = estimator.membrane, observed(estimator.membrane), 0.1 * estimator.energy.tension
    relaxed, free, p0 = some_relaxed(cap), cap.free_vertices, estimator.rest_pressure
    found = estimator.solve(observation, relaxed)
    S = laplacian_by_hand(cap.grid)
    for k, d in enumerate(observation.directions * (~cap.fixed)[:, None]):
        start = torch.where(cap.fixed[:, None], cap.rest, estimator.rest_range[:, None] * d)
        Q, kept = estimator.energy.q_matrix(d), (~relaxed[k]).double()[:, None] * S
        v, rise = (cap.volume_gradient(start) * d).sum(-1)[free], cap.volume(start) - cap.rest_volume
        force = ((estimator.rest_load - estimator.energy.gradient(start)) * d).sum(-1)[free]
        kkt = torch.zeros(len(free) + 1, len(free) + 1, dtype=torch.float64)
        kkt[:-1, :-1], kkt[:-1, -1] = (Q.T @ Q + weight * kept.T @ kept)[free][:, free], -v  # unknowns: psi, pressure
        if "gas" in options:
            absolute, gas = options["gas"]
            kkt[-1, :-1], kkt[-1, -1] = absolute * gas / (gas + rise) ** 2 * v, 1.0
            last = p0 + absolute * (gas / (gas + rise) - 1)
        elif options:
            kkt[-1, -1], last = 1.0, p0
        else:
            kkt[-1, :-1], last = v, -rise
        *psi, pressure = torch.linalg.solve(kkt, torch.cat([force, last.reshape(1)]))
        x = start.clone()
        x[free] += torch.stack(psi)[:, None] * d[free]
        torch.testing.assert_close(found.vertices[k], x, rtol=0, atol=1e-9)
        torch.testing.assert_close(found.pressure[k], pressure, rtol=1e-8, atol=1e-10)


def laplacian_by_hand(grid):
    """S of eq. 28, dense: 2 psi less its two neighbours along each of the two lines through a vertex; along the border half."""
    m, n = grid
    S = torch.zeros(m * n, m * n, dtype=torch.float64)
    for i in range(m):
        for j in range(n):
            for p, q, border in ((i + 1, j, j in (0, n - 1)), (i, j + 1, i in (0, m - 1))):
                if p < m and q < n:
                    link = torch.zeros(m * n, dtype=torch.float64)
                    link[i * n + j], link[p * n + q] = 1.0, -1.0
                    S += (0.5 if border else 1.0) * torch.outer(link, link)
    return S


def test_smoother_is_a_sum_of_squares():
    """Pins eq. 28: `|(Q + S) psi|^2` as printed has cross terms; minimised is `1/2 |Q t|^2 + s/2 |S psi|^2` as eq. 24.

    The sum is written out here with a dense S; autograd finds no force along any ray at the surface found, but the fluid's. The
    smoother's own share of it is not small.
    """
    estimator = make((13, 13), smoothing=0.3)
    cap, observation, t_rest = estimator.membrane, observed(estimator.membrane, batch=1), estimator.rest_range
    found, d, free = (
        estimator.solve(observation, torch.zeros(1, 169, dtype=torch.bool)),
        observation.directions[0],
        cap.free_vertices,
    )
    S, s = laplacian_by_hand(cap.grid), 0.3 * estimator.elasticity.tension
    push = found.pressure * cap.volume_gradient(torch.where(cap.fixed[:, None], cap.rest, t_rest[:, None] * d))

    def smoother(t):
        return s / 2 * (S @ torch.where(cap.fixed, 0.0, t - t_rest)).square().sum()

    def total(t):
        x = torch.where(cap.fixed[:, None], cap.rest, t[:, None] * d)
        return estimator.energy.energy(x) + smoother(t) - ((estimator.rest_load + push) * x).sum()

    t = (found.vertices[0] * d).sum(-1)
    force, of_smoother = torch.func.grad(total)(t)[free], torch.func.grad(smoother)(t)[free]
    assert force.abs().max() < 1e-8 < 1e-3 < of_smoother.abs().max()


def test_smoother_sees_the_hourglass_and_no_constant():
    """What the paper's element is blind to costs the most; the dense S is the estimator's."""
    grid = (5, 7)
    S, psi = laplacian_by_hand(grid), torch.randn(2, 35, 1, dtype=torch.float64)
    torch.testing.assert_close(grid_laplacian(psi, grid), S @ psi)
    hourglass = torch.tensor([(-1.0) ** (i + j) for i in range(5) for j in range(7)]).double()[:, None]
    inner = np.s_[1:-1, 1:-1]
    torch.testing.assert_close(grid_laplacian(hourglass, grid).reshape(grid)[inner], 8 * hourglass.reshape(grid)[inner])
    assert grid_laplacian(torch.ones_like(hourglass), grid).abs().max() < 1e-12


def of_quadrilaterals(membrane, directions):
    """The surface of least energy of the paper's element on rays from the origin, the volume kept exactly, by dense steps."""
    quads, free, t = AffineQuadrilaterals(membrane), membrane.free_vertices, membrane.rest.norm(dim=-1)
    _, rest_load = rest_balance(membrane, quads)
    K = quads.q_matrix(directions).T @ quads.q_matrix(directions)
    kkt = torch.zeros(len(free) + 1, len(free) + 1, dtype=torch.float64)
    kkt[:-1, :-1] = K[free][:, free]
    for _ in range(8):
        x = torch.where(membrane.fixed[:, None], membrane.rest, t[:, None] * directions)
        v = (membrane.volume_gradient(x) * directions).sum(-1)[free]
        force = ((rest_load - quads.gradient(x)) * directions).sum(-1)[free]
        kkt[-1, :-1], kkt[:-1, -1] = v, v
        step = torch.linalg.solve(kkt, torch.cat([force, (membrane.rest_volume - membrane.volume(x)).reshape(1)]))[:-1]
        t = t.index_add(0, free, step)
    assert step.abs().max() < 1e-9
    return torch.where(membrane.fixed[:, None], membrane.rest, t[:, None] * directions)


def test_the_element_converges_quadratically_to_the_continuous_minimum():
    """Affine quadrilaterals (eqs. 15-18) without smoother on a disc that its flow turns towards the rim."""
    depth, errors = least_energy(0.3, harmonic, keep_volume=True)[0], []
    for n in (9, 17, 33):
        x, y = disc_grid(n, n)
        disc = Membrane(np.stack([x, y, np.ones_like(x)], -1))
        xy = disc.rest[:, :2]
        s = xy.norm(dim=-1, keepdim=True)
        image = torch.cat([xy * (1 + 0.3 * (1 - s**2)), torch.ones_like(s)], -1)
        got = of_quadrilaterals(disc, torch.nn.functional.normalize(image, dim=-1))[:, 2].numpy()
        errors.append(np.sqrt(np.mean((got - depth(s[:, 0].numpy())) ** 2)))
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (rates > 1.6).all() and errors[-1] < 1e-3, (errors, rates)


def test_zero_flow_gives_exactly_no_displacement_and_no_contact():
    estimator = make((9, 10))
    found = estimator(Observation(*(ray[None] for ray in rest_rays(estimator.membrane)), torch.ones(1, 90)))
    assert (found.vertices - estimator.membrane.rest).abs().max() < 1e-12
    assert (found.pressure - estimator.rest_pressure).abs().max() < 1e-12 and estimator.is_converged(found).all()
    contacts = estimator.contacts(found, estimator.membrane.normals(found.vertices))
    assert (contacts.indicator == 0).all() and contacts.points.isnan().all()


def test_the_energy_over_the_free_part_leaves_out_what_is_covered():
    """Section 2, item 1: quadrilaterals wholly in a contact weigh next to nothing, all others what they did."""
    whole, part = make((9, 9)), make((9, 9), free_part_only=True)
    observation, relaxed = observed(whole.membrane), torch.zeros(2, 81, dtype=torch.bool)
    block = torch.zeros(9, 9, dtype=torch.bool)
    block[3:5, 3:6] = True
    relaxed[1] = block.flatten()
    q, less = (estimator.programme(observation, relaxed)[0].q for estimator in (whole, part))
    ratio = less.square().sum((-1, -2)) / q.square().sum((-1, -2))
    covered = torch.zeros(2, 8, 8, dtype=torch.bool)
    covered[1, 3, 3:5] = True
    torch.testing.assert_close(ratio, torch.where(covered, OCCUPIED, 1.0).double())
    still = Observation(*(ray.expand(2, -1, -1) for ray in rest_rays(part.membrane)), torch.ones(2, 81))
    assert (part.solve(still, relaxed).vertices - part.membrane.rest).abs().max() < 1e-12  # no flow, no displacement
    assert (part.solve(observation, relaxed).vertices - whole.solve(observation, relaxed).vertices)[1].abs().max() > 1e-6


@pytest.mark.parametrize("rounds", [1, 2, 3])
def test_the_loop_goes_round_as_often_as_it_is_told(rounds):
    """Section 5.1: contacts of eq. 29; reconstruct with the smoother relaxed there, segment along the normals; again."""
    estimator = make((13, 13), rounds=rounds)
    observation, segmentation = observed(estimator.membrane, 0.1, batch=1), estimator.segmentation
    regions, surfaces, points = [segmentation.by_polar_angle(observation.directions)], [], []
    for _ in range(4):
        surfaces.append(estimator.solve(observation, regions[-1].region > 0).vertices)
        regions.append(segmentation.by_normals(surfaces[-1]))
        points.append(segmentation.moved(regions[-2].points, regions[-1].points))
    got = estimator(observation)
    torch.testing.assert_close(got.vertices, surfaces[rounds - 1])
    torch.testing.assert_close(got.relative_step, points[rounds - 1])
    gaps = torch.stack([(one - other).abs().max() for one, other in zip(surfaces[1:], surfaces[:-1], strict=True)])
    assert gaps[:rounds].min() > 1e-4


@pytest.mark.parametrize("cavity", [Cavity("liquid"), Cavity("open"), Cavity("gas", pressure=1000.0)], ids=lambda c: c.filling)
@pytest.mark.parametrize(("name", "settings", "kind"), [
    ("paper", PaperSettings(0.7, "smooth", 1), PaperEstimator),
    ("minimum-energy", MinimumEnergySettings(3), MinimumEnergy),
])  # fmt: skip
def test_settings_and_cavity_reach_the_estimator(cavity, name, settings, kind):
    """What `Reconstructor` finds is what the estimator finds that is built here, on rays of the flow built here; each setting
    that is not the default matters."""
    sensor = tm.Sensor.from_file(EXAMPLES / "sensor.toml")
    membrane = sensor.membrane.resampled((11, 11))
    sensor = replace(sensor, membrane=membrane, cavity=cavity)
    made = tm.Reconstructor(sensor, name, settings=settings, dtype=torch.float64)
    got = made.from_pixels(torch.from_numpy(np.load(EXAMPLES / "two_contacts_truth.npz")["uv_deformed"].copy()))
    elasticity, pixels = elastic_energy(sensor, membrane), made.camera.point_to_pixel(membrane.rest)
    markers = membrane.closest_points(sensor.markers.positions)

    def found(settings, filling):
        flow = FLOWS[getattr(settings, "flow", "smooth")](membrane, markers)(got.pixels - made.rest_pixels, got.confidence)
        gas = cavity_filling(sensor, membrane).gas if filling == "gas" else None
        estimator = kind(membrane, elasticity, made.camera.pixel_to_ray(pixels), filling, gas, settings)
        return estimator(Observation(*made.camera.pixel_to_ray(pixels + flow), got.confidence)).vertices

    expected = found(settings, cavity.filling)
    torch.testing.assert_close(got.vertices, expected, rtol=0, atol=1e-9)
    changed = [one for one in fields(settings) if getattr(settings, one.name) != one.default]
    others = [(replace(settings, **{one.name: one.default}), cavity.filling) for one in changed]
    others += [(settings, filling) for filling in ("liquid", "open") if filling != cavity.filling]
    for other in others:
        assert (found(*other) - expected).abs().max() > 1e-6, other


@pytest.fixture(scope="module")
def reconstructor():
    sensor = tm.Sensor.from_file(EXAMPLES / "sensor.toml")
    return tm.Reconstructor(replace(sensor, membrane=sensor.membrane.resampled((17, 17))), "paper")


def test_images_go_through_the_whole_chain(reconstructor):
    """Bilinear flow at the grid (section 5), then the estimator; a press on the axis is found there and nowhere else."""
    names = ("press_on_axis", "two_contacts", "rest")
    with torch.no_grad():
        result = reconstructor(reconstructor.read(*(EXAMPLES / f"{name}.png" for name in names)))
    assert (result.status[[0, 2]] == tm.Status.OK).all() and result.vertices.isfinite().all()
    flow = reconstructor.estimator.flow
    u = (result.pixels - reconstructor.rest_pixels)[1]
    expected = reconstructor.vertex_pixels + flow.interpolation.bilinear @ u
    torch.testing.assert_close(flow(result.pixels[1:2], torch.ones(1, 121))[0], expected, rtol=0, atol=1e-3)
    truth = np.load(EXAMPLES / "press_on_axis_truth.npz")["contact_centroid_each"][0]
    points = result.contact_points[0].numpy()
    assert np.linalg.norm(points[0] - truth) < 2 and np.isnan(points[1:]).all()
    touched = result.vertices[0][result.contact[0] > 0].numpy()
    assert len(touched) > 3 and np.linalg.norm((touched - truth)[:, :2], axis=1).max() < 3
    assert result.contact_points[2].isnan().all() and (result.contact[2] == 0).all() and result.contact[1].sum() > 5
    assert (result.traction == 0).all() and result.displacement[2].abs().max() < 1e-4


def test_wrong_settings_are_refused():
    for wrong, said in ((dict(flow="cubic"), "one of"), (dict(smoothing=0.0), "more than 0"), (dict(rounds=0), "at least 1")):
        with pytest.raises(tm.MembraneError, match=said):
            PaperSettings(**wrong)


@pytest.mark.parametrize("rounds", [1, 2])
def test_gradients_agree_with_finite_differences(rounds):
    estimator = make((7, 7), rounds=rounds)
    observation = observed(estimator.membrane, batch=1)
    direction = torch.randn(observation.directions.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)

    def height(step):
        turned = torch.nn.functional.normalize(observation.directions + step * direction, dim=-1)
        return estimator(observation._replace(directions=turned)).vertices.square().sum()

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(height(step), step)
    h = 1e-6
    torch.testing.assert_close(gradient, (height(torch.tensor(h)) - height(torch.tensor(-h))) / (2 * h), rtol=1e-5, atol=0)
