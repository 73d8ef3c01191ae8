"""Files in, results out."""

from .frame_reconstructor import FrameReconstructor

__all__ = ["FrameReconstructor"]
