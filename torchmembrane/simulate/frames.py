"""Storage of simulated frames: their sensor, and each frame as PNG and npz or as a row of a Parquet data set."""

import io
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..errors import MembraneError
from ..files.atomic import make_folder, make_subfolder, whole_file, write_bytes
from ..files.images import read_pixels
from ..files.optional import load_pyarrow, load_pyav
from ..files.order import in_order
from ..files.parquet import read_table, refusal
from ..files.safe_read import DAMAGE, NUMBERS, TEXT, in_one_line, read_arrays, read_text
from ..files.system_files import is_of_system
from ..results.npz import save_frame
from .simulator import SimulatedFrame, Simulator

SENSOR, SETTINGS, REST = "sensor.toml", "simulation.json", "rest_truth.npz"
CONSTANT = ("dots_nominal", "uv_nominal", "visible_nominal", "vertices_nominal", "triangles", "p0")
A_PART, AS_WRITTEN = "a part of simulated frames", "the file as it was written: delete it and simulate its frames again"
A_TRUTH = "the truth of simulated frames"
MOST_SETTINGS_BYTES = 2**20
PART_ROWS = 64
FORMATS = ("png", "parquet")


class SimulatedFrames:
    """Frames stored as NAME.png and NAME_truth.npz in a folder; if views have separate images, as one NAME_VIEW.png each.

    Args:
        folder: an existing folder.
        views: names of the views that have separate images, if there are several.
    """

    def __init__(self, folder: Path, views: Sequence[str] = ()) -> None:
        self.folder, self.views = folder, views

    def names(self) -> set[str]:
        """Return the names of the stored frames."""
        found = {path.name.removesuffix("_truth.npz") for path in self.folder.glob("*_truth.npz") if not is_of_system(path)}
        return {name for name in found if all(path.exists() for path in self.images(name))}

    def images(self, name: str) -> list[Path]:
        """Return the image files of a frame."""
        return [self.folder / file for file in image_files(name, self.views)]

    def write(self, name: str, frame: SimulatedFrame) -> None:
        """Write a frame's images and truth."""
        for path, image in zip(self.images(name), (frame.image, *frame.further), strict=True):
            write_bytes(path, png(image))
        self.write_truth(name, frame)

    def write_truth(self, name: str, frame: SimulatedFrame) -> None:
        """Write only a frame's truth."""
        save_frame(self.folder / f"{name}_truth.npz", frame.truth)

    def flush(self) -> None:
        """Do nothing: frames are not buffered."""

    def __iter__(self) -> Iterator[tuple[str, SimulatedFrame]]:
        """Yield names and frames in name order."""
        for name in sorted(self.names(), key=in_order):
            truth = read_arrays(self.folder / f"{name}_truth.npz", None, A_TRUTH, NUMBERS + TEXT)
            first, *further = map(read_pixels, self.images(name))
            yield name, SimulatedFrame(first, {key: array.copy() for key, array in truth.items()}, tuple(further))


class SimulatedFrameTable(SimulatedFrames):
    """Frames stored as rows of `frames/part-*.parquet`: `name`, `image` (content of a PNG file) and the truth as flat lists.

    The schema's metadata contain the arrays' shapes (`shapes`) and the sensor's `[record]` (`record`), both as JSON. Arrays
    that are the same in all frames are in `rest_truth.npz`. Rows are buffered until `PART_ROWS` of them fill a file; `flush`
    writes the rest.

    Args:
        folder: an existing folder.
        record: record of the sensor, as in `Record.text`.
    """

    def __init__(self, folder: Path, record: str = "") -> None:
        super().__init__(folder)
        self.record = record
        self.arrow, self.parquet = load_pyarrow()
        self.waiting: dict[str, SimulatedFrame] = {}

    def names(self) -> set[str]:
        parts = (read_table(part, A_PART, AS_WRITTEN, ["name"])["name"].to_pylist() for part in self._parts())
        return {name for part in parts for name in part} | set(self.waiting)

    def write(self, name: str, frame: SimulatedFrame) -> None:
        self.waiting[name] = frame
        if not (self.folder / REST).exists():
            save_frame(self.folder / REST, {key: frame.truth[key] for key in CONSTANT})
        if len(self.waiting) >= PART_ROWS:
            self.flush()

    def flush(self) -> None:
        if not self.waiting:
            return
        make_subfolder(self.folder / "frames")
        columns = {"name": list(self.waiting), "image": [png(frame.image) for frame in self.waiting.values()]}
        shapes = {}
        for key in next(iter(self.waiting.values())).truth.keys() - set(CONSTANT):
            values = np.stack([frame.truth[key] for frame in self.waiting.values()])
            shapes[key] = values.shape[1:]
            flat = self.arrow.array(values.ravel())
            size = int(np.prod(shapes[key]))
            columns[key] = self.arrow.FixedSizeListArray.from_arrays(flat, size) if shapes[key] else flat
        table = self.arrow.table(columns).replace_schema_metadata({"shapes": json.dumps(shapes), "record": self.record})
        part = self.folder / "frames" / f"part-{len(self._parts()):05d}.parquet"
        with whole_file(part) as partial:
            self.parquet.write_table(table, partial)
        self.waiting = {}

    def __iter__(self) -> Iterator[tuple[str, SimulatedFrame]]:
        constant = read_arrays(self.folder / REST, None, A_TRUTH, NUMBERS + TEXT)
        for part in self._parts():
            table = read_table(part, A_PART, AS_WRITTEN)
            try:
                shapes = json.loads(table.schema.metadata[b"shapes"])
                rows = [(row, _truth(row, shapes)) for row in table.to_pylist()]
                frames = [(row["name"], read_pixels(f"{part}: {row['name']}", row["image"]), truth) for row, truth in rows]
            except DAMAGE as error:
                raise refusal(part, A_PART, AS_WRITTEN, error) from error
            for name, image, truth in frames:
                yield name, SimulatedFrame(image, truth | constant)

    def _parts(self) -> list[Path]:
        return sorted((self.folder / "frames").glob("part-*.parquet"), key=in_order)


