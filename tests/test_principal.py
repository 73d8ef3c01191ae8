"""Principal tensions are the energy's derivatives."""

import numpy as np
import pytest
import torch

import torchmembrane as tm
from torchmembrane.mechanics.cavity import rest_balance
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.mechanics.principal import principal_fields
from torchmembrane.surface.shapes import heightfield, spherical_cap

MATERIALS = [("harmonic", 1.2, 0.0), ("neo_hookean", 1.2, 0.0), ("mooney_rivlin", 1.2, 0.15)]


@pytest.mark.parametrize(("model", "prestretch", "c2_ratio"), MATERIALS)
def test_tension_is_the_energy_s_derivative(model, prestretch, c2_ratio):
    """A rectangle 4 x 3, stretched by a and b: to lengthen it along x takes the tension times its width."""
    plane = heightfield(np.linspace(0, 4, 6), np.linspace(0, 3, 5), np.full((6, 5), 9.0))
    elasticity = ElasticEnergy(plane, model, prestretch, modulus=0.7, c2_ratio=c2_ratio)
    sides, one = torch.tensor([1.3, 0.9]).double().requires_grad_(), torch.ones(1).double()
    energy = elasticity.energy(plane.rest * torch.cat([sides, one]))
    by_a, by_b = torch.autograd.grad(energy, sides)[0]
    a, b = sides.tolist()
    expected = torch.stack([by_a / 4 / (b * 3), by_b / 3 / (a * 4)])
    x = (plane.rest * torch.cat([sides, one])).detach()
    tension = principal_fields(elasticity, plane, x, "tension")
    torch.testing.assert_close(tension, expected.expand(30, 2), rtol=1e-9, atol=0)
    stretch = principal_fields(elasticity, plane, x, "stretch")
    torch.testing.assert_close(stretch, (prestretch * sides.detach()).expand(30, 2), rtol=1e-9, atol=0)


@pytest.mark.parametrize("name", ["stretch", "tension"])
def test_fields_ignore_rotation_and_translation(name):
    cap = spherical_cap(12.0, 9.0, 15.0, (9, 9))
    elasticity = ElasticEnergy(cap, "mooney_rivlin", 1.2, c2_ratio=0.1)
    x = cap.rest + 0.5 * torch.randn(2, 81, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]
    here, there = (principal_fields(elasticity, cap, each, name) for each in (x, x @ turn + 7.0))
    assert here.shape == (2, 81, 2) and float(here.std()) > 0.01
    torch.testing.assert_close(there, here, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("model", "prestretch", "c2_ratio"), MATERIALS)
def test_a_sphere_s_tension_holds_half_its_pressure_times_its_radius(model, prestretch, c2_ratio):
    """`T = p R / 2`, p the pressure that balances the cap at rest."""
    cap = spherical_cap(12.0, 9.0, 15.0, (33, 33))
    radius = (12.0**2 + 9.0**2) / (2 * 9.0)
    elasticity = ElasticEnergy(cap, model, prestretch, modulus=0.7, c2_ratio=c2_ratio)
    tension = principal_fields(elasticity, cap, cap.rest, "tension")
    torch.testing.assert_close(tension, (rest_balance(cap, elasticity)[0] * radius / 2).expand_as(tension), rtol=0.01, atol=0)


def test_a_reconstructor_gives_the_fields_of_its_results():
    """At rest the prestretch and the sensor's tension, to the root of float32's rounding; NaN where there is no surface."""
    reconstructor = tm.Reconstructor(tm.preset("bubble"))
    pixels = torch.stack([reconstructor.rest_pixels, torch.full_like(reconstructor.rest_pixels, torch.nan)])
    fields = reconstructor.fields(reconstructor.from_pixels(pixels), ["stretch", "tension"])
    assert set(fields) == {"stretch", "tension"} and list(fields["stretch"].shape) == [2, 33 * 33, 2]
    torch.testing.assert_close(fields["stretch"][0], torch.full((1089, 2), 1.3), rtol=0.01, atol=0)
    held = float(reconstructor.estimator.elasticity.tension)
    torch.testing.assert_close(fields["tension"][0], torch.full((1089, 2), held), rtol=0.02, atol=0)
    assert bool(fields["tension"][1].isnan().all())
    with pytest.raises(tm.MembraneError, match="fields: 'strain'; expected stretch, tension"):
        reconstructor.fields(reconstructor.from_pixels(pixels), ["strain"])
