"""The worker of a job: it turns frames into rows of results, independently of the engine that distributes the work."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError, expect
from ..files.levels import too_few_bits
from ..files.provenance import SourceFile, printable
from ..files.safe_read import in_one_line
from ..results.npz import Stored
from ..results.reconstruction import Frame, Reconstruction
from ..results.status import Status
from ..results.summary import UNREADABLE
from ..results.view_status import status_in_words
from .decode import DecodedFrame, Source, decoded, source_of
from .inputs import frame_name

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor


Gauge: TypeAlias = Mapping[str, float] | Callable[[str, float], float]
"""Gauge readings of the pressure across the membrane: by frame name, or as a function of name and time (s); NaN: no reading."""


class Outcome(NamedTuple):
    """The outcome of a frame: its result with a remark on its status, or the reason why its image could not be read."""

    name: str
    file: Path
    stored: Stored | None
    reason: str = ""

    @property
    def status(self) -> int:
        """Return the status of the result, or `UNREADABLE`."""
        return UNREADABLE if self.stored is None else int(self.stored.frame["status"])

    @property
    def status_text(self) -> str:
        """Return the status in words."""
        return self.reason if self.stored is None else f"{Status(self.status).text}{self.reason}"


class FrameReconstructor:
    """A `Reconstructor` in the form that cluster engines such as Ray expect: built once per worker, called with batches of
    rows.

    It can be pickled.

    Args:
        reconstructor: reconstructor of the sensor.
        rest_pixels: markers at rest in this recording, `[D, 2]` px; default: those of the sensor's rest image.
        pressure: gauge readings by frame name, or a function of name and time (s); units as for `Reconstructor`.
        fields: surface fields to store in the frames, as in `Reconstructor.fields`: "stretch", "tension".

    Example:
        >>> from dataclasses import replace
        >>> from torchmembrane import Reconstructor, Sensor
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> sensor = replace(sensor, markers=replace(sensor.markers, rest_image=None))  # quicker, less accurate
        >>> rows = FrameReconstructor(Reconstructor(sensor))({"path": np.array(["examples/rest.png", "none.png"])})
        >>> rows["name"].tolist(), rows["status"].tolist(), rows["vertices"].shape
        (['rest', 'none'], [0, -1], (2, 1089, 3))
    """

    def __init__(
        self,
        reconstructor: "Reconstructor",
        rest_pixels: Tensor | None = None,
        pressure: Gauge | None = None,
        fields: Sequence[str] = (),
    ):
        if not hasattr(reconstructor, "rest_pixels"):
            raise MembraneError(f"FrameReconstructor: reconstructor is a {_kind(reconstructor)}; expected a tm.Reconstructor")
        self.reconstructor, self.rest_pixels, self.pressure, self.fields = reconstructor, rest_pixels, pressure, fields

    def on_device(self, device: str) -> "FrameReconstructor":
        """Return a copy on a device, "cpu" or "cuda"."""
        rest_pixels = None if self.rest_pixels is None else self.rest_pixels.to(device)
        return FrameReconstructor(self.reconstructor.to(device), rest_pixels, self.pressure, self.fields)

    def __call__(self, rows: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Reconstruct a batch of rows.

        Args:
            rows: columns of a dict or a `pandas.DataFrame`: `path [B]`, the image files, whose names are the frame names. The
                files are read here, unless `image [B, ...]` holds the decoded images, one per row, as `Reconstructor` takes
                them, or `bytes [B]` holds the content of the files.

        Returns:
            Columns of B rows: `name`, `path`, `status`, `status_text`, the arrays of `Reconstruction`, `content_hash`, size and
            modification time of the file, `seconds`. A file without a readable image has status -1, the reason as text, and
            NaN.

        Raises:
            MembraneError: `rows` has no column `path`, has columns of different lengths, or is neither a dict nor a DataFrame.
        """
        outcomes = self.outcomes([self._frame(*row) for row in _rows(rows)])
        stored = [outcome.stored or Stored(self._blank, SourceFile(printable(str(outcome.file)))) for outcome in outcomes]
        arrays = [each.arrays() for each in stored or [Stored(self._blank)]]
        found = {key: np.stack([row[key] for row in arrays])[: len(stored)] for key in arrays[0]}
        words = {key: np.array([getattr(outcome, key) for outcome in outcomes], str) for key in ("name", "status_text")}
        return words | found

    def outcomes(self, group: list[DecodedFrame]) -> list[Outcome]:
        """Return the outcome of each frame of a batch."""
        start = time.perf_counter()
        readable = [frame for frame in group if frame.image is not None]
        frames = iter(self._reconstructed(readable))
        seconds = (time.perf_counter() - start) / max(len(readable), 1)
        return [
            Outcome(frame.name, frame.file, None, frame.reason)
            if frame.image is None
            else self._outcome(frame, frame.image, Stored(next(frames), self._measured(frame), seconds))
            for frame in group
        ]

    def _outcome(self, frame: DecodedFrame, image: Tensor, stored: Stored) -> Outcome:
        """Return a frame's outcome, with a remark if a view was left out or if the values are too low."""
        status = Status(int(stored.frame["status"]))
        words = status_in_words(stored.frame, [view.name for view in self.reconstructor.sensor.views], frame.lacking)
        remark = words.removeprefix(status.text) if status.has_surface else too_few_bits(image.cpu().numpy())
        return Outcome(frame.name, frame.file, stored, remark)

    def _frame(self, path: object, image: Any, content: Any) -> DecodedFrame:
        file = Path(str(path))
        if image is None and content is None:
            return self.decoded(source_of(file))
        frame = DecodedFrame(frame_name(file), file, None)
        try:
            if content is None:
                image = _array(image)
                data, grey = np.ascontiguousarray(image).tobytes(), self._grey(image)
            else:
                if not isinstance(content, bytes | bytearray | memoryview):
                    raise MembraneError(f"bytes are a {_kind(content)}; expected bytes, the content of the file")
                data = bytes(content)
                grey = self._read(data)
            return frame._replace(image=grey, origin=SourceFile.of_bytes(file, data))
        except MembraneError as error:
            return frame.but(error)

    def _grey(self, image: np.ndarray) -> Tensor:
        """Return the grey image of a row; its first axis may be the colour axis."""
        grey = self.reconstructor.grey(image[None] if image.ndim == 3 else image)
        expect(len(grey) == 1, "image", list(image.shape), "one image a row")
        return grey

    def _read(self, content: bytes) -> Tensor:
        with NamedTemporaryFile() as file:
            file.write(content)
            file.flush()
            try:
                return self.reconstructor.read(file.name)
            except MembraneError as error:
                raise MembraneError(str(error).removeprefix(f"{file.name}: ")) from error

    def decoded(self, source: Source) -> DecodedFrame:
        """Decode a frame: return its image, or the reason why there is none."""
        return decoded(source, self.reconstructor)

    @torch.no_grad()
    def _reconstructed(self, group: list[DecodedFrame]) -> list[Frame]:
        images = [frame.image for frame in group if frame.image is not None]
        if not images:
            return []
        options: dict[str, Any] = {} if self.rest_pixels is None else {"rest_pixels": self.rest_pixels}
        if self.pressure is not None:
            readings = [self.reading(frame.name, frame.origin.time) for frame in group]
            options["pressure"] = torch.tensor(readings, dtype=torch.float64, device="cpu")
        computed = self.reconstructor(torch.cat(images), **options)
        results = Reconstruction(*(field.cpu() for field in computed))
        fields = self.reconstructor.fields(computed, self.fields) if self.fields else {}
        arrays = {name: values.cpu().numpy().astype(np.float32) for name, values in fields.items()}
        return [results.frame(i) | {name: values[i] for name, values in arrays.items()} for i in range(len(images))]

    def _measured(self, frame: DecodedFrame) -> SourceFile:
        """Return a frame's provenance, including the gauge reading."""
        return frame.origin._replace(gauge=float(self.reading(frame.name, frame.origin.time)))

    def reading(self, name: str, time: float) -> float:
        """Return the gauge reading of a frame, or NaN; `time`: that of its `SourceFile`."""
        if callable(self.pressure):
            return self.pressure(name, time)
        return torch.nan if self.pressure is None else self.pressure.get(name, torch.nan)

    @cached_property
    def _blank(self) -> Frame:
        """The empty result for a file whose image could not be read."""
        width, height = self.reconstructor.image_size
        channels = max(1, len(self.reconstructor.sensor.views_apart))
        image = self.reconstructor.rest_pixels.new_zeros(1, channels, height, width)
        (frame,) = self._reconstructed([DecodedFrame("", Path(), image)])
        return frame | {"status": np.array(UNREADABLE, np.int32)}


