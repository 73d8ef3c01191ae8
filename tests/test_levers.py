"""Markers that stand off the surface are modelled as levers."""

from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch
from pinned_cap import CAMERA, HEIGHT, SURFACE, cap
from scipy.spatial.transform import Rotation

import torchmembrane as tm
from torchmembrane.estimators.force_balance.lever_residuals import LeverResiduals
from torchmembrane.estimators.force_balance.marker_residuals import MeasuredRays
from torchmembrane.onnx.export import Piece
from torchmembrane.onnx.trace import traced_model
from torchmembrane.pose import ViewPose
from torchmembrane.sensor.parts import Markers
from torchmembrane.sensor.views import View
from torchmembrane.simulate import Dots, Renderer, Simulator, Sphere
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.quasi_static import carried
from torchmembrane.surface.bicubic import bicubic_shares, bicubic_slopes
from torchmembrane.surface.levers import Levers, inward_levers


@pytest.fixture(scope="module")
def membrane():
    return SURFACE.membrane((9, 9))


@pytest.fixture(scope="module")
def points(membrane):
    return membrane.closest_points(cap(0.0).markers.positions)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(cap(HEIGHT), radii=(0.25, 0.3))


@pytest.fixture(scope="module")
def reconstructor(simulator):
    return tm.Reconstructor(simulator.at_rest())


@pytest.fixture(scope="module")
def press(simulator):
    """A press: its image and its truth."""
    stroke = stroke_to(simulator, Sphere(3.0), np.array([1.0, 1.0, 18.0]), np.array([-0.3, 0.0, -0.95]), 1.5)
    (state,) = simulator.presses(stroke, ["push"])
    return simulator.frame(state, stroke, np.random.default_rng(0)), state


def errors(result, sensor, simulator, press):
    """Of surface and force, over what they are."""
    frame, state = press
    u = carried(state.vertices[None], simulator.membrane, sensor.membrane.rest)[0] - sensor.membrane.rest
    off = result.force[0].double() - torch.from_numpy(frame.truth["force"])
    surface = (result.displacement[0] - u).norm() / u.norm()
    return float(surface), float(off.norm() / np.linalg.norm(frame.truth["force"]))


def test_slopes_are_the_derivatives_of_what_is_interpolated():
    """Of a cubic, in the grid's own coordinates, within a triangle and on its corners."""
    x, y = np.meshgrid(np.arange(9.0), np.arange(8.0), indexing="ij")
    plane = tm.Membrane(np.stack([x, y, np.full_like(x, 20.0)], -1))
    at = np.array([[3.2, 4.1, 20.0], [5.0, 3.0, 20.0], [2.7, 2.7, 20.0]])
    points, free = plane.closest_points(at), torch.zeros(72, dtype=torch.bool)
    field = (x**3 - 2 * x * y**2 + y).ravel()
    a, b = at[:, 0], at[:, 1]
    np.testing.assert_allclose(bicubic_slopes(points, (9, 8), free) @ field, [3 * a**2 - 2 * b**2, 1 - 4 * a * b], atol=1e-9)
    np.testing.assert_allclose(bicubic_shares(points, (9, 8), free) @ field, a**3 - 2 * a * b**2 + b, atol=1e-9)
    inside = free.clone()
    inside[3 * 8 + 4] = True  # a fixed vertex inside the border, where fields may have a kink: linear in the triangle
    slopes = bicubic_slopes(points, (9, 8), inside)[:, 0].reshape(2, 9, 8)
    assert set(map(tuple, np.argwhere(slopes[0]))) == {(3, 4), (4, 4)} and abs(slopes.sum()) < 1e-12


