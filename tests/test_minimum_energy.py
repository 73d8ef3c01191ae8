"""Laws of minimum energy, and its accuracy against a twin."""

import numpy as np
import pytest
import torch
from axisymmetric import harmonic, least_energy, neo_hookean

from torchmembrane import MembraneError
from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergy, MinimumEnergySettings
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import disc_grid, ellipsoid_cap, spherical_cap


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
    push = got.pressure * finger.volume_gradient(x)
    force = ((estimator.energy.gradient(x) - estimator.rest_load - push) * d).sum(-1)
    assert force[free].abs().max() < 1e-7


def test_a_liquid_keeps_its_volume(finger):
    found = make(finger, "harmonic")(seen(*bent_rays(finger)))
    assert abs(float(found.volume / finger.rest_volume) - 1) < 1e-9


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


@pytest.mark.parametrize("wrong", [dict(filling="steam"), dict(filling="gas"), dict(steps=0)])
def test_wrong_options_are_refused(finger, wrong):
    with pytest.raises(MembraneError, match="expected one of|pass both|expected at least 1"):
        make(finger, **wrong)


def test_steps_after_convergence_change_nothing_in_float32():
    """What changes once it is there is rounding, which must not be taken for slopes."""
    membrane = ellipsoid_cap((12, 9, 12), 2, (13, 13))
    origins, directions = (ray.float() for ray in bent_rays(membrane, 1e-4, (64,)))
    estimator = make(membrane).float()
    for estimator.steps in (10, 20, 30):
        assert estimator(seen(origins, directions)).relative_step.max() < 3e-7
