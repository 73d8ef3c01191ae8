"""Measurements of a modulus combine by their deviations."""

from dataclasses import replace

import numpy as np
import pytest

from torchmembrane import Sensor
from torchmembrane.calibrate.known_modulus import (
    FORCE_ERROR,
    KnownForces,
    ModulusEvidence,
    joined,
    modulus_at_rest,
    odd_ones,
)
from torchmembrane.cli.calibrate.files import read_forces
from torchmembrane.jobs.inputs import Inputs
from torchmembrane.mechanics.cavity import rest_balance
from torchmembrane.presets.blown_up import Stated, blown_up
from torchmembrane.sensor.factories import elastic_energy


def test_measurements_that_agree_are_surer_together_and_ones_that_differ_less_sure():
    at_rest, forces = ModulusEvidence("gauge", 0.50, 0.03, 0.0), ModulusEvidence("forces", 0.52, 0.04, 0.0)
    found, alone = joined([at_rest, forces]), joined([forces])
    assert 0.50 < found.modulus < 0.52 and not found.contradictions and found.shift == pytest.approx(0.0)
    assert found.covariance[1, 1] == pytest.approx(1 / ((0.50 / 0.03) ** 2 + (0.52 / 0.04) ** 2))
    apart = joined([at_rest, forces._replace(modulus=0.8)])
    assert apart.covariance[1, 1] > 5 * found.covariance[1, 1] and len(apart.contradictions) == 1
    assert "gauge and forces contradict one another" in apart.contradictions[0]
    assert alone.modulus == pytest.approx(0.52) and alone.shift == pytest.approx(0.0)


def test_one_measurement_leaves_the_prestretch_and_what_it_does_to_the_modulus():
    """Covariance `[[1, g], [g, s^2 + g^2]]` of the shift and the modulus' logarithm."""
    found = joined([ModulusEvidence("forces", 0.5, 0.05, -0.1)])
    np.testing.assert_allclose(found.covariance[:2, :2], [[1.0, -0.2], [-0.2, 0.1**2 + 0.2**2]])


def test_two_measurements_that_depend_on_the_prestretch_in_their_own_way_tell_it():
    """True: prestretch one deviation larger than the shapes say, modulus 0.5."""
    at_rest = ModulusEvidence("gauge", 0.5 * np.exp(0.4), 0.01, -0.4 * 0.5 * np.exp(0.4))
    forces = ModulusEvidence("forces", 0.5 * np.exp(0.1), 0.01, -0.1 * 0.5 * np.exp(0.1))
    found = joined([at_rest, forces])
    assert found.shift == pytest.approx(1.0, abs=0.02) and found.modulus == pytest.approx(0.5, rel=0.01)
    assert found.covariance[0, 0] < 0.02 and not found.contradictions
    alike = joined([at_rest, at_rest._replace(source="b")])
    assert alike.shift == pytest.approx(0.0, abs=1e-6) and alike.covariance[0, 0] > 0.99  # an error that both share stays


def test_an_uncertain_height_of_the_rest_surface_enters_prestretch_and_modulus():
    """`t = e + b h`, `log m = log m_1 + g t + c h` with `e`, `h` of variance 1; what two tell in their own way is known."""
    one = ModulusEvidence("gauge", 0.5, 0.01, -0.1, 0.05)
    s, g, b, c = 0.02, -0.2, 0.3, 0.1
    along = g * b + c
    expected = [[1 + b**2, g + b * along, b], [g + b * along, s**2 + g**2 + along**2, along], [b, along, 1.0]]
    np.testing.assert_allclose(joined([one], b).covariance, expected, atol=1e-12)
    true = 0.7  # higher by so many deviations; the prestretch as the shapes say
    gauge = ModulusEvidence("gauge", 0.5 * np.exp(-0.3 * true), 0.001, 0.0, 0.3 * 0.5 * np.exp(-0.3 * true))
    forces = ModulusEvidence("forces", 0.5 * np.exp(0.1 * true), 0.001, 0.0, -0.1 * 0.5 * np.exp(0.1 * true))
    found = joined([gauge, forces])
    assert found.modulus == pytest.approx(0.5, rel=0.003) and found.covariance[2, 2] < 0.01 and not found.contradictions


def test_a_modulus_that_rises_faster_and_faster_is_summed_over_the_prestretches():
    """`log m = log m_1 + s n + g t + q t^2`, `t` and `n` normal: mean `log m_1 + q`, variance `s^2 + g^2 + 2 q^2`."""
    s, g, q = 0.05, -0.4, 0.15
    one = ModulusEvidence("gauge", 0.5, s * 0.5, -0.3, 0.0, (0.5 * np.exp(q - g), 0.5 * np.exp(q + g)))
    found = joined([one])
    assert np.log(found.modulus / 0.5) == pytest.approx(q, abs=1e-6) and found.shift == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(found.covariance[:2, :2], [[1.0, g], [g, s**2 + g**2 + 2 * q**2]], atol=1e-6)
    straight = one._replace(change=0.5 * g, sides=None)
    alike = joined([straight._replace(sides=(0.5 * np.exp(-g), 0.5 * np.exp(g)))], 0.3, (0.4, 0.7))
    np.testing.assert_allclose(alike.covariance, joined([straight], 0.3, (0.4, 0.7)).covariance, atol=1e-9)
    assert alike.modulus == pytest.approx(joined([straight], 0.3, (0.4, 0.7)).modulus)
    half = joined([one], least=0.0)  # of half a normal distribution
    assert half.shift == pytest.approx((2 / np.pi) ** 0.5, abs=0.02)


