"""Markers located by soft-argmax of filter responses, with kornia's operators: piecewise differentiable."""

from .locator import SoftLocator
from .texture import SoftTextureLocator

__all__ = ["SoftLocator", "SoftTextureLocator"]
