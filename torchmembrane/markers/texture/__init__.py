"""Markers that are patches of texture: chosen in the rest image, followed into every other."""

from .locator import TextureLocator
from .patches import choose_patches

__all__ = ["TextureLocator", "choose_patches"]
