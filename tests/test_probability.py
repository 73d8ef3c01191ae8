"""A dot is found where this is likelier than all other explanations."""

import numpy as np
import pytest
import torch
from scipy import stats

from torchmembrane.markers.dots import probability as p
from torchmembrane.markers.dots.fit import FittedDots
from torchmembrane.markers.dots.seams import Seams
from torchmembrane.markers.dots.steps import NeighbourSteps

REST = 20.0 * np.stack(np.meshgrid(np.arange(6.0), np.arange(5.0)), -1).reshape(-1, 2)


def dots(explained=0.97, contrast=0.9):
    """Thirty at rest, clearly seen."""
    each = torch.ones(1, len(REST), dtype=torch.float64)
    centre, covariance = torch.tensor(REST)[None], torch.eye(2).double().expand(1, len(REST), 2, 2)
    return FittedDots(centre, covariance, 0 * each, explained * each, contrast * each, 0 * each)


def judged(found):
    """Probabilities `[B, D]` with the neighbours, of a pattern that does not stretch."""
    flat = torch.zeros(len(found.centre), 2, 2, len(REST), dtype=torch.float64)
    alone = p.alone(found)
    share, error = NeighbourSteps(REST, np.ones(len(REST), bool))(found.centre.mT, alone, flat)
    return p.among_neighbours(found, alone.mean(-1, keepdim=True) * share, error)


def test_a_dot_and_none_are_alike_where_schwarz_finds_them_equal():
    """`n log(variance) + parameters log(n)` of independent pixels, with the dot and without."""
    share = 1 - p.PIXELS ** (-p.PARAMETERS / p.PIXELS)
    explained = torch.tensor([share, 0.3, 0.9], dtype=torch.float64)
    criterion = p.PIXELS * np.log(1 - explained.numpy()) + p.PARAMETERS * np.log(p.PIXELS)
    np.testing.assert_allclose(p.dot_evidence(explained), -criterion / 2, atol=1e-12)


def test_contrasts_are_told_apart_as_two_normal_distributions():
    contrast = np.linspace(-0.5, 1.5, 9)
    right, wrong = (stats.norm(0.4 + side, p.CONTRAST_DEVIATION).logpdf(contrast) for side in (0.5, -0.5))
    np.testing.assert_allclose(p.contrast_evidence(torch.tensor(contrast), 0.4), right - wrong, atol=1e-9)


def test_right_steps_are_normal_and_wrong_ones_uniform_in_the_plane():
    error, found = np.linspace(0, 0.5, 6), np.linspace(0, 1, 6)
    right = stats.multivariate_normal(np.zeros(2), p.STEP_DEVIATION**2).logpdf(np.stack([error, 0 * error], -1))
    prior = np.log((found + p.LOST) / (1 - found + p.LOST))
    expected = prior + right + np.log(np.pi * p.PREDICTION**2)
    np.testing.assert_allclose(p.own_evidence(torch.tensor(found), torch.tensor(error)), expected, atol=1e-9)


