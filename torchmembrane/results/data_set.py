"""Export of a folder of results in the layout of Hugging Face's `datasets`: frames, images, and a data set card."""

import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MembraneError
from ..files.atomic import make_folder, write_text, writing
from ..files.optional import load_pyarrow
from ..files.parquet import nested
from ..interruption import unfinished
from .frame_table import PART_ROWS
from .read import Results
from .reconstruction import Reconstruction
from .status import Status
from .store import MESH, Mesh

UNITS = {
    **dict.fromkeys(("vertices", "displacement", "markers", "contact_points", "depth_deviation"), "{length}"),
    **dict.fromkeys(("traction", "pressure", "pressure_change"), "{force}/{length}^2"),
    **dict.fromkeys(("force", "contact_force", "force_deviation"), "{force}"),
    **{"wrench": "{force}, {force} {length}", "contact_area": "{length}^2", "contact_curvature": "1/{length}"},
    **{"pixels": "px", "residual": "px", "camera_motion": "px, px, degrees, 1"},
}
"""Units of a frame's arrays, where they have one."""

CARD = """\
---
pretty_name: {name}
tags:
- tactile
- torchmembrane
configs:
- config_name: default
  data_files:
  - split: train
    path: {files}
---

# {name}

Frames of a soft membrane that a camera looks at from within, reconstructed by torchmembrane, one in each row.

| | |
|---|---|
{facts}

All arrays are in the camera's frame: x right, y down, z out of the lens. Rest surface, triangles and rim are in `mesh.npz`.
A frame without a surface is NaN, and its status says why.

| array | unit |
|---|---|
{arrays}

| status | | frames |
|---|---|---|
{statuses}
"""
FRAMES, IMAGES_OF = "train/metadata.parquet", "train"
"""Folder of the frames and their images: `datasets` names the first split of a data set `train`."""


def write_data_set(results: Results, folder: Path, images: Mapping[str, Path], times: Mapping[str, float]) -> None:
    """Write a folder that `datasets.load_dataset(FOLDER)` loads, with one row for each frame, and images if there are any.

    `README.md` is the card, with the sensor, its record, units and statuses; `train/metadata.parquet` contains `name`, `time`,
    `status_text` and all arrays of each frame, with the images beside it; `mesh.npz` contains what the frames share.

    Args:
        results: the frames to export.
        folder: the folder to create; it must not exist.
        images: image files by frame name, of all frames or of none.
        times: times of capture by frame name, seconds since 1970; may be empty.

    Raises:
        MembraneError: PyArrow is not installed, `folder` exists, or only some of the frames have an image.
    """
    if os.path.lexists(folder):
        raise MembraneError(f"{folder}: exists already; expected the folder of a new data set")
    missing = [name for name in results.names if name not in images]
    if 0 < len(missing) < len(results):
        raise MembraneError(
            f"no image of frame {missing[0]!r} and {len(missing) - 1} more; expected one of each frame, or none"
        )
    part = make_folder(folder.parent) / f".data-set-{os.getpid()}"
    with unfinished(part), writing(folder, part):
        (part / IMAGES_OF).mkdir(parents=True)
        files = {} if missing else {name: f"{name}{images[name].suffix.lower()}" for name in results.names}
        for name, file in files.items():
            shutil.copyfile(images[name], part / IMAGES_OF / file)
        counts = _write_frames(results, part / FRAMES, files, times)
        shutil.copyfile(results.folder / MESH, part / MESH)
        write_text(part / "README.md", card(results.mesh, folder.name, counts, bool(files)))
        part.rename(folder)


def _write_frames(results: Results, path: Path, files: Mapping[str, str], times: Mapping[str, float]) -> Counter[Status]:
    """Write the frames as rows, and return the number of frames by status."""
    arrow, parquet = load_pyarrow()
    counts, writer = Counter[Status](), None
    for names, frames in _groups(results):
        statuses = [Status(int(frame["status"])) for frame in frames]
        counts.update(statuses)
        columns: dict[str, Any] = {"file_name": [files[name] for name in names]} if files else {}
        columns |= {"name": names, "status_text": [status.text for status in statuses]}
        if times:
            columns["time"] = arrow.array([times.get(name) for name in names], arrow.float64())
        columns |= {key: nested(np.stack([frame[key] for frame in frames])) for key in Reconstruction._fields}
        table = arrow.table(columns)
        writer = writer or parquet.ParquetWriter(path, table.schema, compression="zstd", use_dictionary=False)
        writer.write_table(table)
    if writer is not None:
        writer.close()
    return counts


def _groups(results: Results) -> Iterator[tuple[list[str], list[dict[str, np.ndarray]]]]:
    named = zip(results.names, results, strict=True)
    while group := list(islice(named, PART_ROWS)):
        yield [name for name, _ in group], [frame for _, frame in group]


def card(mesh: Mesh, name: str, counts: Mapping[Status, int], has_images: bool) -> str:
    """Return the text of the data set's `README.md`.

    Args:
        mesh: the data that the frames share.
        name: name of the data set.
        counts: numbers of frames by status.
        has_images: whether there are images.
    """
    facts = {"sensor": mesh.name, "record of its calibration": mesh.record or "none", "sensor file's fingerprint": mesh.sensor}
    facts |= {"estimator": mesh.estimator, "length unit": mesh.length_unit, "force unit": mesh.force_unit}
    units = {key: unit.format(length=mesh.length_unit, force=mesh.force_unit) for key, unit in UNITS.items()}
    return CARD.format(
        name=name,
        files=f"{IMAGES_OF}/*" if has_images else FRAMES,
        facts="\n".join(f"| {key} | {value} |" for key, value in facts.items()),
        arrays="\n".join(f"| `{key}` | {units.get(key, '')} |" for key in Reconstruction._fields),
        statuses="\n".join(f"| {int(status)} | {status.text} | {counts[status]} |" for status in sorted(counts)),
    )
