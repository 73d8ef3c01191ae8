"""Laws of the membrane's energy and of the paper's element."""

import numpy as np
import pytest
import torch

from torchmembrane import MembraneError
from torchmembrane.mechanics.affine_quadrilateral import AffineQuadrilaterals
from torchmembrane.mechanics.cavity import CavityLaw, gas_law_step
from torchmembrane.mechanics.hyperelastic import MODELS, ElasticEnergy
from torchmembrane.mechanics.metric import metric
from torchmembrane.solve.stencil import apply_stencil, inner, one_ring_edges
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import ellipsoid_cap, half_cylinder, spherical_cap
from torchmembrane.surface.topology import corners, corners_to_vertices, triangles_of

ELASTIC = dict(prestretch=1.2, modulus=0.7, c2_ratio=0.15)


@pytest.fixture(scope="module")
def membrane():
    return ellipsoid_cap((12, 9, 12), 2, (7, 8))


def stretched(membrane, scale=1.08, noise=0.02):
    generator = torch.Generator().manual_seed(0)
    return scale * membrane.rest + noise * torch.randn(membrane.rest.shape, generator=generator, dtype=torch.float64)


def dense(energy, membrane, x, directions):
    K = energy.stiffness_along(x, directions)
    one = torch.eye(len(membrane.rest), dtype=torch.float64)
    return corners_to_vertices(K @ corners(one, membrane.grid), membrane.grid)


def elements(membrane):
    return [ElasticEnergy(membrane, model, **ELASTIC) for model in MODELS] + [AffineQuadrilaterals(membrane, 1.3)]


def test_energy_density_is_that_of_the_principal_stretches():
    """A plane membrane stretched by (a, b): closed forms with the 1/2 and the area that eqs. 11, 12, 54 leave out."""
    X = np.stack(np.meshgrid(np.linspace(0, 2, 4), np.linspace(0, 3, 5), [5.0], indexing="ij"), -1)[:, :, 0]
    plane = Membrane(X)
    a, b, l, mu, r = 1.1, 0.95, ELASTIC["prestretch"], ELASTIC["modulus"], ELASTIC["c2_ratio"]  # noqa: E741
    x = plane.rest * torch.tensor([a, b, 1.0], dtype=torch.float64)
    s1, s2, s3 = (l * a) ** 2, (l * b) ** 2, 1 / (l**4 * a**2 * b**2)
    c1, c2 = mu / 2 / (1 + r), mu / 2 * r / (1 + r)
    closed = {
        "harmonic": mu * l**2 / 2 * (a**2 + b**2 - 2),
        "neo_hookean": mu / 2 * (s1 + s2 + s3 - 3),
        "mooney_rivlin": c1 * (s1 + s2 + s3 - 3) + c2 * (s1 * s2 + s1 * s3 + s2 * s3 - 3),
    }
    for model, density in closed.items():
        assert float(ElasticEnergy(plane, model, **ELASTIC).energy(x)) == pytest.approx(6 * density)
    assert float(AffineQuadrilaterals(plane, mu * l**2).energy(x)) == pytest.approx(6 * closed["harmonic"])


def test_principal_stretches_are_the_singular_values_of_the_deformation_gradient(membrane):
    """Eqs. 43-44: of F from the plane of each listed triangle, by QR and SVD; `I = l1^2 + l2^2`, `D = l1^2 l2^2`."""
    x = torch.stack([stretched(membrane), stretched(membrane, 0.8, 0.4)])
    got = ElasticEnergy(membrane, **ELASTIC).principal_stretches(x)
    assert got.shape == (2, len(membrane.triangles), 2)
    a, b, c = membrane.rest.numpy()[membrane.triangles.numpy()].swapaxes(0, 1)
    A, B, C = x.numpy()[:, membrane.triangles.numpy()].transpose(2, 0, 1, 3)
    _, plane = np.linalg.qr(np.stack([b - a, c - a], -1))
    F = np.stack([B - A, C - A], -1) @ np.linalg.inv(plane)
    np.testing.assert_allclose(got.numpy(), np.linalg.svd(F, compute_uv=False), rtol=1e-7)
    squared, order = got**2, lambda invariant: invariant[:, 0].unflatten(-1, (2, -1)).mT.flatten(-2)
    strain = ElasticEnergy(membrane, **ELASTIC).strain(x)
    torch.testing.assert_close(squared.sum(-1), order(strain.I))
    torch.testing.assert_close(squared.prod(-1), order(strain.D))
    stretching = (membrane.area_vectors(membrane.rest).norm(dim=-1).flatten() * (squared.sum(-1) - 2)).sum(-1) / 2
    torch.testing.assert_close(ElasticEnergy(membrane, "harmonic").energy(x), stretching)


