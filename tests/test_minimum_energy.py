"""Laws of the paper's estimator; accuracy against an independent twin (`axisymmetric.py`)."""

import numpy as np
import pytest
import torch
from axisymmetric import harmonic, least_energy, neo_hookean

from torchmembrane import MembraneError
from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergy, MinimumEnergySettings, grid_laplacian
from torchmembrane.mechanics.affine_quadrilateral import AffineQuadrilaterals
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import disc_grid, ellipsoid_cap, spherical_cap
from torchmembrane.surface.topology import corners, corners_to_vertices


def rest_rays(membrane):
    return torch.zeros_like(membrane.rest), torch.nn.functional.normalize(membrane.rest, dim=-1)


def make(membrane, model="neo_hookean", prestretch=1.2, modulus=1.0, filling="liquid", gas=None, **settings):
    elasticity = ElasticEnergy(membrane, model, prestretch, modulus, 0.1)
    return MinimumEnergy(membrane, elasticity, rest_rays(membrane), filling, gas, MinimumEnergySettings(**settings))


def seen(origins, directions):
    return Observation(origins, directions, torch.ones_like(directions[..., 0]))


def bent_rays(membrane, size=0.03, batch=()):
    """Rays turned smoothly, not at the rim."""
    moves = (~membrane.fixed).double()[:, None]
    x = membrane.rest / membrane.size
    generator = torch.Generator().manual_seed(1)
    phase = torch.rand(*batch, 1, 3, generator=generator, dtype=torch.float64)
    turn = torch.sin(5 * x[..., [1, 2, 0]] + 6 * phase)
    origins, directions = rest_rays(membrane)
    directions = torch.nn.functional.normalize(directions + size * moves * turn, dim=-1)
    return origins.expand(directions.shape), directions


@pytest.fixture(scope="module")
def finger():
    return ellipsoid_cap((12, 9, 12), 2, (13, 13))


VARIANTS = [
    dict(model="harmonic"),
    dict(model="harmonic", volume="linear", steps=60),
    dict(model="harmonic", element="quadrilateral", smoothing=0.1),
    dict(model="neo_hookean"),
    dict(model="mooney_rivlin", filling="open"),
    dict(model="neo_hookean", filling="gas", gas=(0.1, 2500.0)),
]


@pytest.mark.parametrize("options", VARIANTS)
def test_zero_flow_gives_exactly_no_displacement(finger, options):
    """Section 3.2, although the ellipsoid's rest shape is no equilibrium of uniform tension: the rest load sees to it."""
    estimator = make(finger, **options)
    result = estimator(seen(*rest_rays(finger)))
    assert (result.vertices - finger.rest).abs().max() < 1e-12
    assert (result.pressure - estimator.rest_pressure).abs() < 1e-12


@pytest.mark.parametrize("options", VARIANTS)
def test_the_surface_is_a_stationary_point_on_its_rays(finger, options):
    """No force is left along any ray but the fluid's and the rest load (eq. 25)."""
    estimator = make(finger, **{"steps": 20, **options})
    origins, d = bent_rays(finger)
    got = estimator(seen(origins, d))
    x, free = got.vertices, finger.free_vertices
    linear = options.get("volume") == "linear"
    start = torch.where(finger.fixed[:, None], finger.rest, estimator.rest_range[:, None] * d)
    push = finger.volume_gradient(start if linear else x)
    force = ((estimator.energy.gradient(x) - estimator.rest_load - got.pressure * push) * d).sum(-1)
    psi = torch.where(finger.fixed, 0.0, (x * d).sum(-1) - estimator.rest_range)[:, None]
    force = force + estimator.smoothing * estimator._smoother(estimator._smoother(psi))[:, 0]
    assert force[free].abs().max() < 1e-7


def test_exact_volume_is_kept_and_the_linear_one_is_not(finger):
    observation = seen(*bent_rays(finger))

    def error(**options):
        return abs(float(make(finger, "harmonic", **options)(observation).volume / finger.rest_volume) - 1)

    assert error() < 1e-9
    assert error(volume="linear") > 1e-6


def test_gas_keeps_pressure_times_volume(finger):
    absolute, gas = 0.1, 2500.0
    estimator = make(finger, filling="gas", gas=(absolute, gas))
    got = estimator(seen(*bent_rays(finger)))
    rise = got.volume - finger.rest_volume
    p = absolute + got.pressure - estimator.rest_pressure
    assert abs(float(rise)) > 1e-3
    torch.testing.assert_close(p * (gas + rise), torch.tensor(absolute * gas, dtype=torch.float64))
    torch.testing.assert_close(estimator.cavity.target_volume(got.volume, got.pressure), got.volume)


