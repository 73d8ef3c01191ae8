"""Texture patches as markers: chosen in the rest image and located in all other images."""

from .locator import TextureLocator
from .patches import choose_patches

__all__ = ["TextureLocator", "choose_patches"]
