"""Run a model: from images to results."""

from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from .errors import EdgeError, in_one_line, printable
from .metadata import EXPECTED, Metadata

GREY = (0.299, 0.587, 0.114)
SHAPES = "[H, W], [H, W, 3], [B, H, W], [B, 1 | 3, H, W] or [B, H, W, 1 | 3]"
IMAGE = "image"
"""Name of the image input; for views with images of their own there is one input per view, `image_NAME`."""
TYPES = {"tensor(float)": np.float32, "tensor(int32)": np.int32}
NEEDED = ("vertices", "displacement", "force", "status")
"""Outputs that a result requires."""
PREVIOUS = "previous_"
MOST_THREADS = 256
SEAL, DIGEST = b"2ISHA-256: ", 64  # the `doc_string` with which an exported file ends, and the characters that follow


class Session:
    """A model ready to run. Loading takes about 0.5 s per MB of the file on one core, because onnxruntime optimises the model.

    Arguments: `model`, the path of a file from `torchmembrane export`; `threads`, the number of onnxruntime's threads (1 is
        best for single frames); `providers`, those of onnxruntime, in order of preference.

    Attributes: `name` of the sensor, `length_unit`, `force_unit`, `status_texts` (code to text), `mesh` (the content of
        `mesh.npz`: rest_vertices, triangles, fixed ...), `image_size` (width, height), `tracks`: whether the model follows
        dots; `bits`: bit depth of the camera, if 16-bit images use fewer bits, else None; `views`: names of the views that have
        images of their own, empty for a single view or for regions of one image; `image_sizes`: the image size of each.

    Raises: `EdgeError`: the file does not exist, is not a model of `torchmembrane export`, or onnxruntime lacks a provider.
    """

    def __init__(self, model: str | Path, threads: int = 1, providers: Sequence[str] = ("CPUExecutionProvider",)):
        _refuse_providers(providers)
        if not isinstance(threads, int) or not 1 <= threads <= MOST_THREADS:
            raise EdgeError(f"threads {threads!r}; expected a whole number from 1 to {MOST_THREADS}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 4  # what is wrong is raised
        options.enable_mem_reuse = False  # planning it takes two thirds of the time for loading a model
        model = model_file(model)
        _refuse_damaged(Path(model))
        try:
            self._session = onnxruntime.InferenceSession(model, options, providers=list(providers))
            known = self._session.get_modelmeta().custom_metadata_map
        except Exception as error:  # onnxruntime's errors have no common base
            cause = f"onnxruntime {onnxruntime.__version__}: {in_one_line(error)}"
            raise EdgeError(f"{model}: not readable as a model ({cause}); expected {EXPECTED}") from error
        said = Metadata.from_properties(known, model)
        self.name, self.length_unit, self.force_unit, self.status_texts, self.mesh, self.bits = said
        self._outputs = {given.name: (TYPES.get(given.type), given.shape[1:]) for given in self._session.get_outputs()}
        inputs = {given.name: given.shape for given in self._session.get_inputs()}
        self._images = [name for name in inputs if name == IMAGE or name.startswith(f"{IMAGE}_")]
        self.views = tuple(name.removeprefix(f"{IMAGE}_") for name in self._images if name != IMAGE)
        self._state = {name: shape[1:] for name, shape in inputs.items() if name not in self._images}
        self.tracks = bool(self._state)
        if wrong := self._unlike([inputs[name] for name in self._images]):
            raise EdgeError(f"{model}: {wrong}; expected {EXPECTED}")
        self.image_sizes = [(inputs[name][3], inputs[name][2]) for name in self._images]
        self.image_size = self.image_sizes[0]

    def run(self, images: Any, previous: Mapping[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
        """Return the results of a batch by name, one row per frame: vertices `[B, V, 3]`, ..., status `[B]`.

        `images`: `[H, W]`, `[H, W, 3]`, `[B, H, W]`, `[B, 1 | 3, H, W]` or `[B, H, W, 1 | 3]`, grey or RGB; uint8, uint16 (with
        `bits` used bits) or float in 0..1. A frame that cannot be reconstructed has a status and NaN. For several `views`, a
        list with the images of each; a view without images is None, or NaN in single frames, and is left out. `previous`, for a
        tracking model: results of the previous frames, near which the dots are searched first.

        Raises `EdgeError`: the images have another shape, size or type, or `previous` holds results of other frames.
        """
        if missing := [name for name in NEEDED if name not in self._outputs]:
            raise EdgeError(f"the model of {self.name!r} gives no {missing[0]}; expected {EXPECTED}")
        feed = self._fed(images)
        count = len(feed[self._images[0]])
        if not count:
            return {name: np.zeros((0, *shape), dtype) for name, (dtype, shape) in self._outputs.items()}
        for key, shape in self._state.items():
            feed[key] = _state(key.removeprefix(PREVIOUS), (count, *shape), previous)
        try:
            results = dict(zip(self._outputs, self._session.run(None, feed), strict=True))
        except Exception as error:  # as above
            raise EdgeError(f"onnxruntime cannot run the model on {count} images ({in_one_line(error)})") from error
        if any(values.shape[:1] != (count,) for values in results.values()):
            raise EdgeError(f"the model of {self.name!r} does not return one row per image; expected {EXPECTED}")
        return results

    def _fed(self, images: Any) -> dict[str, np.ndarray]:
        """Return the model's image inputs, by name."""
        views = ", ".join(self.views)
        if self.views and not (isinstance(images, list | tuple) and len(images) == len(self.views)):
            raise EdgeError(f"images are not a list of {len(self.views)}; expected one with those of the views {views}")
        each = images if self.views else [images]
        parts = {
            name: grey(_arranged(_array(part), size), self.bits)[:, None]
            for name, part, size in zip(self._images, each, self.image_sizes, strict=True)
            if not (self.views and part is None)
        }
        counts = [len(part) for part in parts.values()]
        if len(set(counts)) != 1:
            raise EdgeError(f"{counts} images of the views {views}; expected the same number for each, for at least one view")
        blank = {
            name: np.full((counts[0], 1, height, width), np.nan, np.float32)
            for name, (width, height) in zip(self._images, self.image_sizes, strict=True)
        }
        return {name: parts.get(name, blank[name]) for name in self._images}

    def track(self, images: Any) -> Iterator[dict[str, np.ndarray]]:
        """Yield the results of a video's images one by one; the dots are tracked from each image to the next."""
        if not self.tracks:
            raise EdgeError(
                f"the model of {self.name!r} does not track; expected one of dots from `torchmembrane export --tracking`"
            )
        if not hasattr(images, "__iter__"):
            raise EdgeError(
                f"track: images are of type {type(images).__name__}; expected an iterable of a video's images, in their order"
            )
        previous = None
        for image in images:
            alone = [each if each is None else _array(each)[None] for each in image] if self.views else _array(image)[None]
            previous = self.run(alone, previous)
            yield previous

    def status_text(self, code: int) -> str:
        """Return the text of a status, even if the model has none for it."""
        return self.status_texts.get(int(code), f"status {int(code)}")

    def wrench_in_tool(self, results: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the wrench `[B, 6]` in the frame of the sensor's tool: force, and moment about that frame's origin."""
        pose = self.mesh["camera_in_tool"]
        if not len(pose):
            raise EdgeError(
                f"the model of {self.name!r} has no tool; expected a model of a sensor file with [tool]: export it again"
            )
        wrench = np.asarray(results.get("wrench") if isinstance(results, Mapping) else results)
        if wrench.ndim != 2 or wrench.shape[1] != 6 or wrench.dtype.kind != "f":
            raise EdgeError(f"a wrench of {wrench.dtype} {list(wrench.shape)}; expected results of `run`, with wrench [B, 6]")
        rotation, translation = pose[:, :3], pose[:, 3]
        force, moment = wrench[:, :3] @ rotation.T, wrench[:, 3:] @ rotation.T
        return np.concatenate([force, moment + np.cross(translation, force)], -1)

    def _unlike(self, images: Sequence[Sequence[Any]]) -> str:
        """Return in what the model differs from one of `torchmembrane export`; "" if it does not."""
        width, height = self.mesh["image_size"].tolist()
        whole = self.mesh["rest_pixels"].ndim == 3  # parts of it are the views, of which the mesh has the first one's size
        for image in images or [[]]:
            sized = len(image) == 4 and image[1] == 1 and all(isinstance(size, int) and size > 0 for size in image[2:])
            if not sized or not (whole or list(image[2:]) == [height, width]):
                return f"its image is {image or 'missing'}, not [batch, 1, {height}, {width}] as its mesh says"
        for name, (dtype, shape) in self._outputs.items():
            if dtype is None or not all(isinstance(size, int) for size in shape):
                return f"its output {name!r} is {dtype} {list(shape)}"
        for name, shape in self._state.items():
            if not name.startswith(PREVIOUS) or self._outputs.get(name.removeprefix(PREVIOUS)) != (np.float32, shape):
                return f"its input {name!r} {list(shape)} is none of its outputs"
        return ""


def model_file(model: str | Path) -> str:
    """Return the path of a model in the form that onnxruntime takes.

    Raises:
        EdgeError: the file does not exist.
    """
    if not isinstance(model, str | Path):
        raise EdgeError(f"model {type(model).__name__}; expected the path of a model from `torchmembrane export`")
    path = Path(model)
    if not path.is_file():
        cause = "a folder" if path.is_dir() else "no regular file" if path.exists() else "no such file"
        raise EdgeError(f"{printable(path)}: {cause}; expected a model from `torchmembrane export`, check the path")
    return str(path)


def _refuse_damaged(model: Path) -> None:
    """Refuse a file whose content does not match the hash at its end; a file without a hash is not checked."""
    content, seal, digest = model.read_bytes().rpartition(SEAL)
    if len(digest) == DIGEST and seal and sha256(content).hexdigest().encode() != digest:
        cause = "damaged, its SHA-256 digest is wrong; expected the file as it was exported: copy it again, or export it again"
        raise EdgeError(f"{printable(model)}: {cause}")


def grey(images: Any, bits: int | None = None) -> np.ndarray:
    """Convert images to grey values `[B, height, width]`, float32 in 0..1: 0.299 R + 0.587 G + 0.114 B.

    Arguments: `images`, `[height, width]`, `[B, height, width]` or `[B, height, width, 3]`; uint8, uint16 or float in 0..1;
    `bits`, the number of bits that uint16 values use (default: 16).
    """
    images = _array(images)
    if images.ndim == 2:
        images = images[None]
    if images.ndim not in (3, 4) or images.shape[3:] not in ((), (3,)):
        raise EdgeError(f"images {list(images.shape)}; expected {SHAPES}")
    white = 1.0
    if images.dtype.kind == "u" and images.dtype.itemsize <= 2:
        white = np.iinfo(images.dtype).max
        if bits and images.dtype.itemsize == 2:
            white = 2**bits - 1
            if (most := images.max(initial=0)) > white:
                raise EdgeError(f"values up to {most}; expected at most {white} for the {bits} bits that the model states")
    elif images.dtype.kind != "f":
        raise EdgeError(f"images of type {images.dtype}; expected uint8, uint16 or float in 0..1")
    if images.ndim == 4:
        images = sum(weight * images[..., c].astype(np.float64) for c, weight in enumerate(GREY))
    return (images.astype(np.float64) / white).astype(np.float32)


def _refuse_providers(providers: Sequence[str]) -> None:
    there = onnxruntime.get_available_providers()
    if isinstance(providers, str) or not all(isinstance(name, str) and name in there for name in providers):
        raise EdgeError(f"providers {providers!r}; expected a list of some of the providers of this onnxruntime, {there}")


def _array(images: Any) -> np.ndarray:
    try:
        return np.asarray(images)
    except (ValueError, TypeError, RuntimeError) as error:  # rows of different lengths; a tensor that requires gradients
        raise EdgeError(f"images are not an array ({in_one_line(error)}); expected {SHAPES}") from error


def _arranged(images: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return images as `[B, H, W]` or `[B, H, W, 3]`; `size` is width and height."""
    (width, height), shape = size, images.shape
    if shape[-2:] == (height, width) and images.ndim in (2, 3):
        return images.reshape(-1, height, width)
    if shape[-2:] == (height, width) and images.ndim == 4 and shape[1] in (1, 3):
        images = np.moveaxis(images, 1, -1)
    elif shape[-3:-1] != (height, width) or images.ndim not in (3, 4) or shape[-1] not in (1, 3):
        raise EdgeError(_refusal(shape, size))
    return images[..., 0].reshape(-1, height, width) if images.shape[-1] == 1 else images.reshape(-1, height, width, 3)


def _refusal(shape: tuple[int, ...], size: tuple[int, int]) -> str:
    width, height = size
    said = f"images {list(shape)}; expected {SHAPES} with H = {height}, W = {width}"
    given = shape[-3:-1] if shape[-1:] in ((1,), (3,)) else shape[-2:]
    if len(given) < 2:
        return said
    if (height, width) in (shape[-2:], shape[-3:-1]):
        return f"{said}: give grey or colour, without alpha"
    return f"the image is {given[1]} x {given[0]} px, expected {width} x {height} ({said}): use images of this sensor's camera"


def _state(key: str, shape: tuple[int, ...], previous: Mapping[str, np.ndarray] | None) -> np.ndarray:
    """Return an input of a tracking model from the results of the previous frames; NaN if there are none."""
    if previous is None:
        return np.full(shape, np.nan, np.float32)
    values = np.asarray(previous.get(key) if isinstance(previous, Mapping) else previous)
    if values.shape != shape or values.dtype.kind != "f":
        raise EdgeError(
            f"{shape[0]} images with previous results {key} {values.dtype} {list(values.shape)}; expected {list(shape)}, the "
            "results of `run` for as many images"
        )
    return values.astype(np.float32)
