"""Robust losses of iteratively reweighted least squares (IRLS), as functions of a squared residual `r2 = r^2`.

Each has `loss(r2)` and the weight `loss'(r) / r = 2 d loss / d r2` of the parabola that touches it there. Near zero all are
`r^2 / 2` (the pseudo-Huber times its own weight there), so that a scale that goes from large to small is graduated
non-convexity (GNC): the problem begins quadratic.

Reference: Barron 2019, A general and adaptive robust loss function; Blake and Zisserman 1987, Visual reconstruction.
"""

from typing import Any, NamedTuple, TypeVar

from torch import Tensor

Scalar = TypeVar("Scalar", float, Tensor)


def geman_mcclure_weight(ratio: Scalar) -> Scalar:
    """`loss'(r) / r` of Geman and McClure's loss, from `ratio = r^2 / s^2`, `[...]`; in 0..1.

    Example:
        >>> geman_mcclure_weight(1.0)
        0.25
    """
    weight: Scalar = (1 + ratio) ** -2
    return weight


def geman_mcclure_curvature(ratio: Scalar) -> Scalar:
    """`loss''(r)` of Geman and McClure's loss, from `ratio = r^2 / s^2`, `[...]`; negative beyond `ratio = 1/3`.

    Example:
        >>> geman_mcclure_curvature(1.0)
        -0.25
    """
    curvature: Scalar = (1 - 3 * ratio) / (1 + ratio) ** 3
    return curvature


def geman_mcclure_loss(r2: Scalar, scale: Any) -> Scalar:
    """Geman and McClure's loss of `r^2 [...]` at a scale `s`, a number or a tensor `[]`.

    Example:
        >>> geman_mcclure_loss(4.0, 2.0)
        1.0
    """
    loss: Scalar = r2 / (2 + 2 * r2 / scale**2)
    return loss


class GemanMcClure(NamedTuple):
    """`r^2 / (2 (1 + r^2 / s^2))`: saturates at `s^2 / 2`, what lies far out has no more weight.

    Args:
        scale: `s`, a number or a tensor `[]`.

    Example:
        >>> import torch
        >>> GemanMcClure(2.0).loss(torch.tensor(4.0)), GemanMcClure(2.0).weight(torch.tensor(4.0))
        (tensor(1.), tensor(0.2500))
    """

    scale: float | Tensor

    def loss(self, r2: Tensor) -> Tensor:
        """The loss, of the shape of `r2`."""
        return geman_mcclure_loss(r2, self.scale)

    def weight(self, r2: Tensor) -> Tensor:
        """The weight, of the shape of `r2`, in 0..1."""
        return geman_mcclure_weight(r2 / self.scale**2)

    def curvature(self, r2: Tensor) -> Tensor:
        """The second derivative in `r`, zero where it is negative."""
        return geman_mcclure_curvature(r2 / self.scale**2).clamp_min(0)


class Cauchy(NamedTuple):
    """`s^2 / 2 log(1 + r^2 / s^2)`: grows ever more slowly, an outlier pulls less the farther it is.

    Args:
        scale: `s`, a number or a tensor `[]`.

    Example:
        >>> import torch
        >>> Cauchy(2.0).weight(torch.tensor([0.0, 4.0]))
        tensor([1.0000, 0.5000])
    """

    scale: float | Tensor

    def loss(self, r2: Tensor) -> Tensor:
        """The loss, of the shape of `r2`."""
        return self.scale**2 / 2 * (r2 / self.scale**2).log1p()

    def weight(self, r2: Tensor) -> Tensor:
        """The weight, of the shape of `r2`, in 0..1."""
        return 1 / (1 + r2 / self.scale**2)


class PseudoHuber(NamedTuple):
    """`sqrt(r^2 + s^2) - s`: quadratic below `s`, `|r|` above.

    Args:
        scale: `s`, a number or a tensor `[]`.

    Example:
        >>> import torch
        >>> PseudoHuber(3.0).loss(torch.tensor(16.0)), PseudoHuber(3.0).weight(torch.tensor(16.0))
        (tensor(2.), tensor(0.2000))
    """

    scale: float | Tensor

    def loss(self, r2: Tensor) -> Tensor:
        """The loss, of the shape of `r2`."""
        return (r2 + self.scale**2).sqrt() - self.scale

    def weight(self, r2: Tensor) -> Tensor:
        """The weight, of the shape of `r2`, at most `1 / s`."""
        return (r2 + self.scale**2).rsqrt()