def test_a_stiff_gas_is_a_liquid_and_a_soft_one_is_open(finger):
    observation = seen(*bent_rays(finger))
    liquid, opened = make(finger)(observation).vertices, make(finger, filling="open")(observation).vertices
    stiff = make(finger, filling="gas", gas=(1e6, 2500.0))(observation).vertices
    soft = make(finger, filling="gas", gas=(1e-7, 2500.0))(observation).vertices
    assert (liquid - opened).abs().max() > 1e-3
    torch.testing.assert_close(stiff, liquid, rtol=0, atol=1e-5)
    torch.testing.assert_close(soft, opened, rtol=0, atol=1e-4)


def test_linear_volume_solves_equation_22(finger):
    """psi from the dense KKT system with `Q^T Q`, `gamma`, `v`, `c` of the paper's element, to rounding."""
    smoothing = 0.1
    estimator = make(finger, "harmonic", element="quadrilateral", smoothing=smoothing, volume="linear", steps=120)
    origins, d = bent_rays(finger)
    quads = AffineQuadrilaterals(finger, estimator.energy.tension)
    free, rest_range = finger.free_vertices, estimator.rest_range
    Q = quads.q_matrix(d)
    start = torch.where(finger.fixed[:, None], finger.rest, rest_range[:, None] * d)
    v = (finger.volume_gradient(start) * d).sum(-1)[free]
    rest_load = ((estimator.rest_load + estimator.rest_pressure * finger.volume_gradient(start)) * d).sum(-1)
    load = (rest_load - Q.T @ (Q @ rest_range))[free]
    one = torch.eye(len(rest_range), dtype=torch.float64)
    S = corners_to_vertices(
        torch.tensor([[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 2, -1], [-1, 0, -1, 2]]).double()
        @ corners(one, finger.grid) / 2, finger.grid)  # fmt: skip
    K = (Q.T @ Q + estimator.smoothing * S.T @ S)[free][:, free]
    c = finger.rest_volume - finger.volume(start)
    kkt = torch.zeros(len(free) + 1, len(free) + 1, dtype=torch.float64)
    kkt[:-1, :-1], kkt[:-1, -1], kkt[-1, :-1] = K, v, v
    want = torch.linalg.solve(kkt, torch.cat([load, c[None]]))
    got = estimator(seen(origins, d))
    psi = (got.vertices * d).sum(-1) - rest_range
    torch.testing.assert_close(psi[free], want[:-1], rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(got.pressure, estimator.rest_pressure - want[-1], rtol=1e-7, atol=1e-9)


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


@pytest.mark.parametrize("element", ["quadrilateral", "triangle"])
def test_smoother_is_a_sum_of_squares(finger, element):
    """Pins eq. 28: `|(Q + S) psi|^2` as printed has cross terms; minimised is `1/2 |Q t|^2 + s/2 |S psi|^2` as eq. 24.

    The sum is written out here with a dense S, `s` from shear modulus, prestretch and weight; autograd finds no force along any
    ray at the surface found, but the fluid's. The smoother's own share of it is not small.
    """
    weight, prestretch, modulus = 0.1, 1.2, 0.7
    options = dict(prestretch=prestretch, modulus=modulus, element=element, smoothing=weight, steps=20)
    estimator = make(finger, "harmonic", **options)
    origins, d = bent_rays(finger)
    got, free = estimator(seen(origins, d)), finger.free_vertices
    S, s = laplacian_by_hand(finger.grid), weight * modulus * prestretch**2
    t_rest = finger.rest.norm(dim=-1)

    def smoother(t):
        return s / 2 * (S @ torch.where(finger.fixed, 0.0, t - t_rest)).square().sum()

    def total(t):
        x = torch.where(finger.fixed[:, None], finger.rest, t[:, None] * d)
        load = (estimator.rest_load * x).sum() + got.pressure * finger.volume(x)
        return estimator.energy.energy(x) + smoother(t) - load

    t = (got.vertices * d).sum(-1)
    force, of_smoother = torch.func.grad(total)(t)[free], torch.func.grad(smoother)(t)[free]
    assert force.abs().max() < 1e-8 < 1e-3 < of_smoother.abs().max()
    torch.testing.assert_close(estimator._smoothing_force(t, None)[free], of_smoother)


def test_smoother_sees_the_hourglass_and_no_constant():
    """What the paper's element is blind to costs the most; the dense S is the estimator's."""
    grid = (5, 7)
    S, psi = laplacian_by_hand(grid), torch.randn(2, 35, 1, dtype=torch.float64)
    torch.testing.assert_close(grid_laplacian(psi, grid), S @ psi)
    hourglass = torch.tensor([(-1.0) ** (i + j) for i in range(5) for j in range(7)]).double()[:, None]
    inner = np.s_[1:-1, 1:-1]
    torch.testing.assert_close(grid_laplacian(hourglass, grid).reshape(grid)[inner], 8 * hourglass.reshape(grid)[inner])
    assert grid_laplacian(torch.ones_like(hourglass), grid).abs().max() < 1e-12


@pytest.mark.parametrize("options", VARIANTS)
def test_the_rim_stays_exactly_where_it_is(options):
    """Appendix B: whatever is observed at it, and with a part of the inside fixed too."""
    fixed = np.zeros((13, 13), bool)
    fixed[[0, -1]] = fixed[:, [0, -1]] = fixed[5:7, 3:9] = True
    held = Membrane(ellipsoid_cap((12, 9, 12), 2, (13, 13)).rest.reshape(13, 13, 3).numpy(), fixed)
    origins, d = rest_rays(held)
    d = torch.nn.functional.normalize(d + 0.05 * torch.sin(held.rest[:, [1, 2, 0]]), dim=-1)
    x = make(held, **options)(seen(origins, d)).vertices
    assert torch.equal(x[held.fixed], held.rest[held.fixed])
    assert (x - held.rest)[~held.fixed].norm(dim=-1).median() > 0.1


def disc(n):
    x, y = disc_grid(n, n)
    return Membrane(np.stack([x, y, np.ones_like(x)], -1))


def observed(membrane, amplitude):
    """Rays of the round test's flow, and the material radius of every vertex."""
    xy = membrane.rest[:, :2]
    s = xy.norm(dim=-1, keepdim=True)
    image = xy * (1 + amplitude * (1 - s**2))
    directions = torch.nn.functional.normalize(torch.cat([image, torch.ones_like(s)], -1), dim=-1)
    return (torch.zeros_like(directions), directions), s[:, 0].numpy()


@pytest.mark.parametrize(
    ("options", "twin"),
    [
        (dict(model="harmonic", prestretch=1.0), lambda a: least_energy(a, harmonic, keep_volume=True)[0]),
        (
            dict(model="harmonic", prestretch=1.0, element="quadrilateral", smoothing=0.0),
            lambda a: least_energy(a, harmonic, keep_volume=True)[0],
        ),
        (
            dict(model="neo_hookean", prestretch=1.2, filling="open"),
            lambda a: least_energy(a, neo_hookean(1.2), keep_volume=False)[0],
        ),
    ],
)
def test_depth_converges_quadratically_to_the_continuous_minimum(options, twin):
    amplitude, errors = 0.3, []
    depth = twin(amplitude)
    assert np.ptp(depth(np.linspace(0, 1, 50))) > 0.01
    for n in (9, 17, 33):
        membrane = disc(n)
        rays, s = observed(membrane, amplitude)
        got = make(membrane, **options)(seen(*rays)).vertices[:, 2].numpy()
        errors.append(np.sqrt(np.mean((got - depth(s)) ** 2)))
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (rates > 1.6).all() and errors[-1] < 1e-3, (errors, rates)


def test_pressure_converges_to_the_continuous_multiplier():
    _, pressure = least_energy(0.3, harmonic, keep_volume=True)
    errors = []
    for n in (9, 17, 33):
        membrane = disc(n)
        rays, _ = observed(membrane, 0.3)
        errors.append(abs(float(make(membrane, "harmonic", prestretch=1.0)(seen(*rays)).pressure) - pressure))
    assert errors[2] < 0.02 * abs(pressure) and errors[2] < 0.4 * errors[1] < 0.16 * errors[0] + 1e-12, (errors, pressure)


def test_batch_equals_singles(finger):
    estimator, rays = make(finger), bent_rays(finger, batch=(3,))
    together = estimator(seen(*rays))
    for k in range(3):
        alone = estimator(seen(rays[0][k], rays[1][k]))
        for a, b in zip(alone, together, strict=True):
            torch.testing.assert_close(a, b[k])


def test_scaling_lengths_scales_the_answer(finger):
    """Lengths times 2.5 at the same modulus: the same shape, pressure divided by 2.5."""
    big = Membrane(2.5 * finger.rest.reshape(13, 13, 3).numpy())
    small, large = (make(membrane)(seen(*bent_rays(finger))) for membrane in (finger, big))
    torch.testing.assert_close(large.vertices, 2.5 * small.vertices)
    torch.testing.assert_close(large.pressure, small.pressure / 2.5)


def test_rotating_camera_and_membrane_rotates_the_answer(finger):
    c, s = np.cos(0.4), np.sin(0.4)
    R = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1.0]], dtype=torch.float64)
    turned = Membrane((finger.rest @ R.T).reshape(13, 13, 3).numpy())
    origins, d = bent_rays(finger)
    torch.testing.assert_close(make(turned)(seen(origins, d @ R.T)).vertices, make(finger)(seen(origins, d)).vertices @ R.T)