def test_the_probability_is_one_over_one_and_all_odds_against():
    evidence = torch.randn(3, 2, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(p.probability(*evidence), 1 / (1 + (-evidence).exp().sum(0)))


def test_a_dot_has_the_odds_of_its_window_its_contrast_its_size_and_its_neighbours_against_it():
    """Contrasts count over the mean of the clearer half and `SHADE`; each further explanation adds its odds."""
    generator = np.random.default_rng(0)
    explained, contrast, found, error, other = (generator.uniform(0.1, 0.8, (2, len(REST))) for _ in range(5))
    misfit, one = generator.uniform(0, 9, (2, len(REST))), np.ones((2, len(REST)))
    seen = dots(torch.tensor(explained), torch.tensor(contrast))._replace(misfit=torch.tensor(misfit))
    level = np.sort(contrast, 1)[:, len(REST) // 2 :].mean(1, keepdims=True) + p.SHADE
    window = p.dot_evidence(torch.tensor(explained)).numpy(), p.contrast_evidence(torch.tensor(contrast / level)).numpy()
    for own, others, got in (
        ((one, 0 * one), (), p.alone(seen)),
        ((found, error), (other,), p.among_neighbours(seen, *map(torch.tensor, (found, error, other)))),
    ):
        size = p.own_evidence(*map(torch.tensor, own)).numpy() - misfit / 2
        np.testing.assert_allclose(got, 1 / (1 + sum(np.exp(-x) for x in (*window, size, *others))), atol=1e-9)


def test_the_error_of_a_step_is_over_its_length():
    """A pattern stretched by a tenth, its dots unevenly spaced, has that error everywhere."""
    uneven = REST + np.random.default_rng(0).uniform(-6, 6, REST.shape)
    one, flat = torch.ones(1, len(REST), dtype=torch.float64), torch.zeros(1, 2, 2, len(REST), dtype=torch.float64)
    share, error = NeighbourSteps(uneven, np.ones(len(REST), bool))(torch.tensor(1.1 * uneven.T)[None], one, flat)
    torch.testing.assert_close(error, 0.1 * one)
    torch.testing.assert_close(share, one)


def test_what_is_seen_clearly_among_its_neighbours_is_believed():
    assert judged(dots()).min() > 0.95


def test_no_dot_and_a_faint_one_are_not_believed_and_cost_no_other():
    for name, value in dict(explained=0.3, contrast=0.2).items():
        found = dots()
        getattr(found, name)[0, 14] = value
        confidence = judged(found)[0]
        assert confidence[14] < 0.1 and np.delete(confidence.numpy(), 14).min() > 0.85


def test_dots_as_clear_in_a_fainter_image_are_believed_as_much():
    clear, faint = (judged(dots(contrast=contrast)) for contrast in (0.9, 0.5))
    assert float((clear - faint).abs().max()) < 0.02


def test_nothing_is_believed_where_most_is_lost_and_the_rest_astray():
    found = dots()
    found.explained[0, 3:] = 0.1
    found.centre[0, :3, 0] += torch.tensor([0.0, 5.0, -5.0])
    assert judged(found).max() < 0.5


def test_the_frame_is_judged_alone_as_in_a_batch():
    found = dots()
    found.contrast[0, 14] = 0.2
    both = FittedDots(*(torch.cat([one, other]) for one, other in zip(dots(), found, strict=True)))
    torch.testing.assert_close(judged(both)[1:], judged(found))


def test_a_tear_is_told_as_an_exponential_distribution_from_a_uniform_one():
    tear = np.array([0.0, 0.01, 0.1])
    expected = stats.expon(scale=p.TEAR).logpdf(tear) - stats.uniform(0, 1).logpdf(tear) - np.log(p.LOST)
    np.testing.assert_allclose(p.whole_evidence(torch.tensor(tear)), expected, atol=1e-9)


@pytest.mark.parametrize("lost, left, torn", [(True, True, True), (True, False, False), (False, True, False)])
def test_a_seam_has_lost_dots_and_blobs_left_over_and_wrong_steps(lost, left, torn):
    seams, centre = Seams(REST, np.zeros(len(REST)), 0.45), torch.tensor(REST)[None]
    wrong, sure = torch.full((1, len(REST)), 0.3, dtype=torch.float64), torch.ones(1, len(REST), dtype=torch.float64)
    sure[0, 14] = 1.0 - lost
    blobs = torch.cat([centre, centre[:, 14:15] + torch.tensor([0.0, 9.0])], 1) if left else centre[:, torch.arange(30) != 14]
    if left and lost:
        blobs = blobs[:, torch.arange(31) != 14]
    radius = torch.zeros(1, blobs.shape[1], dtype=torch.float64)
    tears = seams(centre, sure, wrong, blobs, radius, torch.ones_like(radius))
    assert (float(tears[0, 15]) > 0.045) == torn
    assert float(seams(centre, sure, 0 * wrong, blobs, radius, torch.ones_like(radius)).max()) < 1e-6
