"""Results of a folder drawn as a film: `view --video-out`, `reconstruct --video-out`."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from ..results.read import Results
    from ..results.store import Mesh

DEFAULT_RATE = 10.0
"""Frames per second."""
MOST_FRAMES = 100
"""On a sheet: of more, as many are chosen evenly."""


class FrameImages:
    """The images of frames, by name.

    Args:
        files: of those that there are.
        mesh: of the results, which says how large they must be, and which part of them the first view is.
        bits: bits of the camera, where it is known that 16-bit files hold fewer.
    """

    def __init__(self, files: Mapping[str, Path], mesh: "Mesh", bits: int | None = None):
        self.files, self.mesh, self.bits = files, mesh, bits

    def named(self, name: str) -> "np.ndarray | None":
        """Grey values `[height, width]` in 0..1, of several views the first one's; or None."""
        from ..files.images import read_image

        if name not in self.files:
            return None
        return self.mesh.first_region(read_image(self.files[name], self.mesh.file_size, self.bits))


def images_in(folder: Path) -> dict[str, Path]:
    """The image files of a folder by the names of their frames; none if there is no such folder."""
    from ..files.system_files import is_hidden
    from ..jobs.inputs import IMAGES, frame_name

    found = folder.iterdir() if folder.is_dir() else ()
    return {frame_name(path): path for path in found if path.suffix.lower() in IMAGES and not is_hidden(path)}


def draw_film(results: "Results", images: FrameImages, path: Path, rate: float = DEFAULT_RATE) -> None:
    """Draw all frames, in name order, and say so."""
    from tqdm import tqdm

    from ..plot.film import check_film, picture_of, write_film
    from ..plot.frames import figure

    check_film(path, rate)
    named = zip(results.names, tqdm(results, unit="frame", desc="draw"), strict=True)
    count = 4 if any(bool(frame["traction"].any()) for frame in results) else 3
    drawn = (figure(frame, results.mesh, images.named(name), name, count) for name, frame in named)
    write_film(path, map(picture_of, drawn), rate)
    print(f"{len(results)} frames drawn in {path}")


def draw_sheet(results: "Results", images: FrameImages, path: Path) -> None:
    """Draw all frames, or `MOST_FRAMES` of them, small on one sheet, and say so."""
    from ..files.order import evenly
    from ..plot.files import save
    from ..plot.sheet import sheet_figure

    names = evenly(results.names, MOST_FRAMES)
    chosen = {name: (results[name], images.named(name)) for name in names}
    save(sheet_figure(chosen, results.mesh), path, "view")
    print(f"{len(names)} of {len(results)} frames drawn in {path}")
