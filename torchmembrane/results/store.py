"""The settings that all frames of a folder of results share, and `mesh.npz`, which contains them and the rest surface."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from torch import Tensor

from ..errors import MembraneError
from ..files.safe_read import DAMAGE, NUMBERS, TEXT, in_one_line, read_arrays
from ..files.system_files import is_of_system
from ..pose import Pose
from .frame_shapes import shape_mismatch
from .npz import save_frame
from .status import Status
from .summary_row import METRE

FINISHED = tuple(status for status in Status if status.has_surface)
"""Statuses of frames that are not computed again."""
FORMATS = ("npz", "parquet")
MESH = "mesh.npz"
FIXED = ("element", "volume")
"""Settings that no command-line option chooses: each estimator has its own."""
ELSE = {"pressure": "not measured", "fields": "none"}
"""Texts for settings that may be empty; any other empty setting means the sensor's own."""


class ResultMaker(Protocol):
    """The attributes of a `Reconstructor` that are needed to write a folder of results."""

    sensor: Any
    estimator: Any
    estimator_name: str
    locator_name: str
    model: str
    vertex_pixels: Tensor

    @property
    def rest_pixels(self) -> Tensor: ...


class Settings(NamedTuple):
    """The choices besides the sensor that determine a result; all frames of a folder share them."""

    estimator: str
    energy: str
    element: str
    format: str
    volume: str = "exact"
    flow: str = "smooth"
    smoothing: float = 0.0
    locator: str = "fit"
    rest: str = ""
    pressure: str = ""
    pressure_noise: float = 0.0
    fields: str = ""
    rest_hash: str = ""

    @classmethod
    def from_reconstructor(
        cls,
        reconstructor: ResultMaker,
        format: str,
        rest: str = "",
        pressure: str = "",
        fields: Sequence[str] = (),
        rest_hash: str = "",
    ) -> "Settings":
        """Return the settings of a reconstructor's results. `rest`: source of the rest state if it is not the sensor's rest
        image, and `rest_hash` the content hash of its images; `pressure`: file of the gauge's readings; `fields`: additional
        fields of the surface that frames contain."""
        estimator = reconstructor.estimator
        return cls(
            estimator=reconstructor.estimator_name,
            energy=reconstructor.model,
            element=estimator.element,
            format=format,
            volume=estimator.volume,
            flow=estimator.flow_kind,
            smoothing=estimator.smoothing_weight,
            locator=reconstructor.locator_name,
            rest=rest,
            pressure=pressure,
            pressure_noise=getattr(estimator.settings, "pressure_noise", 0.0) if pressure else 0.0,
            fields=" ".join(fields),
            rest_hash=rest_hash,
        )