def test_principal_stretches_of_a_pure_stretch_and_of_a_turned_surface(membrane):
    """Relative to rest whatever the prestretch: (a, b) of a plane stretched so, 1 at rest, no change by a rotation."""
    X = np.stack(np.meshgrid(np.linspace(0, 2, 4), np.linspace(0, 3, 5), [5.0], indexing="ij"), -1)[:, :, 0]
    plane = Membrane(X)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64)).Q
    for prestretch in (1.0, 1.4):
        elasticity = ElasticEnergy(plane, "neo_hookean", prestretch)
        for a, b in ((0.9, 1.3), (1.3, 0.9), (0.05, 3.0)):
            got = elasticity.principal_stretches(plane.rest * torch.tensor([a, b, 1.0]).double() @ turn + 4.0)
            torch.testing.assert_close(got, torch.tensor([max(a, b), min(a, b)]).double().expand(24, 2), rtol=1e-6, atol=0)
    elasticity, x = ElasticEnergy(membrane), stretched(membrane)
    at_rest = elasticity.principal_stretches(membrane.rest)
    torch.testing.assert_close(at_rest, torch.ones_like(at_rest), rtol=0, atol=1e-7)
    torch.testing.assert_close(elasticity.principal_stretches(x @ turn), elasticity.principal_stretches(x), rtol=1e-8, atol=0)


def test_gradient_is_autograd_of_energy(membrane):
    for energy in elements(membrane):
        x = stretched(membrane).requires_grad_()
        (gradient,) = torch.autograd.grad(energy.energy(x), x)
        torch.testing.assert_close(energy.gradient(x.detach()), gradient)


@pytest.mark.parametrize("model", MODELS)
def test_forces_by_triangles_are_those_by_rings(membrane, model):
    energy, x = ElasticEnergy(membrane, model, **ELASTIC), stretched(membrane)
    x = torch.stack([x, 1.1 * x])
    torch.testing.assert_close(energy.gradient(x), energy.gradient_by_rings(x))


@pytest.mark.parametrize("model", MODELS)
def test_forces_of_a_displaced_surface_are_those_of_where_it_is(membrane, model, monkeypatch):
    """By triangles, by rings as in exported models, and with the stress that the tangent stiffness comes with."""
    energy, x = ElasticEnergy(membrane, model, **ELASTIC), torch.stack([stretched(membrane), stretched(membrane, 1.2)])
    expected = energy.gradient(x)
    torch.testing.assert_close(energy.gradient_of_displaced(x - membrane.rest), expected)
    stress, _ = energy.one_ring(x - membrane.rest)
    edges = apply_stencil(x, one_ring_edges(), membrane.grid, border=False).chunk(2, -1)[0].unflatten(-1, (6, -1))
    torch.testing.assert_close((stress[:, None] * edges).sum(2).mT, inner(expected, membrane.grid))
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    torch.testing.assert_close(energy.gradient_of_displaced(x - membrane.rest), expected)


@pytest.mark.parametrize("by_rings", [False, True])
def test_single_precision_knows_the_tension_of_a_slack_sheet_far_away(by_rings, monkeypatch):
    """A half per cent of prestretch, 200 from the origin: positions would be rounded by as much as they are strained."""
    dome = spherical_cap(12, 9, 200, (33, 33))
    energy, u = ElasticEnergy(dome, prestretch=1.005), 0.01 * stretched(dome, 0.0, 1e-3)
    exact = energy.gradient(dome.rest + u)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: by_rings)
    single = energy.float()

    def error(found):
        return float((inner(found.double() - exact, dome.grid)).norm() / inner(exact, dome.grid).norm())

    assert error(single.gradient_of_displaced(u.float())) < 1e-3
    assert error(single.gradient((dome.rest + u).float())) > 0.01


