"""A sequence of figures as a video or an animated GIF."""

from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from ..errors import MembraneError
from ..files.atomic import make_folder, whole_file
from ..files.optional import load_pyav
from ..files.video import ffmpeg_name

VIDEOS = {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska"}
COLOURS = 256
"""Number of colours of a GIF."""
RATES, GIF_RATES = (0.001, 1000.0), (0.002, 50.0)
"""Hz, least and greatest, that the formats hold and viewers keep; a GIF counts hundredths of a second, up to 655.35 s."""


def picture_of(drawing: Figure) -> np.ndarray:
    """Return the pixels of a figure, RGB `[height, width, 3]` uint8.

    Example:
        >>> picture_of(Figure(figsize=(2, 1), dpi=100)).shape
        (100, 200, 3)
    """
    canvas = FigureCanvasAgg(drawing)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def check_film(path: Path, rate: float = 1.0) -> None:
    """Refuse a file name that is neither a video's nor a GIF's, a rate that the format cannot have, and a video if PyAV is
    missing.

    Raises:
        MembraneError: the suffix or rate is unsupported, or PyAV is not installed.
    """
    is_gif = path.suffix.lower() == ".gif"
    if not is_gif and path.suffix.lower() not in VIDEOS:
        raise MembraneError(f"{path}: expected a film's name, ending in .gif, {', '.join(VIDEOS)}")
    least, most = GIF_RATES if is_gif else RATES
    if not least <= rate <= most:
        raise MembraneError(
            f"{path}: {rate:g} pictures a second; expected {least:g} to {most:g} of a {path.suffix.lower()[1:]}"
        )
    if not is_gif:
        load_pyav()


def write_film(path: str | Path, pictures: Iterable[np.ndarray], rate: float, last: float = 0.0) -> None:
    """Write pictures as a film, atomically.

    Args:
        path: `.gif`, or a video (H.264): `.mp4`, `.mov`, `.mkv`; its folder is created if needed.
        pictures: RGB `[height, width, 3]` uint8, at least one, all of the same size.
        rate: pictures per second.
        last: additional seconds for which a GIF shows the last picture before it starts again.

    Raises:
        MembraneError: the suffix or rate is unsupported, there is no picture, sizes differ, or PyAV is not installed.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     write_film(f"{folder}/grey.gif", [np.full((8, 8, 3), 60 * k, np.uint8) for k in range(3)], rate=10)
        ...     Image.open(f"{folder}/grey.gif").n_frames
        3
    """
    path = Path(path)
    check_film(path, rate)
    make_folder(path.parent)
    checked = _checked(path, iter(pictures))
    with whole_file(path) as partial:
        if path.suffix.lower() == ".gif":
            _write_gif(partial, checked, rate, last)
        else:
            _write_video(partial, VIDEOS[path.suffix.lower()], checked, rate)


def _checked(path: Path, pictures: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    first = next(pictures, None)
    if first is None:
        raise MembraneError(f"{path}: no pictures; expected one at least")
    for picture in chain([first], pictures):
        if picture.shape != first.shape:
            raise MembraneError(f"{path}: a picture {list(picture.shape)} after one {list(first.shape)}; expected one size")
        yield picture


def _write_gif(path: Path, pictures: Iterator[np.ndarray], rate: float, last: float) -> None:
    frames = [Image.fromarray(picture).quantize(COLOURS, dither=Image.Dither.NONE) for picture in pictures]
    times = [1000 / rate] * (len(frames) - 1) + [1000 / rate + 1000 * last]
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=times, loop=0, optimize=True)


def _write_video(path: Path, container_format: str, pictures: Iterator[np.ndarray], rate: float) -> None:
    av, first = load_pyav(), next(pictures)
    height, width = (size - size % 2 for size in first.shape[:2])  # H.264 takes even sizes
    with av.open(ffmpeg_name(path), "w", format=container_format) as container:
        track = container.add_stream("h264", rate=Fraction(rate).limit_denominator(1000))
        track.width, track.height, track.pix_fmt = width, height, "yuv420p"
        for picture in chain([first], pictures):
            even = np.ascontiguousarray(picture[:height, :width])
            container.mux(track.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
        container.mux(track.encode())
