"""Markers that are dots, of one size or two: found in the rest image, located in every other."""

from .locator import DotLocator
from .pattern import DotPattern, find_dots, measure_dots

__all__ = ["DotLocator", "DotPattern", "find_dots", "measure_dots"]