def _truth(row: dict[str, Any], shapes: dict[str, list[int]]) -> dict[str, np.ndarray]:
    truth = {key: np.asarray(row[key]).reshape(shape) for key, shape in shapes.items()}
    return {key: a.astype(np.float32) if a.dtype.kind == "f" else a for key, a in truth.items()}


@contextmanager
def video_file(path: Path, rate: int = 25) -> Iterator[Callable[[np.ndarray], None]]:
    """Write an H.264 video image by image; the file appears only when it is complete.

    Args:
        path: path of the file, `.mp4`.
        rate: images per second.

    Yields:
        A function that takes the next image, `[H, W]` uint8, all of one size; it must be called at least once.
    """
    av = load_pyav()
    stream: Any = None
    with whole_file(path) as partial, av.open(str(partial), "w", format="mp4") as container:

        def add(image: np.ndarray) -> None:
            nonlocal stream
            if stream is None:
                stream = container.add_stream("libx264", rate=rate, options={"crf": "10"})
                stream.height, stream.width = image.shape
                stream.pix_fmt = "yuv420p" if all(side % 2 == 0 for side in image.shape) else "yuv444p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))

        yield add
        container.mux(stream.encode())


def open_frames(folder: Path, simulator: Simulator, settings: dict[str, Any], format: str = "png") -> SimulatedFrames:
    """Open the frames of a folder, which is created if necessary, with the simulated sensor and its rest image.

    Args:
        folder: a new folder, or one of the same simulation.
        simulator: simulator of the frames.
        settings: other settings that all frames share; they are stored in the folder.
        format: "png" or "parquet".

    Raises:
        MembraneError: the folder was made with another sensor, appearance or `settings`, or has other contents.
    """
    if format == "parquet" and simulator.sensor.views_apart:
        raise MembraneError("--format parquet: views with images of their own; expected --format png, or regions of one image")
    settings = settings | {"sensor": simulator.sensor.fingerprint, "grid": list(simulator.grid), "format": format}
    settings = json.loads(json.dumps(settings | asdict(simulator.appearance) | simulator.pattern.described()))
    _check(folder, settings)
    if not (folder / SETTINGS).exists():
        make_folder(folder)
        simulator.at_rest().to_file(folder / SENSOR)
        write_bytes(folder / SETTINGS, json.dumps(settings, indent=1).encode())
    if format == "parquet":
        return SimulatedFrameTable(folder, simulator.sensor.record.text)
    return SimulatedFrames(folder, simulator.sensor.views_apart)


def image_files(name: str, views: Sequence[str]) -> list[str]:
    """Return the names of a frame's image files.

    Example:
        >>> image_files("press", ()), image_files("press", ("left", "right"))
        (['press.png'], ['press_left.png', 'press_right.png'])
    """
    return [f"{name}_{view}.png" for view in views] or [f"{name}.png"]


def png(image: np.ndarray) -> bytes:
    """Encode an image `[H, W]` uint8 as the content of a PNG file.

    Example:
        >>> png(np.zeros((2, 3), np.uint8))[1:4]
        b'PNG'
    """
    file = io.BytesIO()
    Image.fromarray(image).save(file, "png")
    return file.getvalue()


def _check(folder: Path, settings: dict[str, Any]) -> None:
    """Refuse a folder that was made with other settings."""
    if folder.exists() and not folder.is_dir():
        raise MembraneError(f"--out {folder}: is a file; expected a folder, new or of earlier simulations of this sensor")
    if not (folder / SETTINGS).exists():
        if not all(map(is_of_system, folder.glob("*.npz"))) or (folder / SENSOR).exists():
            raise MembraneError(f"--out {folder}: holds other files (.npz, {SENSOR}) and no {SETTINGS}; choose another folder")
        return
    try:
        before = dict(json.loads(read_text(folder / SETTINGS, MOST_SETTINGS_BYTES, "settings of `torchmembrane simulate`")))
        if missing := {"sensor", "grid"} - before.keys():
            raise ValueError(f"it does not state {min(missing)}")
    except DAMAGE as error:
        said = in_one_line(str(error).removeprefix(f"{folder / SETTINGS}: "))
        raise MembraneError(f"{folder / SETTINGS}: not readable ({said}); expected another folder") from error
    for key, value in settings.items():
        if before.get(key, value) != value:
            raise MembraneError(
                f"--out {folder}: was made with {key} {in_one_line(before[key])}, this call has {value}; choose another folder"
            )