@pytest.mark.parametrize("q", [0.0, 0.15])
def test_an_interval_holds_the_truth_in_95_of_100_measurements(q):
    """Shift `t` and noise `s` at random, the modulus `exp(g t + q t^2)`; a straight line and a parabola."""
    s, g, rng, held = 0.05, -0.4, np.random.default_rng(0), []
    for t, noise in rng.normal(size=(400, 2)):
        modulus = np.exp(g * t + q * t**2)
        at_zero = np.exp(s * noise)  # the true modulus is 1 where the shapes are right
        sides = (at_zero * np.exp(q - g), at_zero * np.exp(q + g)) if q else None
        found = joined([ModulusEvidence("gauge", at_zero, s * at_zero, g * at_zero, 0.0, sides)])
        held.append([low < value < high for (low, high), value in zip(found.intervals, (t, modulus), strict=True)])
    np.testing.assert_allclose(np.mean(held, 0), 0.95, atol=0.025)
    wider = joined([ModulusEvidence("gauge", 1.0, s, g, 0.0), ModulusEvidence("forces", 2.0, 2 * s, g, 0.0)])
    assert np.ptp(np.log(wider.intervals[1])) == pytest.approx(2 * 1.96 * wider.covariance[1, 1] ** 0.5, rel=1e-3)


def test_a_height_that_is_known_otherwise_enters_with_its_mean():
    """`log m = log m_1 + c h` with `h` of mean 0.4 and deviation 0.7."""
    found = joined([ModulusEvidence("gauge", 0.5, 0.01, 0.0, 0.05)], 0.3, (0.4, 0.7))
    assert (found.height, found.shift) == pytest.approx((0.4, 0.3 * 0.4))
    assert np.log(found.modulus / 0.5) == pytest.approx(0.1 * 0.4)
    assert found.covariance[1, 1] == pytest.approx(0.02**2 + (0.1 * 0.7) ** 2)


def test_each_force_that_the_others_contradict_is_named():
    ratios = np.array([1.0, 1.05, 0.97, 1.55, 1.02, 0.6])
    assert [i for i, _, _ in odd_ones(ratios, np.full(6, 0.1))] == [3, 5]
    assert not odd_ones(ratios, np.array([0.1, 0.1, 0.1, 0.4, 0.1, 0.4])) and not odd_ones(
        np.array([1.0, 2.0]), np.full(2, 0.1)
    )


def test_a_force_s_own_deviation_adds_to_what_the_images_leave():
    known = KnownForces(np.array([[2.0], [np.nan], [4.0]]), np.array([0.2, np.nan, np.nan]))
    np.testing.assert_allclose(known.relative, [np.hypot(FORCE_ERROR, 0.1), FORCE_ERROR])


def test_a_table_of_forces_may_have_deviations(tmp_path):
    images = [tmp_path / f"{name}.png" for name in "ab"]
    (tmp_path / "f.csv").write_text("image,force,deviation\nb.png,2.5,0.1\n")
    found = read_forces(tmp_path / "f.csv", Inputs(images, []))
    np.testing.assert_array_equal(found.forces, [[np.nan], [2.5]])
    np.testing.assert_array_equal(found.deviations, [np.nan, 0.1])


def test_the_modulus_from_a_gauge_at_rest_holds_the_rest_surface():
    sensor = Sensor.from_file("examples/sensor.toml")
    stretch = np.log(sensor.material.prestretch)
    p0 = float(rest_balance(sensor.membrane, elastic_energy(sensor, sensor.membrane))[0]) * 1e4
    found = modulus_at_rest(sensor, stretch, 0.05, p0)
    assert found.modulus == pytest.approx(sensor.material.modulus, rel=1e-9) and found.change < 0  # more tension, less modulus
    assert -found.change == pytest.approx(max(abs(side - found.modulus) for side in found.sides))
    window = blown_up({"outline": "ellipse", "size": [50.0, 36.0], "base_z": 40.0}, "mm", Stated(6.0, 12.0, 1.1, None, 0.2))
    sensor = replace(
        sensor,
        surface=window.surface,
        membrane=window.surface.membrane((17, 17)),
        material=window.material,
        markers=replace(sensor.markers, positions=None, sizes=None),
    )
    surface = window.surface.of_height(6.3)
    higher = replace(sensor, surface=surface, membrane=surface.membrane((17, 17)))
    found, other = (modulus_at_rest(each, np.log(1.1), 0.02, 12.0, higher) for each in (sensor, higher))
    assert found.modulus == pytest.approx(window.material.modulus, rel=1e-4)
    assert found.by_height == pytest.approx(other.modulus - found.modulus) and found.by_height < 0 == other.by_height
