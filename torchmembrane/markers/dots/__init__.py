"""Markers that are dots of one or two sizes: found in the rest image, and located in every other image."""

from .locator import DotLocator
from .pattern import DotPattern, find_dots, measure_dots

__all__ = ["DotLocator", "DotPattern", "find_dots", "measure_dots"]
