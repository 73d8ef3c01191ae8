"""Robust losses for iteratively reweighted least squares (IRLS), as functions of a squared residual `r2 = r^2`.

Each has `loss(r2)` and the weight `loss'(r) / r = 2 d loss / d r2` of the parabola that touches the loss at `r`. Near zero all
losses are `r^2 / 2` (pseudo-Huber: times its weight at zero). Decreasing the scale is therefore graduated non-convexity (GNC):
the problem starts quadratic.

Reference: Barron 2019, A general and adaptive robust loss function; Blake and Zisserman 1987, Visual reconstruction.
"""

from typing import Any, NamedTuple, TypeVar

from torch import Tensor

Scalar = TypeVar("Scalar", float, Tensor)


def geman_mcclure_weight(ratio: Scalar) -> Scalar:
    """Return the weight `loss'(r) / r` of Geman and McClure's loss, in 0..1, from `ratio = r^2 / s^2`, `[...]`.

    Example:
        >>> geman_mcclure_weight(1.0)
        0.25
    """
    weight: Scalar = (1 + ratio) ** -2
    return weight


def geman_mcclure_curvature(ratio: Scalar) -> Scalar:
    """Return `loss''(r)` of Geman and McClure's loss from `ratio = r^2 / s^2`, `[...]`; negative for `ratio > 1/3`.

    Example:
        >>> geman_mcclure_curvature(1.0)
        -0.25
    """
    curvature: Scalar = (1 - 3 * ratio) / (1 + ratio) ** 3
    return curvature


def geman_mcclure_loss(r2: Scalar, scale: Any) -> Scalar:
    """Return Geman and McClure's loss for `r2 = r^2 [...]` and a scale `s`, a number or a tensor `[]`.

    Example:
        >>> geman_mcclure_loss(4.0, 2.0)
        1.0
    """
    loss: Scalar = r2 / (2 + 2 * r2 / scale**2)
    return loss


class GemanMcClure(NamedTuple):
    """Geman and McClure's loss `r^2 / (2 (1 + r^2 / s^2))`, which saturates at `s^2 / 2`: large residuals have no weight.

    Args:
        scale: scale `s`, a number or a tensor that the residuals can be divided by.

    Example:
        >>> import torch
        >>> GemanMcClure(2.0).loss(torch.tensor(4.0)), GemanMcClure(2.0).weight(torch.tensor(4.0))
        (tensor(1.), tensor(0.2500))
    """

    scale: float | Tensor

    def loss(self, r2: Tensor) -> Tensor:
        """Return the loss, of the shape of `r2`."""
        return geman_mcclure_loss(r2, self.scale)

    def weight(self, r2: Tensor) -> Tensor:
        """Return the weight, in 0..1, of the shape of `r2`."""
        return geman_mcclure_weight(r2 / self.scale**2)

    def curvature(self, r2: Tensor) -> Tensor:
        """Return the second derivative with respect to `r`, or zero where it is negative."""
        return geman_mcclure_curvature(r2 / self.scale**2).clamp_min(0)


class Cauchy(NamedTuple):
    """The Cauchy loss `s^2 / 2 log(1 + r^2 / s^2)`: the influence of an outlier decreases with its distance.

    Args:
        scale: scale `s`, a number or a tensor that the residuals can be divided by.

    Example:
        >>> import torch
        >>> Cauchy(2.0).weight(torch.tensor([0.0, 4.0]))
        tensor([1.0000, 0.5000])
    """

    scale: float | Tensor

    def loss(self, r2: Tensor) -> Tensor:
        """Return the loss, of the shape of `r2`."""
        return self.scale**2 / 2 * (r2 / self.scale**2).log1p()

    def weight(self, r2: Tensor) -> Tensor:
        """Return the weight, in 0..1, of the shape of `r2`."""
        return 1 / (1 + r2 / self.scale**2)


class PseudoHuber(NamedTuple):
    """The pseudo-Huber loss `sqrt(r^2 + s^2) - s`: quadratic well below `s`, and close to `|r|` well above.

    Args:
        scale: scale `s`, a number or a tensor `[]`.

    Example:
        >>> import torch
        >>> PseudoHuber(3.0).loss(torch.tensor(16.0)), PseudoHuber(3.0).weight(torch.tensor(16.0))
        (tensor(2.), tensor(0.2000))
    """

    scale: float | Tensor

    def loss(self, r2: Tensor) -> Tensor:
        """Return the loss, of the shape of `r2`."""
        return (r2 + self.scale**2).sqrt() - self.scale

    def weight(self, r2: Tensor) -> Tensor:
        """Return the weight, at most `1 / s`, of the shape of `r2`."""
        return (r2 + self.scale**2).rsqrt()
