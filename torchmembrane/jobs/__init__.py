"""Jobs: many image files reconstructed to folders of results."""

from .frame_reconstructor import FrameReconstructor

__all__ = ["FrameReconstructor"]