def test_ray_origins_off_the_centre_give_the_same_surface(finger):
    """Behind ports rays have origins: sliding an origin along its own ray changes nothing (gain `-d.(L o)` of the load)."""
    origins, d = bent_rays(finger)
    shift = 1.5 * d[:, 2:] * d
    elasticity = ElasticEnergy(finger, "harmonic", 1.2)
    rest_o, rest_d = rest_rays(finger)
    moved_rays = rest_o + 1.5 * rest_d[:, 2:] * rest_d, rest_d
    moved = MinimumEnergy(finger, elasticity, moved_rays, settings=MinimumEnergySettings(steps=20))
    expected = make(finger, "harmonic", steps=20)(seen(origins, d)).vertices
    torch.testing.assert_close(moved(seen(origins + shift, d)).vertices, expected)


def test_float32_agrees_with_float64(finger):
    rays = bent_rays(finger)
    double = make(finger)(seen(*rays))
    single = make(Membrane(finger.rest.reshape(13, 13, 3).numpy())).float()(seen(*(r.float() for r in rays)))
    assert (single.vertices - double.vertices).abs().max() < 2e-4
    assert abs(float(single.pressure - double.pressure)) < 1e-4


def test_gradients_agree_with_finite_differences():
    cap = spherical_cap(12, 9, 15, (7, 7))
    estimator = make(cap, steps=6)
    origins, d = bent_rays(cap)
    direction = torch.randn(d.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)

    def height(step):
        turned = torch.nn.functional.normalize(d + step * direction * (~cap.fixed)[:, None], dim=-1)
        return estimator(seen(origins, turned)).vertices.square().sum()

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(height(step), step)
    h = 1e-5
    torch.testing.assert_close(gradient, (height(torch.tensor(h)) - height(torch.tensor(-h))) / (2 * h), rtol=1e-5, atol=0)


