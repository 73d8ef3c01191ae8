"""Run the models that `torchmembrane export` writes, with only numpy and onnxruntime."""

__version__ = "0.2.0"

from .errors import EdgeError
from .session import Session

__all__ = ["EdgeError", "Session"]
