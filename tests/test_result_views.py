"""Depth maps, fields and point clouds show the result's surface."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torchmembrane_edge import view_status as edge_status

import torchmembrane as tm
from torchmembrane.cli.main import main
from torchmembrane.results import view_status
from torchmembrane.results.npz import save_frame
from torchmembrane.results.point_cloud import save_contact_cloud

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def result(reconstructor):
    with torch.no_grad():
        return reconstructor(reconstructor.read(EXAMPLES / "press_on_axis.png"))


def test_the_indentation_is_what_the_surface_is_moved_in(sensor, result):
    membrane = sensor.membrane
    moved = -torch.linspace(-1, 2, 81)[:, None] * membrane.rest_normals
    along = torch.linalg.cross(membrane.rest_normals, torch.ones_like(membrane.rest_normals))
    shifted = result._replace(displacement=(moved + along).float()[None])
    expected = torch.linspace(-1, 2, 81).reshape(1, 9, 9)
    torch.testing.assert_close(shifted.indentation(membrane), expected, atol=1e-5, rtol=1e-5)
    assert result.indentation(membrane).argmax() == 40  # the middle, where the ball is
    with pytest.raises(tm.MembraneError, match="vertices of rest is 121; expected 81"):
        result.indentation(sensor.surface.membrane((11, 11)))


def test_the_fields_hold_the_whole_force(sensor, result):
    fields, normals = result.tactile_fields(sensor.membrane), sensor.membrane.rest_normals.float()
    along = torch.nn.functional.normalize(torch.tensor([1.0, 0, 0]) - normals[:, :1] * normals, dim=-1)
    across = torch.linalg.cross(normals, along)
    shear = fields.tactile_shear_force
    force = -fields.tactile_normal_force[..., None] * normals + shear[..., :1] * along + shear[..., 1:] * across
    torch.testing.assert_close(force.sum(1), result.force, rtol=1e-4, atol=1e-4)
    assert fields.penetration_depth.shape == (1, 81) and fields.penetration_depth.min() == 0
    assert fields.tactile_normal_force[0, 40] > 0


def test_the_command_writes_the_contact_as_a_cloud_that_others_read(result, tmp_path, capsys):
    frame = result.frame(0)
    touched = frame["vertices"][frame["contact"] > 0.5]
    save_frame(tmp_path / "press.npz", frame)
    assert main(["view", str(tmp_path / "press.npz"), "--ply", str(tmp_path / "press.ply")]) == 0
    assert f"{len(touched)} points of the contact" in capsys.readouterr().out and len(touched) > 0
    np.testing.assert_allclose(trimesh.load(tmp_path / "press.ply").vertices, touched, rtol=1e-5)
    half = frame | {"contact": np.where(np.arange(81) < 3, 0.5001, 0.5).astype(np.float32)}
    assert save_contact_cloud(tmp_path / "half.ply", half) == 3
    nothing = frame | {"contact": np.full_like(frame["contact"], np.nan)}
    assert save_contact_cloud(tmp_path / "none.ply", nothing) == 0


@pytest.mark.parametrize(
    ("by", "moved"),
    [(0, 1.1), (1, -1.1), (2, 0.4), (2, -0.4), (3, 0.006), (3, -0.006), (0, 0.9), (2, -0.2), (3, 0.004), (3, -0.004)],
)
def test_a_view_has_moved_where_its_image_has_shifted_turned_or_scaled_either_way(by, moved):
    """Beyond 1 px, 0.3 degrees or 0.5 %; in the words of the package for edge devices too."""
    motion = np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    motion[1, by] += moved
    expected = ["right"] if abs(moved) > (1.0, 1.0, 0.3, 0.005)[by] else []
    for moved_views in (view_status.moved_views, edge_status.moved_views):
        assert moved_views({"camera_motion": motion}, ["left", "right"]) == expected
