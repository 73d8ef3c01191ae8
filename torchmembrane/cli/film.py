"""Films and contact sheets of the results in a folder: `view --video-out`, `reconstruct --video-out`."""

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
"""Largest number of frames on a sheet; of more frames, as many are chosen evenly."""


class FrameImages:
    """The images of frames, by name.

    Args:
        files: the existing image files, by frame name; for several views, NAME_VIEW of the first view also
            stands for NAME, the name of the frame in a recording.
        mesh: mesh of the results, which gives the image size and the part that the first view sees.
        bits: bit depth of the camera, if 16-bit files are known to use fewer bits.
    """

    def __init__(self, files: Mapping[str, Path], mesh: "Mesh", bits: int | None = None):
        first = f"_{mesh.view_names.partition(' ')[0]}"
        bare = {name.removesuffix(first): path for name, path in files.items() if mesh.view_names and name.endswith(first)}
        self.files, self.mesh, self.bits = bare | dict(files), mesh, bits

    def named(self, name: str) -> "np.ndarray | None":
        """Return grey values `[height, width]` in 0..1, for several views those of the first; None if there is no image."""
        from ..files.images import read_image

        if name not in self.files:
            return None
        return self.mesh.first_region(read_image(self.files[name], self.mesh.file_size, self.bits))


def images_in(folder: Path) -> dict[str, Path]:
    """Return the image files of a folder by the names of their frames; empty if there is no such folder."""
    from ..files.images import IMAGES
    from ..files.system_files import is_hidden
    from ..jobs.inputs import frame_name

    found = folder.iterdir() if folder.is_dir() else ()
    return {frame_name(path): path for path in found if path.suffix.lower() in IMAGES and not is_hidden(path)}


def draw_film(results: "Results", images: FrameImages, path: Path, rate: float = DEFAULT_RATE) -> None:
    """Draw all frames as a film, in name order, and print the path."""
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
    """Draw all frames, or `MOST_FRAMES` of them, in small size on one sheet, and print the path."""
    from ..files.order import evenly
    from ..plot.files import save
    from ..plot.sheet import sheet_figure

    names = evenly(results.names, MOST_FRAMES)
    chosen = {name: (results[name], images.named(name)) for name in names}
    save(sheet_figure(chosen, results.mesh), path, "view")
    print(f"{len(names)} of {len(results)} frames drawn in {path}")