class Mesh(NamedTuple):
    """What all frames of a folder share, as stored in `mesh.npz`.

    rest_vertices   [V, 3]  the rest surface, camera frame
    rest_normals    [V, 3]  unit, outward
    triangles       [T, 3]  int64, outward
    fixed           [V]     bool, the rim
    grid            [2]     int64, `V = grid[0] * grid[1]`, row-major
    vertex_pixels   [V, 2]  where the rest vertices are seen
    rest_pixels     [D, 2]  where the markers are seen at rest; of several views [W, D, 2]
    image_size      [2]     int64, width and height, px
    length_unit, force_unit, name    of the sensor
    sensor          fingerprint of its file
    estimator, energy, element, format, volume, flow, smoothing, locator, rest, pressure, pressure_noise, fields, rest_hash
                            the `Settings`
    camera_in_tool  [3, 4]  rotation and translation from the camera's frame to the tool's, `p_tool = R p + t`; [0, 4] where the
                            sensor file has no `[tool]`; `tool` gives it as a `Pose`
    record          `[record]` of the sensor file as JSON: serial, calibrated, images, by, uncertainty; empty without
    view_names      of several views, separated by spaces; empty of one
    image_part      [4]     int64, of views that are regions of one image: left and top of the first one, width and height of
                            that image; [0] else
    """

    rest_vertices: np.ndarray
    rest_normals: np.ndarray
    triangles: np.ndarray
    fixed: np.ndarray
    grid: np.ndarray
    vertex_pixels: np.ndarray
    rest_pixels: np.ndarray
    image_size: np.ndarray
    length_unit: str
    force_unit: str
    name: str
    sensor: str
    estimator: str
    energy: str
    element: str
    format: str
    volume: str = "exact"
    flow: str = "smooth"
    smoothing: float = 0.0
    locator: str = "fit"
    rest: str = ""
    pressure: str = ""
    pressure_noise: float = 0.0
    fields: str = ""
    rest_hash: str = ""
    camera_in_tool: np.ndarray = np.zeros((0, 4), np.float32)
    record: str = ""
    view_names: str = ""
    image_part: np.ndarray = np.zeros(0, np.int64)

    @classmethod
    def from_reconstructor(cls, reconstructor: ResultMaker, settings: Settings) -> "Mesh":
        """Return the data that all frames of a `Reconstructor` share."""
        sensor, membrane = reconstructor.sensor, reconstructor.estimator.membrane
        return cls(
            rest_vertices=_single(membrane.rest),
            rest_normals=_single(membrane.rest_normals),
            triangles=membrane.triangles.cpu().numpy().astype(np.int64),
            fixed=membrane.fixed.cpu().numpy(),
            grid=np.array(membrane.grid),
            vertex_pixels=_single(reconstructor.vertex_pixels),
            rest_pixels=_single(reconstructor.rest_pixels),
            image_size=np.array(sensor.camera.image_size),
            length_unit=sensor.length_unit,
            force_unit=sensor.force_unit,
            name=sensor.name,
            sensor=sensor.fingerprint,
            **settings._asdict(),
            camera_in_tool=_rows(sensor.tool),
            record=sensor.record.text,
            view_names=" ".join(view.name for view in sensor.views),
            image_part=_image_part(sensor),
        )

    @classmethod
    def load(cls, path: str | Path) -> "Mesh":
        """Read `mesh.npz`.

        Raises:
            MembraneError: the file is missing, damaged, or not a mesh.
        """
        expected = f"the {MESH} that is written beside results"
        if not Path(path).exists():
            raise MembraneError(f"{path}: no such file; expected {expected}")
        try:
            arrays = read_arrays(Path(path), None, expected, NUMBERS + TEXT)
            found: dict[str, Any] = {key: arrays[key] for key in cls._fields if key in arrays or key not in cls._field_defaults}
            mesh = cls(**{key: array.item() if array.ndim == 0 else array for key, array in found.items()})
            mesh._refuse_unlike()
        except DAMAGE as error:
            cause = in_one_line(str(error).removeprefix(f"{path}: "))
            raise MembraneError(f"{path}: not a {MESH} of torchmembrane ({cause}); expected {expected}") from error
        return mesh

    def check(self, frame: dict[str, np.ndarray], path: str | Path) -> None:
        """Refuse a frame of another membrane or with other markers.

        Args:
            frame: arrays of the frame.
            path: path of the frame, for the message.

        Raises:
            MembraneError: the shape or type of an array does not match this mesh.
        """
        if said := shape_mismatch(frame, len(self.rest_vertices), self.rest_pixels.shape[-2], self.views):
            raise MembraneError(f"{path}: {said} as of its {MESH}: give the {MESH} of its folder, or reconstruct it again")

    @property
    def views(self) -> int:
        """Return the number of views, or 0 for a sensor with one view."""
        return len(self.rest_pixels) if self.rest_pixels.ndim == 3 else 0

    def _refuse_unlike(self) -> None:
        """Raise `ValueError` if the shapes of the fields do not fit together."""
        V = len(self.rest_vertices)
        wanted = {"rest_vertices": (V, 3), "rest_normals": (V, 3), "fixed": (V,), "grid": (2,), "image_size": (2,)}
        wanted |= {
            "triangles": (len(self.triangles), 3),
            "vertex_pixels": (V, 2),
            "rest_pixels": (*self.rest_pixels.shape[:-1], 2),
        }
        if self.image_part.size:
            wanted["image_part"] = (4,)
        if self.camera_in_tool.size:  # none is `[0]` as `torchmembrane-edge` once wrote it
            wanted["camera_in_tool"] = (3, 4)
        for name, shape in wanted.items():
            if (array := getattr(self, name)).shape != shape or array.dtype.kind not in NUMBERS:
                raise ValueError(f"{name} is {array.dtype} {array.shape}, not {shape}")
        for name, kind in self.__annotations__.items():
            if kind in (str, float) and not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} is {type(getattr(self, name)).__name__}, not {kind.__name__}")
        if self.triangles.size and not 0 <= self.triangles.min() <= self.triangles.max() < V:
            raise ValueError("its triangles refer to vertices that do not exist")
        if int(np.prod(self.grid)) != V or self.format not in FORMATS:
            raise ValueError(f"its grid is {self.grid.tolist()}, its format {self.format!r}")

    def save(self, path: str | Path) -> None:
        """Write `mesh.npz` atomically."""
        save_frame(path, self._asdict())

    @property
    def settings(self) -> Settings:
        """Return the settings of the results."""
        return Settings(*(getattr(self, name) for name in Settings._fields))

    @property
    def tool(self) -> Pose | None:
        """Return the pose of the camera in the tool's frame, for `Reconstruction.wrench_in`; None if unknown."""
        known = len(self.camera_in_tool) > 0
        return Pose(self.camera_in_tool[:, :3], self.camera_in_tool[:, 3]) if known else None

    def pressure_in_words(self, pressure: float) -> str:
        """Return a pressure of the results as text with sign and unit: in hPa, as in `summary.csv`, if forces are in N."""
        if self.force_unit != "N" or self.length_unit not in METRE:
            return f"{pressure:+.3g} {self.force_unit}/{self.length_unit}²"
        return f"{pressure * METRE[self.length_unit] ** 2 / 100:+.3g} hPa"

    @property
    def file_size(self) -> tuple[int, int]:
        """Return the width and height of the image files, px; if views are regions of one image, those of that image."""
        width, height = self.image_part[2:].tolist() or self.image_size.tolist()
        return width, height

    def first_region(self, image: np.ndarray) -> np.ndarray:
        """Return the first view's region of an image `[height, width]`; the whole image if views do not share one."""
        left, top = self.image_part[:2].tolist() or (0, 0)
        width, height = self.image_size.tolist()
        return image[top : top + height, left : left + width] if image.shape == self.file_size[::-1] else image

    def normal_displacement(self, frame: dict[str, np.ndarray]) -> np.ndarray:
        """Return the displacement along the rest normals, `[V]`, length unit: negative where the membrane is pressed in."""
        along: np.ndarray = (frame["displacement"] * self.rest_normals).sum(-1)
        return along