def test_stiffness_is_the_hessian_along_the_directions_in_tension(membrane):
    x = stretched(membrane)
    d = torch.nn.functional.normalize(x + 0.3, dim=-1)
    for energy in elements(membrane):
        if getattr(energy, "model", "") == "mooney_rivlin":
            continue
        start = torch.zeros(len(x), dtype=torch.float64)
        hessian = torch.autograd.functional.hessian(lambda t, e=energy: e.energy(x + t[:, None] * d), start)
        torch.testing.assert_close(dense(energy, membrane, x, d), hessian, rtol=1e-9, atol=1e-9)


def test_mooney_rivlin_stiffness_leaves_out_only_the_term_that_is_not_convex(membrane):
    x = stretched(membrane)
    d = torch.nn.functional.normalize(x, dim=-1)
    elasticity = ElasticEnergy(membrane, "mooney_rivlin", **ELASTIC)

    at, twice_12 = elasticity.strain(x), torch.tensor([1.0, 2.0, 1.0], dtype=x.dtype)[:, None]

    def with_linear_D(t):
        """`C2 l^4 D` replaced by its tangent in the metric at `x`."""
        moved = elasticity.strain(x + t[:, None] * d)
        tangent = (at.adjugate * twice_12 * (metric(moved.edges) - metric(at.edges))).sum(-2, keepdim=True)
        bend = moved.D - at.D - tangent / elasticity.det
        return elasticity.energy(x + t[:, None] * d) - elasticity.c2 * elasticity.prestretch**4 * (elasticity.area * bend).sum()

    start = torch.zeros(len(x), dtype=torch.float64)
    hessian = torch.autograd.functional.hessian(with_linear_D, start)
    torch.testing.assert_close(dense(elasticity, membrane, x, d), hessian, rtol=1e-9, atol=1e-9)


def assembled(blocks, membrane):
    """The dense `[3V, 3V]` matrix of triangle blocks `[m-1, n-1, 2, 9, 9]`."""
    V = len(membrane.rest)
    triangles = triangles_of(corners(torch.arange(V)[:, None], membrane.grid)).reshape(-1, 3)
    dofs = (3 * triangles[:, :, None] + torch.arange(3)).reshape(-1, 9)
    full = torch.zeros(3 * V, 3 * V, dtype=torch.float64)
    index = (dofs[:, :, None].expand(-1, 9, 9), dofs[:, None, :].expand(-1, 9, 9))
    return full.index_put(index, blocks.reshape(-1, 9, 9), accumulate=True)


