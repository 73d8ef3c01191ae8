"""Markers located by soft-argmax of responses, built of kornia's operators: piecewise differentiable."""

from .locator import SoftLocator
from .texture import SoftTextureLocator

__all__ = ["SoftLocator", "SoftTextureLocator"]