@pytest.mark.parametrize("wrong", [dict(element="hexagon"), dict(filling="steam"), dict(volume="guessed"), dict(filling="gas")])
def test_wrong_options_are_refused(finger, wrong):
    with pytest.raises(MembraneError, match="expected one of|pass both"):
        make(finger, **wrong)


def test_steps_after_convergence_change_nothing_in_float32():
    """What changes once it is there is rounding, which must not be taken for slopes."""
    membrane = ellipsoid_cap((12, 9, 12), 2, (13, 13))
    origins, directions = (ray.float() for ray in bent_rays(membrane, 1e-4, (64,)))
    estimator = make(membrane).float()
    for estimator.steps in (10, 20, 30):
        assert estimator(seen(origins, directions)).relative_step.max() < 3e-7


@pytest.mark.parametrize(
    "options", [dict(model="harmonic"), dict(element="quadrilateral"), dict(model="harmonic", filling="open")]
)
def test_a_linear_problem_is_solved_in_four_steps(options):
    """By the end of them what is left is less than single precision resolves; two are not enough."""
    membrane = ellipsoid_cap((12, 9, 12), 2, (13, 13))
    observation = seen(*bent_rays(membrane, 0.06, (4,)))
    estimator = make(membrane, volume="linear", **options)
    assert estimator.steps == MinimumEnergySettings().linear_steps == 4
    found = estimator(observation)
    assert found.relative_step.max() < 1e-7
    estimator.steps = 2
    assert estimator(observation).relative_step.max() > 10 * found.relative_step.max()
    assert make(membrane, volume="exact", **options).steps == MinimumEnergySettings().steps
