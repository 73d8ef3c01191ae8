"""Compiled and tensor contact patches agree."""

import pytest
import torch

from torchmembrane.estimators.contacts import ContactPatches
from torchmembrane.estimators.force_balance.traction_loss import _gaussian_mean
from torchmembrane.machine_code import using
from torchmembrane.solve.stencil import inner
from torchmembrane.surface.shapes import spherical_cap

MIDDLES = [[(0.0, 0.0)], [(4.0, 1.0), (-4.0, -2.0)], [(0.0, 11.3), (5.0, -3.0), (-5.0, -3.0)], []]
"""Of pushes, mm: one; two; three, of which one at the rim; none."""


def pushed(dtype):
    """A dome dented where it is pushed, with shear, a pull elsewhere, and noise too weak to be a contact."""
    dome = spherical_cap(12, 9, 3, (27, 25))
    generator = torch.Generator().manual_seed(0)
    x, traction = dome.rest.repeat(len(MIDDLES), 1, 1), torch.zeros(len(MIDDLES), *dome.rest.shape).double()
    for frame, middles in enumerate(MIDDLES):
        for strength, middle in enumerate(middles, 1):
            away = (dome.rest[:, :2] - torch.tensor(middle)).square().sum(-1)
            bump = torch.exp(-away / (2 * 1.8**2))[:, None]
            x[frame] -= 1.5 * bump * dome.rest_normals
            traction[frame] -= strength * bump * (dome.rest_normals + torch.tensor([0.2, 0.1, 0.0]))
    traction += 0.02 * torch.randn(traction.shape, generator=generator, dtype=torch.float64)
    x, traction = (value * ~dome.fixed[:, None] + dome.rest * add for value, add in ((x - dome.rest, 1), (traction, 0)))
    reference = torch.full(traction.shape[:2], 0.3).double()
    means = inner(inner(_gaussian_mean(dome, 1.2), dome.grid).mT, dome.grid).mT
    patches = ContactPatches(dome, spacing=1.0).to(dtype)
    given = x, patches.membrane.normals(x.to(dtype)), traction, reference, means.contiguous()
    return patches, tuple(value.to(dtype) for value in given)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-9), (torch.float32, 2e-3)])
def test_patches_are_those_of_tensor_operations(dtype, tolerance):
    patches, given = pushed(dtype)
    found = patches.pushes(*given)
    with using(False):
        wanted = patches.pushes(*given)
    assert wanted.points[..., 0].isfinite().sum(1).tolist() == [1, 2, 3, 0]
    assert wanted.at_rim.nansum() > 0 and wanted.curvature.isfinite().any()
    for name, one, other in zip(wanted._fields, found, wanted, strict=True):
        assert (one.isnan() == other.isnan()).all(), name
        torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance, equal_nan=True)


def test_many_faint_peaks_are_told_from_one_by_the_passes_between_them():
    """Rough pushes all over: more peaks than are looked at, most of which do not stand for themselves."""
    patches, (x, normals, traction, reference, means) = pushed(torch.float64)
    rough = torch.rand(traction.shape[:2], generator=torch.Generator().manual_seed(1), dtype=torch.float64) ** 3
    given = x, normals, -rough[..., None] * normals * ~patches.membrane.fixed[:, None], 0.01 * reference, torch.eye(len(means))
    given = *given[:4], given[4].double()
    found = patches.pushes(*given)
    with using(False):
        wanted = patches.pushes(*given)
    torch.testing.assert_close(found.points, wanted.points, equal_nan=True)
    torch.testing.assert_close(found.force, wanted.force, equal_nan=True)


def test_a_broken_frame_has_no_contact_and_the_others_theirs():
    patches, given = pushed(torch.float64)
    x = given[0].clone()
    x[1] = torch.nan
    found, wanted = patches.pushes(x, patches.membrane.normals(x), *given[2:]), patches.pushes(*given)
    torch.testing.assert_close(found.force[::2], wanted.force[::2], equal_nan=True)
