"""Frames in the Rerun viewer: image with marker motion, surface with traction, contacts, wrench and pressure."""

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ..files.atomic import whole_file
from ..files.optional import load_rerun
from ..results.frame_shapes import FIELDS, of_first_view
from ..results.reconstruction import Frame
from ..results.status import Status
from ..results.store import Mesh
from ..surface.topology import rim_loop

BLUE, VERMILION, GREY, DARK = (0, 114, 178), (213, 94, 0), (184, 184, 184), (60, 60, 60)
TRACTION_MAP, FIELD_MAP = "Oranges", "viridis"
LONGEST_TRACTION, LONGEST_FORCE = 0.15, 0.35
"""Length of the arrows of the largest traction and the largest force so far, relative to the surface's extent."""
LEAST_TRACTION = 0.1
"""Smallest traction that gets an arrow, relative to the largest traction so far."""
LONGER = 5.0
"""Length of the arrows of the marker motion, relative to the motion."""
TINY = 1e-12
QUALITY = 90
"""JPEG quality of the images."""


class RerunLog:
    """A Rerun recording of one sensor's frames: `with RerunLog(mesh, "press.rrd") as log`, then `log.add(...)`.

    Entities: `camera/image`, with `rest`, `flow` (`LONGER` times as long) and `lost` markers; `surface/now`, coloured by
    compressive normal traction, with `traction`, `contacts` and `forces`, beside `surface/rest`; the curves `force`, `moment`
    and `pressure`; `status`, logged when it changes. Frames that hold fields add `fields/stretch` and `fields/tension`, the
    surface coloured by the larger principal value, and the curves `largest/stretch` and `largest/tension`. Timelines: `frame`,
    and `time` if it is known. Colours and arrows are scaled to the largest value so far.

    Args:
        mesh: data that all frames share.
        save: path of a `.rrd` file; default: the viewer is opened.

    Raises:
        MembraneError: the package rerun-sdk is not installed.
    """

    def __init__(self, mesh: Mesh, save: str | Path | None = None):
        self._rr = load_rerun()
        self._mesh, self._status = mesh, -1
        self._extent = float(np.ptp(mesh.rest_vertices, 0).max())
        self._largest = {"traction": 0.0, "force": 0.0}
        self._recording = self._rr.RecordingStream("torchmembrane", recording_id=None)
        self._file = ExitStack()
        if save is None:
            self._recording.spawn(default_blueprint=self._blueprint())
        else:
            self._recording.save(self._file.enter_context(whole_file(save)), default_blueprint=self._blueprint())
        self._add_rest()

    def __enter__(self) -> "RerunLog":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._recording.flush()
        self._recording.disconnect()
        self._file.close()  # whatever ended the block: the frames so far are whole

    def add(self, number: int, frame: Frame, image: np.ndarray | None = None, time: float | None = None) -> None:
        """Log a frame.

        Args:
            number: number of the frame.
            frame: arrays of the frame, as returned by `Reconstruction.frame`.
            image: its image, `[height, width]` or `[height, width, 3]`, uint8 or in 0..1.
            time: capture time, seconds since 1970.
        """
        self._recording.set_time("frame", sequence=number)
        if time is not None:
            self._recording.set_time("time", timestamp=time)
        status = Status(int(frame["status"]))
        if status != self._status:
            self._log("status", self._rr.TextLog(status.text, level="INFO" if status == Status.OK else "WARN"))
            self._status = status
        if image is not None:
            self._add_image(image)
        self._add_markers(frame)
        if status.has_surface:
            self._add_surface(frame)
            self._add_contacts(frame)
            self._add_fields(frame)
            self._add_curves(frame)
        else:
            for path in ("surface/now", *(f"fields/{name}" for name in FIELDS if name in frame)):
                self._log(path, self._rr.Clear(recursive=True))

    def _add_rest(self) -> None:
        rr, mesh = self._rr, self._mesh
        self._log("surface", rr.ViewCoordinates.RDF, static=True)
        rim = mesh.rest_vertices[rim_loop((int(mesh.grid[0]), int(mesh.grid[1])))]
        self._log("surface/rest", rr.LineStrips3D([np.concatenate([rim, rim[:1]])], colors=GREY), static=True)
        places = rr.Points2D(mesh.rest_pixels[0] if mesh.views else mesh.rest_pixels, radii=2.0, colors=BLUE)
        self._log("camera/image/rest", places, static=True)
        colours = [VERMILION, (0, 158, 115), BLUE]
        for name, unit in (("force", mesh.force_unit), ("moment", f"{mesh.force_unit} {mesh.length_unit}")):
            names = [f"{name} {axis}, {unit}" for axis in "xyz"]
            self._log(name, rr.SeriesLines(names=names, colors=colours), static=True)
        names = [f"change of pressure, {mesh.force_unit}/{mesh.length_unit}²"]
        self._log("pressure", rr.SeriesLines(names=names, colors=[DARK]), static=True)

    def _add_image(self, image: np.ndarray) -> None:
        levels = image if image.dtype == np.uint8 else np.rint(255 * image).astype(np.uint8)
        self._log("camera/image", self._rr.Image(np.ascontiguousarray(levels)).compress(jpeg_quality=QUALITY))

    def _add_markers(self, frame: Frame) -> None:
        mesh, now = self._mesh, of_first_view(frame, "pixels")
        rest = mesh.rest_pixels[0] if mesh.views else mesh.rest_pixels
        found = np.isfinite(now).all(1)
        arrows = self._rr.Arrows2D(origins=rest[found], vectors=LONGER * (now - rest)[found], radii=1.0, colors=VERMILION)
        self._log("camera/image/flow", arrows)
        self._log("camera/image/lost", self._rr.Points2D(rest[~found], radii=4.0, colors=DARK))

    def _add_surface(self, frame: Frame) -> None:
        from matplotlib import colormaps

        rr, traction = self._rr, frame["traction"] * (frame["contact"] > 0)[:, None]
        compressive = -(traction * frame["normals"]).sum(1).clip(max=0)
        sizes = np.linalg.norm(traction, axis=1)
        largest = self._larger("traction", sizes)
        colours = (255 * colormaps[TRACTION_MAP](compressive / largest)).astype(np.uint8)
        self._log("surface/now", self._surface(frame, colours))
        shown = sizes > LEAST_TRACTION * largest
        vectors = traction[shown] * (LONGEST_TRACTION * self._extent / largest)
        self._log("surface/now/traction", rr.Arrows3D(origins=frame["vertices"][shown], vectors=vectors, colors=VERMILION))

    def _surface(self, frame: Frame, colours: np.ndarray) -> Any:
        return self._rr.Mesh3D(
            vertex_positions=frame["vertices"],
            triangle_indices=self._mesh.triangles,
            vertex_normals=frame["normals"],
            vertex_colors=colours,
        )

    def _add_fields(self, frame: Frame) -> None:
        """Log the surface again for each field in the frame, coloured by the larger principal value, from the smallest to the
        largest in the frame."""
        from matplotlib import colormaps

        for name in FIELDS:
            if name in frame:
                values = frame[name].max(1)
                share = (values - values.min()) / max(float(np.ptp(values)), TINY)
                colours = (255 * colormaps[FIELD_MAP](share)).astype(np.uint8)
                self._log(f"fields/{name}", self._surface(frame, colours))
                self._log(f"largest/{name}", self._rr.Scalars([float(values.max())]))

    def _add_contacts(self, frame: Frame) -> None:
        rr, found = self._rr, np.isfinite(frame["contact_points"]).all(1)
        points, forces = frame["contact_points"][found], np.nan_to_num(frame["contact_force"][found])
        sizes = np.linalg.norm(forces, axis=1)
        labels = [f"{size:.3g} {self._mesh.force_unit}" for size in sizes]
        marks = rr.Points3D(points, radii=0.01 * self._extent, colors=DARK, labels=labels)
        self._log("surface/now/contacts", marks)
        vectors = forces * (LONGEST_FORCE * self._extent / self._larger("force", sizes))
        self._log("surface/now/forces", rr.Arrows3D(origins=points, vectors=vectors, colors=BLUE))

    def _add_curves(self, frame: Frame) -> None:
        for name, values in (("force", frame["wrench"][:3]), ("moment", frame["wrench"][3:])):
            self._log(name, self._rr.Scalars(values))
        self._log("pressure", self._rr.Scalars([float(frame["pressure_change"])]))

    def _larger(self, name: str, sizes: np.ndarray) -> float:
        """Update and return the largest size so far, which is never zero."""
        self._largest[name] = max(self._largest[name], float(sizes.max(initial=0.0)))
        return self._largest[name] or 1.0

    def _blueprint(self) -> Any:
        from importlib import import_module

        views = import_module("rerun.blueprint")
        curves = [views.TimeSeriesView(origin=name, name=name) for name in ("force", "moment", "pressure")]
        spaces = views.Spatial2DView(origin="camera/image", name="image"), views.Spatial3DView(origin="surface", name="surface")
        return views.Blueprint(
            views.Vertical(views.Horizontal(*spaces), views.Horizontal(*curves), row_shares=[3, 2]), collapse_panels=True
        )

    def _log(self, path: str, entity: Any, static: bool = False) -> None:
        self._recording.log(path, entity, static=static)
