"""Jobs: reconstruction of many image files into folders of results."""

from .frame_reconstructor import FrameReconstructor

__all__ = ["FrameReconstructor"]
