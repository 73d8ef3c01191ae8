"""3-D shape of a deformable membrane from one image of its markings: geometry, elasticity, equilibrium.

The names below are loaded when they are first used: the import alone loads no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .errors import MembraneError

if TYPE_CHECKING:
    from .io.read import Results, read_results
    from .io.results import STATUS_TEXTS, Reconstruction

__version__ = "0.1.0"
__all__ = ["MembraneError", "Reconstruction", "Results", "STATUS_TEXTS", "__version__", "read_results"]

_MODULE_OF = {
    "Reconstruction": ".io.results",
    "Results": ".io.read",
    "STATUS_TEXTS": ".io.results",
    "read_results": ".io.read",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name], __name__), name)