@pytest.mark.parametrize("model", MODELS)
def test_hessian_blocks_are_autograd_of_the_gradient(membrane, model):
    elasticity = ElasticEnergy(membrane, model, **ELASTIC)
    for x in (stretched(membrane), stretched(membrane, 0.8, 0.4)):
        jacobian = torch.autograd.functional.jacobian(elasticity.gradient, x).flatten(2).flatten(0, 1)
        torch.testing.assert_close(assembled(elasticity.hessian_blocks(x), membrane), jacobian, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_positive_hessian_blocks_are_positive_and_exact_in_tension(membrane, model):
    elasticity = ElasticEnergy(membrane, model, **ELASTIC)
    eigenvalues = torch.linalg.eigvalsh(elasticity.hessian_blocks(stretched(membrane, 0.8, 0.4), positive=True))
    assert (eigenvalues[..., 0] / eigenvalues[..., -1]).min() > -1e-14
    if model != "harmonic":
        assert torch.linalg.eigvalsh(elasticity.hessian_blocks(stretched(membrane, 0.8, 0.4))).min() < -0.1
    if model != "mooney_rivlin":
        x = stretched(membrane)
        torch.testing.assert_close(elasticity.hessian_blocks(x, positive=True), elasticity.hessian_blocks(x))


def test_positive_hessian_blocks_are_the_stiffness_along_directions(membrane):
    x, d = stretched(membrane), torch.nn.functional.normalize(stretched(membrane), dim=-1)
    along = torch.zeros(len(x), 3, len(x), dtype=torch.float64)
    along[torch.arange(len(x)), :, torch.arange(len(x))] = d
    along = along.flatten(0, 1)
    for model in MODELS:
        elasticity = ElasticEnergy(membrane, model, **ELASTIC)
        H = assembled(elasticity.hessian_blocks(x, positive=True), membrane)
        torch.testing.assert_close(along.T @ H @ along, dense(elasticity, membrane, x, d), rtol=1e-9, atol=1e-9)


def test_stiffness_is_symmetric_and_positive_even_in_compression(membrane):
    x = stretched(membrane, scale=0.8, noise=0.4)
    d = torch.nn.functional.normalize(x, dim=-1)
    for energy in elements(membrane):
        K = dense(energy, membrane, x, d)
        torch.testing.assert_close(K, K.T)
        free = membrane.free_vertices
        assert torch.linalg.eigvalsh(K[free][:, free])[0] > 0


def test_harmonic_stiffness_is_the_hadamard_product(membrane):
    """`K = L o (R R^T)` for any rays, and independent of the deformed surface."""
    d = torch.nn.functional.normalize(stretched(membrane), dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(d)
    for energy in (ElasticEnergy(membrane, "harmonic", 1.2), AffineQuadrilaterals(membrane, 1.44)):
        L = dense(energy, membrane, membrane.rest, up)
        torch.testing.assert_close(dense(energy, membrane, stretched(membrane), d), L * (d @ d.T))


def test_k_equals_q_transpose_q(membrane):
    """Eqs. 14, 18, 64: `E(t) = 1/2 ||Q t||^2`, with the 1/2 of eq. 24, less the rest's energy."""
    quads = AffineQuadrilaterals(membrane, 1.3)
    d = torch.nn.functional.normalize(stretched(membrane), dim=-1)
    Q, t = quads.q_matrix(d), stretched(membrane).norm(dim=-1)
    torch.testing.assert_close(Q.T @ Q, dense(quads, membrane, membrane.rest, d))
    constant = quads.tension * quads.area.sum()
    torch.testing.assert_close(quads.energy(t[:, None] * d), (Q @ t).square().sum() / 2 - constant)


def test_affine_element_is_blind_to_the_hourglass_and_triangles_are_not():
    X = np.stack(np.meshgrid(np.linspace(0, 2, 6), np.linspace(0, 3, 6), [5.0], indexing="ij"), -1)[:, :, 0]
    plane = Membrane(X)
    checkerboard = torch.tensor([(-1.0) ** (i + j) for i in range(6) for j in range(6)], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(36, 3)
    energy = lambda e: checkerboard @ dense(e, plane, plane.rest, up) @ checkerboard  # noqa: E731
    assert abs(energy(AffineQuadrilaterals(plane))) < 1e-12
    assert energy(ElasticEnergy(plane, "harmonic")) > 10


def test_rest_metric_of_a_planar_quadrilateral_is_singular_in_space():
    """Pins eq. 53: G of eq. 16 with three coordinates is singular for a planar quadrilateral; k runs over the plane's two."""
    plane = torch.tensor([[0, 0, 1.0], [1, 0, 2], [1, 1, 2], [0, 1, 1]], dtype=torch.float64)
    centred = plane - plane.mean(0)
    assert torch.linalg.det(centred.T @ centred).abs() < 1e-12
    rectangles = half_cylinder(10, 40, 80, 3, (7, 8))
    maps = AffineQuadrilaterals(rectangles).affine_maps(rectangles.rest)
    gram = maps.mT @ maps
    torch.testing.assert_close(gram, torch.eye(2, dtype=torch.float64).expand_as(gram))


def test_energy_ignores_rotation_and_translation(membrane):
    angle = torch.tensor(0.7, dtype=torch.float64)
    c, s = angle.cos(), angle.sin()
    R = torch.stack([torch.stack([c, -s, c * 0]), torch.stack([s, c, c * 0]), torch.tensor([0, 0, 1.0]).double()])
    x = stretched(membrane)
    for energy in elements(membrane):
        torch.testing.assert_close(energy.energy(x @ R.T + 3.0), energy.energy(x))
        torch.testing.assert_close(energy.gradient(x @ R.T + 3.0), energy.gradient(x) @ R.T)


@pytest.mark.parametrize("model", MODELS)
def test_rest_tension_is_the_derivative_of_the_energy_by_area(model):
    cap = spherical_cap(12, 9, 15, (9, 9))
    elasticity, step = ElasticEnergy(cap, model, **ELASTIC), 1e-6
    slope = (elasticity.energy((1 + step) * cap.rest) - elasticity.energy((1 - step) * cap.rest)) / (2 * step)
    torch.testing.assert_close(slope, 2 * elasticity.tension * cap.rest_area.sum(), rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("make", "curvature"),
    [(lambda n: spherical_cap(12, 9, 15, (n, n)), 2 / 12.5), (lambda n: half_cylinder(10, 40, 80, 3, (n, n)), 1 / 10)],
)
def test_rest_pressure_is_tension_times_curvature(make, curvature):
    """Laplace's law: p = 2 T / R on a sphere, T / R on a cylinder."""
    errors = []
    for n in (17, 33):
        membrane = make(n)
        elasticity = ElasticEnergy(membrane, "neo_hookean", 1.3)
        free, normal = membrane.free_vertices, membrane.rest_normals
        force, push = elasticity.gradient(membrane.rest), membrane.volume_gradient(membrane.rest)
        p0 = (force * normal)[free].sum() / (push * normal)[free].sum()
        errors.append(abs(float(p0 / (elasticity.tension * curvature)) - 1))
    assert errors[1] < 0.01 and errors[1] < 0.6 * errors[0] + 1e-9


@pytest.mark.parametrize("rise", [-20.0, 0.0, 35.0])
def test_a_step_of_a_gas_has_the_slope_of_its_law_and_ends_on_it(rise):
    p0, absolute, volume, pressure = 0.7, 4.0, 100.0, 0.2

    def law(rise):
        return p0 + absolute * (volume / (volume + rise) - 1)

    target, compliance = gas_law_step(rise, pressure, p0, absolute, volume)
    slope = (law(rise + 1e-4) - law(rise - 1e-4)) / 2e-4
    assert compliance == pytest.approx(-1 / slope, rel=1e-6)
    assert pressure + target / compliance == pytest.approx(law(rise), rel=1e-12)


def test_an_unknown_model_is_refused(membrane):
    with pytest.raises(MembraneError, match="expected one of"):
        ElasticEnergy(membrane, "hookean")


@pytest.mark.parametrize("filling, gas, error", [("liquid", None, 0.0), ("gas", (0.1, 2600.0), 2e-4)])
def test_a_step_of_the_cavity_s_condition_ends_on_its_law(filling, gas, error):
    """From a volume 1 % of the gas's off the law, with a step of the pressure: but for the square of that step."""
    law = CavityLaw(spherical_cap(12, 9, 3, (9, 9)), torch.tensor(0.02, dtype=torch.float64), filling, gas)
    pressure, step = torch.tensor([0.018, 0.023], dtype=torch.float64), 1e-4
    rise = law.target_volume(law.rest_volume, pressure) + 26.0 - law.rest_volume
    target, compliance = law.condition(rise, pressure)
    volume = law.rest_volume + rise + target - compliance * step
    expected = law.target_volume(volume, pressure + step)
    torch.testing.assert_close(volume, expected, rtol=0, atol=2600 * error + 1e-9)


@pytest.mark.parametrize("filling, gas", [("liquid", None), ("gas", (0.1, 2600.0)), ("open", None)])
def test_a_volume_is_off_by_a_share_of_the_volume_at_rest(filling, gas):
    """Of what its law requires at the pressure; an open cavity's may be any."""
    law = CavityLaw(spherical_cap(12, 9, 3, (9, 9)), torch.tensor(0.02, dtype=torch.float64), filling, gas)
    pressure, off = torch.tensor([0.02, 0.05, 0.05], dtype=torch.float64), torch.tensor([-0.2, 0.0, 0.3], dtype=torch.float64)
    volume = law.target_volume(law.rest_volume, pressure) + off * law.rest_volume
    torch.testing.assert_close(law.volume_error(volume, pressure), 0 * off if filling == "open" else off)
