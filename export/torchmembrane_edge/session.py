"""A model, what it says of its sensor, and images to results."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnxruntime

FORMAT = "1"
GREY = (0.299, 0.587, 0.114)
WHOLE, FLAGS = ("triangles", "grid", "image_size"), ("fixed",)  # of the mesh; other arrays are float32


class EdgeError(ValueError):
    """What came, and what was expected."""


class Session:
    """A model ready to run.

    Arguments: `model`, the path of a file from `torchmembrane export`; `threads`, of which one is best for single frames;
    `providers`, onnxruntime's, in order of preference.

    Attributes: `name` of the sensor, `length_unit`, `force_unit`, `status_texts` (code to text), `mesh` (what `mesh.npz`
    holds: rest_vertices, triangles, fixed ...), `image_size` (width, height), `bits` of the camera, where its images of 16 bits
    hold fewer, else None, `tracks`: whether it follows dots.
    """

    def __init__(self, model: str | Path, threads: int = 1, providers: Sequence[str] = ("CPUExecutionProvider",)):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        if not Path(model).is_file():
            raise EdgeError(f"{model}: no such file; expected a model from `torchmembrane export`")
        try:
            self._session = onnxruntime.InferenceSession(str(model), options, providers=list(providers))
        except Exception as error:  # onnxruntime's errors have no common base
            raise EdgeError(f"{model}: onnxruntime {onnxruntime.__version__} cannot load it: {error}") from error
        known = self._session.get_modelmeta().custom_metadata_map
        if known.get("format") != FORMAT:
            raise EdgeError(f"{model}: format {known.get('format')!r}; expected {FORMAT!r}, from `torchmembrane export`")
        self.name, self.length_unit, self.force_unit = known["name"], known["length_unit"], known["force_unit"]
        self.status_texts = {int(code): text for code, text in json.loads(known["status_texts"]).items()}
        self.mesh = {key: _array(key, value) for key, value in json.loads(known["mesh"]).items()}
        self.image_size = tuple(self.mesh["image_size"].tolist())
        self.bits = int(known["bits"]) if "bits" in known else None
        inputs = [given.name for given in self._session.get_inputs()]
        self._state = [name.removeprefix("previous_") for name in inputs if name.startswith("previous_")]
        self.tracks = bool(self._state)
        self._outputs = [output.name for output in self._session.get_outputs()]

    def run(self, images, previous: dict[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
        """Results of a batch, by name, one row per frame: vertices `[B, V, 3]`, ..., status `[B]`.

        `images`: `[height, width]` or `[B, height, width]` grey, or `[B, height, width, 3]` RGB; uint8, uint16 (of
        `bits`) or float in 0..1. A frame that cannot be reconstructed has a status and NaN.
        `previous`, for a model that tracks: the results of the frames before, where its dots are looked for first.
        """
        images = grey(images, self.bits)
        width, height = self.image_size
        if images.shape[1:] != (height, width):
            raise EdgeError(
                f"images of {images.shape[2]} x {images.shape[1]} px; sensor {self.name!r} expects {width} x {height}"
            )
        feed = {"image": images[:, None]}
        if not self.tracks:
            return dict(zip(self._outputs, self._session.run(None, feed), strict=True))
        state = self._rest(len(images)) if previous is None else previous
        if (count := len(state[self._state[0]])) != len(images):
            raise EdgeError(f"{len(images)} images after results of {count}; expected as many")
        feed |= {f"previous_{key}": state[key] for key in self._state}
        return dict(zip(self._outputs, self._session.run(None, feed), strict=True))

    def track(self, images):
        """Results of a video's images, one after another, dots followed from each to the next (a generator)."""
        if not self.tracks:
            raise EdgeError(
                f"the model of {self.name!r} does not track; expected one of dots from `torchmembrane export --tracking`"
            )
        previous = None
        for image in images:
            previous = self.run(np.asarray(image)[None], previous)
            yield previous

    def wrench_in_tool(self, results: dict[str, np.ndarray]) -> np.ndarray:
        """The wrench of results `[B, 6]` in the frame of the sensor's tool: force, and moment about that frame's origin."""
        pose = self.mesh.get("camera_in_tool", ())
        if not len(pose):
            raise EdgeError(
                f"the model of {self.name!r} knows no tool; expected one of a sensor file with [tool]: export it again"
            )
        rotation, translation = pose[:, :3], pose[:, 3]
        force, moment = results["wrench"][:, :3] @ rotation.T, results["wrench"][:, 3:] @ rotation.T
        return np.concatenate([force, moment + np.cross(translation, force)], -1)

    def _rest(self, batch: int) -> dict[str, np.ndarray]:
        shapes = {given.name: given.shape[1:] for given in self._session.get_inputs()}
        return {key: np.full((batch, *shapes[f"previous_{key}"]), np.nan, np.float32) for key in self._state}


def grey(images, bits: int | None = None) -> np.ndarray:
    """Grey values `[B, height, width]`, float32 in 0..1: 0.299 R + 0.587 G + 0.114 B.

    `bits`: of the camera, where uint16 images hold fewer; white is then `2^bits - 1`, and values beyond are refused.
    """
    images = np.asarray(images)
    if images.ndim == 2:
        images = images[None]
    if images.ndim not in (3, 4) or images.shape[3:] not in ((), (3,)):
        raise EdgeError(f"images of shape {list(images.shape)}; expected [B, height, width] or [B, height, width, 3]")
    if images.dtype.kind == "u" and images.dtype.itemsize <= 2:
        white = np.iinfo(images.dtype).max if bits is None or images.dtype.itemsize == 1 else 2**bits - 1
        if images.max(initial=0) > white:
            raise EdgeError(f"values up to {images.max()}; expected at most {white}, as the model's camera has {bits} bits")
    elif images.dtype.kind == "f":
        white = 1.0
    else:
        raise EdgeError(f"images of type {images.dtype}; expected uint8, uint16 or float in 0..1")
    if images.ndim == 4:
        images = sum(weight * images[..., c].astype(np.float64) for c, weight in enumerate(GREY))
    return (images.astype(np.float64) / white).astype(np.float32)


def _array(key: str, value):
    if not isinstance(value, list):
        return value
    array = np.array(value, np.int64 if key in WHOLE else bool if key in FLAGS else np.float32)
    return array.reshape(-1, 4) if key == "camera_in_tool" else array  # none is `[]` in JSON, whatever its shape
