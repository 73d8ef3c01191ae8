"""Read and write `[camera]` of a sensor's file, or `[[camera]]` for several views."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..camera.folds import refuse_folds
from ..camera.model import Camera
from ..camera.ports import Port
from ..files.images import image_size, mean_image, write_image
from ..pose import ViewPose
from ..surface.membrane import Membrane
from .parts import Markers, refuse_other_size
from .table import Table, toml_lines
from .views import SIDES, View

KEYS = ("model", "image_size", "focal", "centre", "distortion", "crop", "binning", "bits", "ports", "medium")
OF_VIEWS = ("name", "pose", "region", "side", "rest_image")
FIRST = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
"""Pose of the first view, which the file may leave out."""


def read_cameras(file: Table) -> tuple[Camera, list[View]]:
    """Read the first camera, and all views if the file has several.

    Args:
        file: the top-level table of the sensor file.

    Raises:
        MembraneError: a value is invalid; the message names file, key, value, what was expected and the remedy.
    """
    if not isinstance(file.values.get("camera"), list):
        return _read_camera(file.table("camera")), []
    tables = file.tables("camera")
    if len(tables) < 2:
        raise file.refuse("camera", "[[camera]] of two views or more, or [camera] of one")
    views = [_read_view(table, is_first=number == 0) for number, table in enumerate(tables)]
    return views[0].camera, views


def with_rest_images(file: Table, views: list[View], markers: Markers) -> tuple[list[View], Markers]:
    """Return the views with their regions of the shared rest image, and the markers with the first view's rest image.

    Raises:
        MembraneError: `[markers]` has a rest image although the views have images of their own.
    """
    shared = markers.rest_image
    if shared is None:
        return views, replace(markers, rest_image=views[0].rest_image)
    if apart := [view.name for view in views if view.region is None]:
        expected = (
            f"no rest_image in [markers], because view {apart[0]!r} has no region of a shared image: give each [[camera]] a "
            "region, or each a rest_image of its own"
        )
        raise file.table("markers").refuse("rest_image", expected)
    return [replace(view, rest_image=view.camera.mode.image(shared)) for view in views], markers  # type: ignore[union-attr]


def refuse_folded(file: Table, camera: Camera, views: Sequence[View], membrane: Membrane) -> None:
    """Raise an error if a lens model folds within its image, so that two rays share a pixel.

    Raises:
        MembraneError: a lens folds; the message names file, table and value.
    """
    if not views:
        with file.table("camera").naming("distortion"):
            refuse_folds(camera, membrane.rest)
    for table, view in zip(file.tables("camera") if views else [], views, strict=True):
        with table.naming("distortion"):
            refuse_folds(view.camera, view.pose.inverse.points(membrane.rest))


def camera_table(camera: Camera) -> dict[str, Any]:
    """Return a camera's values by the keys of its table; a cropped or binned camera is given as in that mode."""
    return {
        "model": camera.model,
        "image_size": list(camera.image_size),
        **{key: getattr(camera, key).tolist() for key in ("focal", "centre", "distortion")},
        **({} if camera.bits is None else {"bits": camera.bits}),
        "ports": [port._asdict() for port in camera.ports],
        "medium": {"index": camera.medium_index.item()} if camera.ports else {},
    }


def view_tables(views: Sequence[View]) -> list[dict[str, Any]]:
    """Return the camera tables of all views, each with name, pose, region and side."""
    return [view.described() | camera_table(view.camera) for view in views]


def write_cameras(path: Path, camera: Camera, views: Sequence[View]) -> tuple[list[str], np.ndarray | None]:
    """Format the tables of all cameras, and write the views' rest images beside the sensor's file.

    Args:
        path: path of the sensor's file.
        camera: the first camera.
        views: all views if there are several, else empty.

    Returns:
        The lines, and the shared rest image for `[markers]` if the views are regions of one image.
    """
    if not views:
        return _lines("camera", camera_table(camera) | _calibrated(camera)), None
    blocks = []
    for view in views:
        words = view.described() | camera_table(view.camera) | _calibrated(view.camera)
        if view.region is not None:
            words = {key: value for key, value in words.items() if key not in ("crop", "binning")}
        elif view.rest_image is not None:
            stem = path.with_name(f"{path.stem}_rest_{view.name}")
            words["rest_image"] = write_image(stem, view.rest_image, view.camera.bits).name
        blocks.append("\n".join(_lines("camera", words, repeated=True)))
    return "\n\n".join(blocks).split("\n"), shared_image([view.rest_image for view in views], views)


