"""Markers located by soft-argmax of responses, built of kornia's operators and differentiable throughout."""

from .locator import SoftLocator
from .texture import SoftTextureLocator

__all__ = ["SoftLocator", "SoftTextureLocator"]