def check_folder(folder: str | Path, sensor: str, settings: Settings) -> None:
    """Refuse a folder with results of another sensor (by fingerprint) or other settings, or with other contents than
    results."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise MembraneError(f"--out {folder}: is a file; expected a new folder, or one with earlier results of this sensor")
    if not (folder / MESH).exists():
        if not all(map(is_of_system, folder.glob("*.npz"))) or (folder / "frames").exists():
            raise MembraneError(f"--out {folder}: holds .npz files or frames/ but no {MESH}; choose another folder")
        return
    mesh = Mesh.load(folder / MESH)
    if mesh.sensor != sensor:
        other = f"{in_one_line(repr(mesh.name))} ({in_one_line(mesh.sensor[:12])}, here {sensor[:12]})"
        raise MembraneError(f"--out {folder}: holds results of another sensor, {other}; choose another folder")
    for option, before, now in zip(Settings._fields, mesh.settings, settings, strict=True):
        if option == "rest_hash":  # earlier versions did not store it
            if before and before != now:
                raise MembraneError(
                    f"--out {folder}: the images of --rest {settings.rest} have changed since its results were made; choose "
                    "another folder"
                )
        elif before != now:
            held = in_one_line(before) if before else ""
            name, none = option.replace("_", "-"), ELSE.get(option, "of the sensor")
            remedy = f", or pass --{name} {held}" if held else f", or leave --{name} out"
            raise MembraneError(
                f"--out {folder}: was made with {name} {held or none}, this call asks for {now or none}; choose another "
                f"folder{'' if option in FIXED else remedy}"
            )


def _rows(pose: Pose | None) -> np.ndarray:
    """Return rotation and translation side by side, `[3, 4]`; `[0, 4]` without a pose."""
    rows = np.zeros((0, 4)) if pose is None else np.column_stack([pose.rotation, pose.translation])
    return rows.astype(np.float32)


def _image_part(sensor: Any) -> np.ndarray:
    """Return the first view's left and top, and the size of the image that views share; `[0]` if they do not share one."""
    region = sensor.views[0].region if sensor.views else None
    return np.array([] if region is None else [*region[:2], *sensor.image_size], np.int64)


def _single(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy().astype(np.float32)
