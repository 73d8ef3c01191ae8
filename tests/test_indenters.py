"""Signed distances have unit gradients and project to the surface."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from torchmembrane import MembraneError, simulate
from torchmembrane.simulate.indenters import Box, Cylinder, Plane, Sphere, Union, Wedge, facing
from torchmembrane.simulate.mesh_indenter import MeshIndenter
from torchmembrane.surface.shapes import spherical_cap

ICOSAHEDRON = trimesh.creation.icosahedron()
EVERY = {
    "sphere": Sphere(2.0),
    "plane": Plane(),
    "cylinder": Cylinder(1.5, axis=(1, 2, 0.5)),
    "short cylinder": Cylinder(1.5, length=3.0),
    "wedge": Wedge(opening=60, radius=0.5),
    "box": Box((2.0, 3.0, 1.0), radius=0.2),
    "union": Union([Sphere(1.0, translation=(2.0, 0, 0)), Plane(translation=(0, 0, -1.0))]),
    "mesh": MeshIndenter(2 * ICOSAHEDRON.vertices, ICOSAHEDRON.faces),
}
TURN = torch.from_numpy(Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix())


@pytest.fixture(params=EVERY)
def indenter(request):
    return EVERY[request.param].at((0.4, -0.2, 5.0), TURN)


def around(indenter, *shape):
    return 2.5 * torch.randn(*shape, 3, dtype=torch.float64) + indenter.translation


def test_normal_is_the_unit_gradient_by_finite_differences(indenter):
    points, step = around(indenter, 200), 1e-6
    normal = indenter.normal(points)
    torch.testing.assert_close(normal.norm(dim=-1), torch.ones(200, dtype=torch.float64))
    along = torch.randn(200, 3, dtype=torch.float64)
    slope = (indenter.distance(points + step * along) - indenter.distance(points - step * along)) / (2 * step)
    torch.testing.assert_close(slope, (normal * along).sum(-1), rtol=1e-6, atol=1e-6)


def test_a_step_by_the_distance_against_the_normal_ends_on_the_surface(indenter):
    """Exact distance outside: of a lower bound, only what is nearer than it says is promised."""
    points = around(indenter, 400)
    distance, normal = indenter.distance_and_normal(points)
    near = (distance > 0) & (distance < 0.5)
    foot = (points - distance[:, None] * normal)[near]
    assert near.sum() > 10
    assert indenter.distance(foot).abs().max() < 1e-9


def test_distance_moves_with_the_body_and_keeps_the_batch_shape(indenter):
    points = around(indenter, 3, 1, 2)
    turned = points @ TURN.T + 1.0
    moved = indenter.at(TURN @ indenter.translation + 1.0, TURN @ indenter.rotation)
    assert indenter.distance(points).shape == (3, 1, 2)
    torch.testing.assert_close(moved.distance(turned), indenter.distance(points))


def test_distances_in_closed_form():
    at = lambda *p: torch.tensor(p, dtype=torch.float64)  # noqa: E731
    assert float(EVERY["wedge"].distance(at(7, 0, 2))) == pytest.approx(2.0)
    assert float(EVERY["wedge"].distance(at(7, 0, -1.0))) == pytest.approx(-0.5 * 0.5 - 0.5)
    assert float(EVERY["box"].distance(at(2, 2.5, 1.5))) == pytest.approx((3 * 1.2**2) ** 0.5 - 0.2)
    assert float(EVERY["box"].distance(at(0, 0, 0.1))) == pytest.approx(-0.4)
    assert float(EVERY["short cylinder"].distance(at(2.5, 3.5, 0))) == pytest.approx(5**0.5)
    assert float(EVERY["short cylinder"].distance(at(0, 0.5, 0))) == pytest.approx(-1.0)
    assert float(EVERY["union"].distance(at(2, 0, 3))) == pytest.approx(2.0)
    assert float(EVERY["plane"].distance(at(2, 0, -3))) == pytest.approx(-3.0)


def test_a_mesh_of_a_sphere_is_that_sphere():
    fine = trimesh.creation.icosphere(3, 2.0)
    mesh, points = MeshIndenter(fine.vertices, fine.faces), 5 * torch.rand(300, 3, dtype=torch.float64) - 2.5
    torch.testing.assert_close(mesh.distance(points), Sphere(2.0).distance(points), rtol=0, atol=0.02)
    far = 20 * points / points.norm(dim=-1, keepdim=True)
    assert (mesh.distance(far) > 15).all() and (mesh.distance(far) < 18.02).all()


def prism(outline, length):
    """A prism along x over an outline [n, 2] in (y, z), wound from y to z, all of which is seen from its first point."""
    n, front = len(outline), np.column_stack([np.full(len(outline), length / 2), outline])
    fan = np.array([(0, i, i + 1) for i in range(1, n - 1)])
    i, j = np.arange(n), np.roll(np.arange(n), -1)
    sides = np.concatenate([np.stack([i, i + n, j], 1), np.stack([j, i + n, j + n], 1)])
    return np.concatenate([front, front * (-1, 1, 1)]), np.concatenate([fan, fan[:, ::-1] + n, sides])


@pytest.mark.parametrize(
    "outline",
    [[(0, 2), (-0.1, 0), (0.1, 0)], [(0, 0.7), (-0.1, 2), (-1, 2), (-1, 0), (1, 0), (1, 2), (0.1, 2)]],
    ids=["blade", "groove"],
)
def test_a_mesh_knows_its_inside_at_sharp_edges(outline):
    """Points nearest to an edge or corner: the sign is that of the feature's normal, not of either facet's."""
    vertices, triangles = prism(np.array(outline), 3.0)
    points = torch.randn(1000, 3, dtype=torch.float64) * torch.tensor([1.5, 0.3, 0.8]) + torch.tensor([0, 0, 1.0])
    solid = trimesh.Trimesh(vertices, triangles)
    inside = torch.from_numpy(solid.contains(points.numpy()))
    assert inside.sum() > 20 and torch.equal(MeshIndenter(vertices, triangles).distance(points) < 0, inside)


def test_distance_is_differentiable_in_pose_and_size():
    points = torch.randn(5, 3, dtype=torch.float64)

    def total(radius, translation):
        return Sphere(radius, translation=translation).distance(points)

    args = torch.tensor(1.5, dtype=torch.float64), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    assert torch.autograd.gradcheck(total, [a.requires_grad_() for a in args])


def test_poses_between_two_are_straight_and_turn_evenly():
    start = EVERY["box"]
    end = start.at((2.0, 0, 0), torch.from_numpy(Rotation.from_rotvec([0, 0, 1.0]).as_matrix()))
    half = start.between(end, 0.5)
    torch.testing.assert_close(half.translation, torch.tensor([1.0, 0, 0]).double())
    torch.testing.assert_close(half.rotation, torch.from_numpy(Rotation.from_rotvec([0, 0, 0.5]).as_matrix()))


def test_touching_stops_where_the_rest_surface_begins(indenter):
    cap, direction = spherical_cap(12, 9, 15, (33, 33)), (0.3, 0.0, -1.0)
    body = indenter.at(indenter.translation, facing(direction)).touching(cap, direction)
    assert 0 <= body.distance(cap.rest).min() < 1e-5
    with pytest.raises(MembraneError, match="does not meet"):
        Sphere(1.0, translation=(50.0, 0, 0)).touching(cap, (0, 0, -1))
    with pytest.raises(MembraneError, match="does not meet"):
        Plane().touching(cap, (0, 0, -1))


def test_facing_is_a_rotation_with_that_third_axis():
    for direction in ((0, 0, -1.0), (1.0, 0, 0), (0.3, -2, 0.5)):
        R, d = facing(direction), torch.tensor(direction).double()
        torch.testing.assert_close(R @ R.T, torch.eye(3).double())
        torch.testing.assert_close(R[:, 2], d / d.norm())
        assert R.det() > 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sphere(-1.0), "radius = -1.0"),
        (lambda: Sphere(1.0, rotation=2 * torch.eye(3)), "orthonormal"),
        (lambda: Wedge(opening=190, radius=1.0), "opening = 190"),
        (lambda: Box((1.0, 1, 0.1), radius=0.1), "sides"),
        (lambda: Cylinder(1.0, axis=(0, 0, 0)), "not zero"),
        (lambda: Union([]), "no parts"),
        (lambda: MeshIndenter(ICOSAHEDRON.vertices, ICOSAHEDRON.faces[1:]), "closed mesh"),
    ],
)
def test_impossible_bodies_are_refused(make, message):
    with pytest.raises(MembraneError, match=message):
        make()


def test_a_truth_names_the_body():
    """Stored in every simulated frame: other programs read these words."""
    assert {name: body.kind for name, body in EVERY.items() if name in ("sphere", "plane", "mesh")} == {
        "sphere": "sphere",
        "plane": "plane",
        "mesh": "mesh",
    }


def test_the_namespace_hands_on_every_name_it_lists():
    assert sorted(simulate.__all__) == sorted(simulate._MODULE_OF)
    for name in simulate.__all__:
        assert getattr(simulate, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'Indentor'"):
        simulate.Indentor  # noqa: B018
