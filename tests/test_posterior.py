"""Normal distributions over what a room shares: against textbook formulas and the plain cost."""

import pytest
import torch

from mover.stages.posterior import FREEDOM, Gaussian, Observations, diagonal, least_squares


def test_an_error_that_is_an_unknown_is_a_covariance() -> None:
    """Ten values with one shared error are generalised least squares with their full covariance."""
    torch.manual_seed(0)
    values, own, shared = torch.randn(10).double(), 0.3, 0.2
    seen = Observations()
    scale, error = torch.eye(2, dtype=torch.float64)
    seen.add((scale + error).expand(10, -1), values, own)
    seen.add(error, 0.0, shared)
    found = least_squares(seen)
    precision = torch.linalg.inv(own**2 * torch.eye(10) + shared**2).double()
    assert float(found.covariance[0, 0]) == pytest.approx(1 / float(precision.sum()), rel=1e-5)
    mean = float((precision @ values).sum() / precision.sum())
    assert float(found.mean[0]) == pytest.approx(mean, rel=1e-5)
    assert float(found.covariance[0, 0]) > shared**2  # however many there are


def test_outliers_are_at_the_minimum_of_students_cost() -> None:
    torch.manual_seed(1)
    slopes = torch.randn(30, 3).double()
    values = slopes @ torch.tensor([1.0, -2.0, 0.5]).double() + 0.1 * torch.randn(30).double()
    values[:4] += 5.0
    seen = Observations()
    seen.add(slopes, values, 0.1, robust=True)
    at = least_squares(seen).mean.requires_grad_()
    squares = ((values - slopes @ at) / 0.1).square()
    kept = squares > 1  # below one standard deviation an error counts fully
    cost = torch.where(
        kept, (FREEDOM + 1) * (1 + (squares - 1) / (FREEDOM + 1)).log() + 1, squares
    ).sum()
    cost.backward()
    assert float(at.grad.abs().max()) < 1e-3 * float(cost.detach())
    assert at.detach().tolist() == pytest.approx([1.0, -2.0, 0.5], abs=0.15)


def test_two_sources_know_more_than_each() -> None:
    first = diagonal(torch.tensor([1.0, 5.0]), torch.tensor([1.0, torch.inf]))
    second = Gaussian(torch.tensor([3.0, 2.0]), torch.tensor([[1.0, 0.0], [0.0, 4.0]]))
    both = first.times(second)
    assert both.mean.tolist() == pytest.approx([2.0, 2.0])
    assert both.covariance.diag().tolist() == pytest.approx([0.5, 0.25])