def _rows(columns: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Yield path, image and content of every row; None for a column that is missing."""
    if not (isinstance(columns, Mapping) or (hasattr(columns, "iloc") and hasattr(columns, "columns"))):
        raise MembraneError(
            f"FrameReconstructor: rows are a {_kind(columns)}; expected a dict of arrays or a pandas.DataFrame: in Ray, "
            'map_batches(..., batch_format="numpy")'
        )
    if alone := [key for key in columns if not _is_column(columns[key])]:
        raise MembraneError(
            f"FrameReconstructor: column {alone[0]} is a {_kind(columns[alone[0]])}; expected a list or an array of one value "
            "per row: in Ray, use map_batches in place of map"
        )
    lengths = {str(key): len(columns[key]) for key in columns}
    count = max(lengths.values(), default=0)
    if count and "path" not in lengths:
        raise MembraneError(
            f"FrameReconstructor: columns {', '.join(lengths)}; expected a column path, which names the frames: in Ray, "
            "read_images(..., include_paths=True)"
        )
    if min(lengths.values(), default=0) < count:
        raise MembraneError(f"FrameReconstructor: columns of different lengths, {lengths}; expected one value per row in each")
    none = [None] * count
    return zip(*(columns[key] if key in columns else none for key in ("path", "image", "bytes")), strict=True)


def _kind(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}".removeprefix("builtins.")


def _is_column(value: Any) -> bool:
    return hasattr(value, "__len__") and not isinstance(value, str | bytes) and getattr(value, "shape", None) != ()


def _array(image: Any) -> np.ndarray:
    """Return a row's image as an array."""
    try:
        return np.asarray(image)
    except (ValueError, TypeError, RuntimeError) as error:
        raise MembraneError(f"image is a {_kind(image)}, not an array ({in_one_line(error)})") from error


def outcomes_of(rows: dict[str, np.ndarray]) -> list[Outcome]:
    """Convert the columns returned by `FrameReconstructor` to one outcome per frame."""
    frames = [dict(zip(rows, values, strict=True)) for values in zip(*rows.values(), strict=True)]
    outcomes = []
    for frame in frames:
        name, file, text = str(frame["name"]), Path(str(frame["path"])), str(frame["status_text"])
        if frame["status"] == UNREADABLE:
            outcomes.append(Outcome(name, file, None, text))
        else:
            remark = text.removeprefix(Status(int(frame["status"])).text)
            outcomes.append(Outcome(name, file, Stored.from_arrays(frame), remark))
    return outcomes