def test_the_tip_follows_a_rotation_of_the_surface(membrane, points):
    """`R (x + h n)`, wherever the surface is moved to."""
    heights = np.linspace(0.0, 3.0, len(points.weights))
    levers = torch.from_numpy(inward_levers(membrane, points, heights))
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, -0.7, 0.5]).as_matrix())
    moved = Levers(membrane, points, levers)(membrane.rest @ turn.mT + 3.0 - membrane.rest).levers
    torch.testing.assert_close(moved, levers @ turn.mT, rtol=0, atol=1e-12)
    np.testing.assert_allclose(levers.norm(dim=-1), heights, atol=1e-12)
    to_centre = torch.from_numpy(cap(0.0).markers.positions) - torch.tensor([0.0, 0.0, 8.0])  # of the sphere
    cosine = torch.nn.functional.cosine_similarity(levers[1:], -to_centre[1:], dim=-1)
    assert float(cosine.min()) > 1 - 1e-4


def test_the_normal_changes_as_the_dual_basis_says(membrane, points):
    """`dn = -(n . da) a* - (n . db) b*`, against automatic differentiation."""
    levers = Levers(membrane, points, torch.from_numpy(inward_levers(membrane, points, np.full(49, 2.0))))
    generator = torch.Generator().manual_seed(0)
    u, du = (0.2 * torch.randn(81, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    turned, change = torch.func.jvp(lambda u: levers(u).levers, (u,), (du,))
    _, normal, dual = levers(u)
    slopes = levers.slopes @ du
    expected = -(((slopes * normal).sum(-1, keepdim=True) * dual).sum(0)) * levers.heights[:, None]
    torch.testing.assert_close(change, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(turned, levers.heights[:, None] * normal)


@pytest.fixture(scope="module")
def equations(simulator):
    """Those of a grid of 11 x 11 in double precision, their rays, and a state away from rest."""
    sensor = replace(simulator.at_rest(), membrane=SURFACE.membrane((11, 11)))
    estimator = tm.Reconstructor(sensor, dtype=torch.float64)
    made = estimator.estimator
    measured = made.equations.bearings.measured(
        estimator.observation(torch.zeros(1, 49, 2).double(), torch.ones(1, 49).double())
    )
    place = made.membrane.rest[:, :2] / 8
    u = -0.8 * torch.exp(-4 * place.square().sum(-1))[:, None] * torch.tensor([0.2, 0.1, 1.0]) * made.equations.forces.free
    return made.equations, measured, u.double()[None]


def inner_of(field):
    return field[:, 1:-1, 1:-1].flatten(1, 2)


def test_the_jacobian_is_the_derivative_of_the_angles(equations):
    """Of tips whose vertices are all inside the border, along displacements that are quadratic in the grid's coordinates; but
    that of the places, which is linear in the equations."""
    made, measured, u = equations
    bearings = made.bearings
    assert isinstance(bearings, LeverResiduals)
    still = torch.zeros_like(measured.motion[:, 0, :, 0])
    rows, columns = (a.flatten() / 5 - 1 for a in torch.meshgrid(*[torch.arange(11).double()] * 2, indexing="ij"))
    quadratic = torch.stack([rows * columns, 0.3 * rows**2 - columns, columns**2 + rows], -1)[None]
    _, expected = torch.func.jvp(lambda u: bearings.angles(u, measured, still)[0], (u,), (quadratic,))
    _, jacobian = bearings.angles(u, measured, still)
    fields = bearings.vertex_shares @ inner_of(quadratic.unflatten(1, (11, 11)))
    fields[:, :49] = bearings.smooth_shares @ inner_of(quadratic.unflatten(1, (11, 11)))
    found = bearings.joined((jacobian * fields.mT[:, None]).sum(2))
    inside = (bearings.levers.slopes[:, :, made.forces.membrane.fixed] == 0).all(-1).all(0)
    inside &= (bearings.vertex_shares.unflatten(0, (3, -1)).sum(-1) - torch.tensor([[1.0], [0.0], [0.0]])).abs().amax(0) < 1e-9
    assert inside.sum() >= 20
    torch.testing.assert_close(found[..., inside], expected[..., inside], rtol=1e-9, atol=1e-9)
    frozen = (jacobian[..., :49] * fields.mT[:, None, :, :49]).sum(2)  # of normals that do not turn
    assert (frozen - expected)[..., inside].abs().max() > 0.1 * expected.abs().max()


def test_the_matrix_is_that_of_the_jacobian(equations):
    """`J^T w J` of all tips, dense, by its products, by its blocks at the offsets, and in the system that is solved."""
    made, measured, u = equations
    bearings, count = made.bearings, 81
    still = torch.zeros_like(measured.motion[:, 0, :, 0])
    _, jacobian = bearings.angles(u, measured, still)
    weight = torch.linspace(0.2, 1.0, 49).double()[None]
    weighted = bearings.repeated(weight)[:, None, None] * jacobian
    dense = torch.einsum("acpd,pdn->adcn", jacobian[0].unflatten(-1, (3, 49)), bearings.vertex_shares.unflatten(0, (3, 49)))
    dense = torch.einsum("adcn,d,adem->cnem", dense, weight[0], dense).reshape(3 * count, 3 * count)
    blocks = bearings.blocks(jacobian, weighted)
    one = torch.eye(3 * count).double().unflatten(1, (3, count))[None]
    torch.testing.assert_close(bearings.product(blocks, one)[0].flatten(1), dense, rtol=1e-9, atol=1e-9)
    tau, outlier = torch.tensor([[0.4], [2.5]]).double()
    at, normal, *_ = made.linearised(u, torch.tensor([0.02]).double(), still, measured, tau, outlier)
    loads = torch.rand(1, 2, 3 * count, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    loads = loads * made.forces.inner_free.repeat(3)
    solved = made.system.substitute(made.system.factor(made.matrix(normal)), loads)
    torch.testing.assert_close(made.product(normal, solved), loads, rtol=1e-6, atol=1e-6)


def test_a_press_is_found_by_the_height_and_not_without_it(simulator, reconstructor, press):
    frame, _ = press
    found = reconstructor(frame.image)
    surface, force = errors(found, reconstructor.sensor, simulator, press)
    off = np.linalg.norm(found.markers[0].numpy() - frame.truth["dots_deformed"], axis=-1)
    assert int(found.status[0]) == 0 and surface < 0.12 and force < 0.08 and off.max() < 0.4
    assert torch.isfinite(found.force_deviation).all() and torch.isfinite(found.depth_deviation).all()
    deviations = reconstructor.standard_deviations(found)
    assert torch.isfinite(deviations.vertices).all() and float(deviations.force.max()) < 0.1 * float(found.force.norm())
    without = replace(reconstructor.sensor.markers, positions=None, sizes=None, height=0.0)  # found where their tips are seen
    flat = tm.Reconstructor(replace(reconstructor.sensor, markers=without))
    blind = errors(flat(frame.image), flat.sensor, simulator, press)
    assert blind[0] > 4 * surface and blind[1] > 4 * force


def test_the_surface_has_gradients_in_the_pixels(reconstructor, press):
    """By one difference: what steps of tips are solved by is differentiated too."""
    settings = tm.ForceBalanceSettings(steps=(400, 200, 200), settled_step_tol=1e-10)
    made = tm.Reconstructor(reconstructor.sensor, settings=settings, dtype=torch.float64)
    pixels = torch.from_numpy(press[0].truth["uv_deformed"]).double()
    rest = torch.from_numpy(press[0].truth["uv_nominal"]).double()
    way = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def depth(step):
        return made.from_pixels(pixels + step * way, rest_pixels=rest).displacement[0, 40, 2]

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(depth(step), step)
    with torch.no_grad():
        difference = (depth(1e-5) - depth(-1e-5)) / 2e-5
    assert abs(float(slope - difference)) < 0.01 * abs(float(difference))


def test_no_height_is_the_same_to_the_bit(press):
    """Nothing is built for markers that lie on the surface, whether the height is 0 for all or for each."""
    none, each = cap(0.0), cap(np.zeros(49))
    assert isinstance(each.markers.height, float) and none.fingerprint == each.fingerprint == replace(none).fingerprint
    one, two = tm.Reconstructor(none), tm.Reconstructor(each)
    assert one.levers is None and one.estimator.equations.bearings.in_machine_code
    pixels = torch.from_numpy(press[0].truth["uv_nominal"]) + 0.5
    for a, b in zip(one.from_pixels(pixels), two.from_pixels(pixels), strict=True):
        assert torch.equal(a.nan_to_num(), b.nan_to_num())
    flat = Dots.from_sensor(none)
    images = [
        Renderer(none, pattern=replace(flat, heights=heights), samples=1)(none.membrane.rest)
        for heights in (None, np.zeros(49))
    ]
    assert torch.equal(*images)


def test_levers_of_no_length_are_as_good_as_none(simulator, press):
    """By tensor operations, of a sensor of which one marker has a height, and is lost."""
    dots = np.concatenate([cap(0.0).markers.positions, SURFACE.membrane((9, 9)).rest[13:14].numpy()])
    heights = np.append(np.zeros(49), 1.0)
    with_lever, without = (replace(cap(0.0), markers=Markers("dots", "dark", dots, height=height)) for height in (heights, 0.0))
    one, two = (tm.Reconstructor(sensor) for sensor in (with_lever, without))
    assert isinstance(one.estimator.equations.bearings, LeverResiduals)
    pixels = two.rest_pixels + 3 * torch.exp(-(((two.rest_pixels - 160) / 40) ** 2).sum(-1, keepdim=True))
    sure = torch.from_numpy(np.append(np.ones(49), 0.0))
    found, expected = (made.from_pixels(pixels, sure, rest_pixels=two.rest_pixels) for made in (one, two))
    assert float(expected.displacement.norm(dim=-1).max()) > 0.1
    torch.testing.assert_close(found.vertices, expected.vertices, rtol=0, atol=2e-3)


def test_pins_are_drawn_where_they_are_seen(simulator, reconstructor):
    """In the rest image each is found within a tenth of a pixel."""
    assert bool(reconstructor.observer.seen_at_rest.all()) and reconstructor.observer.rest_offset() < 0.1
    dots = simulator.rest_dots
    torch.testing.assert_close(reconstructor.rest_pixels.double(), dots.pixels, rtol=0, atol=0.02)


def test_pins_that_turn_away_are_not_drawn(simulator):
    """Those on the flank of a pit so steep that the camera sees its outside."""
    x = simulator.membrane.rest.clone()
    x[:, 2] -= 8 * torch.sigmoid((2.26 - x[:, :2].norm(dim=-1)) / 0.25)
    feet = np.linalg.norm(simulator.sensor.markers.positions[:, :2], axis=1)
    flank = np.flatnonzero(abs(feet - 2.26) < 0.1)
    seen = simulator.dots(x).visible.numpy()
    assert len(flank) == 4 and not seen[flank].any() and seen.sum() > 20
    pattern = replace(simulator.pattern, missing=flank.tolist())
    image = Renderer(simulator.sensor, simulator.grid, pattern, samples=2)(x)
    assert torch.equal(image, Renderer(simulator.sensor, simulator.grid, simulator.pattern, samples=2)(x))


def test_dots_found_in_the_rest_image_are_tips(reconstructor):
    """Of a file without a list each tip lies on its ray, its foot at the height under it."""
    markers = replace(reconstructor.sensor.markers, positions=None, sizes=None)
    made = tm.Reconstructor(replace(reconstructor.sensor, markers=markers))
    assert len(made.rest_markers) == 49 and made.observer.rest_offset() < 0.02
    nearest = torch.cdist(made.rest_markers.double(), torch.from_numpy(reconstructor.sensor.markers.positions)).amin(1)
    assert float(nearest.max()) < 0.05
    np.testing.assert_allclose(made.levers.heights.abs(), HEIGHT, atol=0.01)


def test_two_views_see_tips(press):
    """Also from outside a mirror: both views' pixels are those of one tip."""
    beside = ViewPose(np.array([0.0, -25.0, 0.0]), np.array([7.0, 0.0, 0.0]))
    sensor = replace(cap(HEIGHT), views=(View("left", CAMERA), View("right", CAMERA, beside)))
    simulator = Simulator(sensor, radii=(0.25, 0.3))
    dots = simulator.dots(press[1].vertices)
    made = tm.Reconstructor(sensor)
    found = made.from_pixels(dots.pixels, dots.visible.float(), rest_pixels=simulator.rest_dots.pixels)
    off = torch.linalg.vector_norm(found.markers[0] - dots.positions, dim=-1)
    assert int(found.status[0]) in (0, 9) and float(off.max()) < 0.2
    outside = View("out", CAMERA, ViewPose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 40.0])), side="outside")
    seen = replace(sensor, views=(View("in", CAMERA), outside)).in_view(1)
    tips = seen.markers.positions + inward_levers(
        seen.membrane, seen.membrane.closest_points(seen.markers.positions), seen.markers.heights(49)
    )
    expected = outside.pose.inverse.points(simulator.rest_dots.positions.numpy())
    np.testing.assert_allclose(tips, expected, atol=5e-3)


def test_the_equations_of_tips_agree_with_torch_where_they_are_exported(simulator):
    """The tips, the derivatives of their angles in the vertices around them, and the matrix that is solved."""
    made = tm.Reconstructor(replace(simulator.at_rest(), membrane=SURFACE.membrane((9, 9))))
    equations, pixels = made.estimator.equations, made.rest_pixels
    moved = 2 * torch.exp(-(((pixels - 160) / 40) ** 2).sum(-1, keepdim=True)) * torch.tensor([1.0, -0.5, 0.7])[:, None, None]
    measured = equations.bearings.measured(made.observation(moved.expand(3, 49, 2), torch.ones(3, 49)))
    generator = torch.Generator().manual_seed(3)
    u = 0.3 * torch.rand(3, 81, 3, generator=generator) * equations.forces.free
    inputs = {"u": u, "pressure": made.rest_pressure.repeat(3)}
    inputs |= {name: value for name, value in measured._asdict().items() if value is not None}

    def linearised(owner, u, pressure, *rays):
        still = torch.zeros_like(rays[-1][:, 0, :, 0])
        scales = torch.full_like(pressure, 0.4), torch.full_like(pressure, 2.5)
        _, normal, loads, _, motion = owner.linearised(u, pressure, still, MeasuredRays(*rays), *scales)
        return loads, owner.matrix(normal, 1e-3).entries, motion.coupling

    piece, names = Piece(equations, linearised), ["loads", "matrix", "coupling"]
    with torch.no_grad():
        expected = piece(*inputs.values())
    model = traced_model(piece, {name: value[:2] for name, value in inputs.items()}, names)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    for count in (1, 3):
        found = session.run(names, {name: value[:count].numpy() for name, value in inputs.items()})
        for got, value in zip(found, expected, strict=True):
            value = value[:count].numpy()
            np.testing.assert_allclose(got, value, rtol=1e-3, atol=1e-4 * abs(value).max())


@pytest.mark.full
@pytest.mark.parametrize("tracking", [False, True])
def test_the_whole_model_agrees_with_torch(simulator, tmp_path, tracking):
    """Or `export` refuses to write it: from image to result, at rest and pressed."""
    sensor = replace(simulator.at_rest(), membrane=SURFACE.membrane((9, 9)))
    tm.export(tm.Reconstructor(sensor), tmp_path / "pins.onnx", tracking=tracking)
