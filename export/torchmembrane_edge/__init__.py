"""Runs the models that `torchmembrane export` writes, with numpy and onnxruntime alone."""

from .errors import EdgeError
from .session import Session

__all__ = ["EdgeError", "Session"]
__version__ = "0.1.0"