def shared_image(images: Sequence[np.ndarray | None], views: Sequence[View]) -> np.ndarray | None:
    """Assemble the shared image from the views' regions, black elsewhere; None if the views have images of their own."""
    if views[0].region is None or views[0].camera.mode is None or any(image is None for image in images):
        return None
    width, height = views[0].camera.mode.image_size
    whole = np.zeros((height, width), np.asarray(images[0]).dtype)
    for view, image in zip(views, images, strict=True):
        left, top, across, down = view.region or (0, 0, 0, 0)
        whole[top : top + down, left : left + across] = image
    return whole


def _read_view(table: Table, is_first: bool) -> View:
    if "region" in table and ("crop" in table or "binning" in table):
        raise table.refuse("region", "no crop and binning beside it: the region is the part that is kept")
    pose = FIRST if is_first and "pose" not in table else table.matrix("pose", 4)
    camera, name = _read_camera(table, OF_VIEWS), table.text("name")
    if "region" in table:
        with table.naming("region"):
            camera = camera.in_mode(table.whole_numbers("region", 4))
    side = table.text("side", SIDES) if "side" in table else SIDES[0]
    images = table.files("rest_image") if "rest_image" in table else []
    with table.naming("pose"):
        placed = ViewPose.of_matrix(np.array(pose, float))
    with table.naming():
        for path in images[:1]:
            refuse_other_size(image_size(path), camera)
        rest = mean_image(images, camera.bits) if images else None
        if rest is not None and camera.mode is not None and rest.shape[::-1] != camera.image_size:
            rest = camera.mode.image(rest)
        return View(name, camera, placed, rest, side, "region" in table)


def _read_camera(table: Table, others: Sequence[str] = ()) -> Camera:
    table.allow((*KEYS, *others))
    ports = table.tables("ports")
    medium = table.table("medium") if ports or "medium" in table else None
    for part in ports:
        part.allow(Port._fields)
    if medium:
        medium.allow(("index",))
        if not ports and medium.number("index") != 1.0:
            raise medium.refuse(
                "index", "1 or no such table without [[camera.ports]]: light is refracted at the ports; add them"
            )
    crop = table.whole_numbers("crop", 4) if "crop" in table else None
    binning = table.whole_pair("binning") if "binning" in table else [1, 1]
    with table.naming():
        calibrated = Camera(
            model=table.text("model", ("pinhole", "fisheye")),
            image_size=table.whole_numbers("image_size", 2),
            focal=table.numbers("focal", 2),
            centre=table.numbers("centre", 2),
            distortion=table.numbers("distortion"),
            ports=[Port(*(port.number(key) for key in Port._fields)) for port in ports],
            medium_index=medium.number("index") if medium else 1.0,
            bits=table.whole_number("bits") if "bits" in table else None,
        )
        return calibrated.in_mode(crop, binning) if "crop" in table or "binning" in table else calibrated


def _calibrated(camera: Camera) -> dict[str, list[float]]:
    """Return calibration and mode (crop, binning) of a camera by key; empty if its values no longer follow from the mode."""
    mode, found = camera.mode, (camera.focal.tolist(), camera.centre.tolist())
    if mode is None or found != (list(mode.binned_focal), list(mode.binned_centre)):
        return {}
    return {key: list(value) for key, value in mode._asdict().items()}


def _lines(name: str, table: dict[str, Any], repeated: bool = False) -> list[str]:
    """Format a camera's table, with its ports and medium, as lines of TOML."""
    ports, medium = table.pop("ports"), table.pop("medium")
    lines = toml_lines(name, table, repeated)
    for port in ports:
        lines += toml_lines("camera.ports", port, repeated=True)
    return lines + (toml_lines("camera.medium", medium) if ports else [])
