"""3-D shape of a deformable membrane from one image of its markings: geometry, elasticity, equilibrium."""

from .errors import MembraneError
from .io.results import STATUS_TEXTS, Reconstruction

__version__ = "0.1.0"
__all__ = ["MembraneError", "Reconstruction", "STATUS_TEXTS", "__version__"]
