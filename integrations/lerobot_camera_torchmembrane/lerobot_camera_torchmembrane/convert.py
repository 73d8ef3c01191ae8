"""Conversion of recorded runs to LeRobot data sets (v3): each folder of results becomes an episode."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

import torchmembrane as tm
from torchmembrane.files.order import in_order
from torchmembrane.results.read import Results
from torchmembrane.results.reconstruction import Frame
from torchmembrane.results.summary import UNREADABLE, read_summary

from . import tactile


def convert(folders: list[Path], root: Path, repo_id: str, name: str, fps: int, task: str = "press") -> LeRobotDataset:
    """Write folders of results as the episodes of a new data set.

    Args:
        folders: folders written by `torchmembrane reconstruct`, each a run with its frames in name order.
        root: folder of the data set, which must not exist.
        repo_id: name of the data set, `owner/name`.
        name: name of the sensor in the keys `observation.tactile.NAME.points`, `.wrench`, `.contacts` and `.status`.
        fps: frames per second of the runs.
        task: description of the task.

    Returns:
        The data set, loaded again from its folder.

    Raises:
        MembraneError: a folder holds no results, the runs have different grids or units, or `root` already exists.
    """
    runs = [tm.read_results(folder) for folder in folders]
    kinds = {(len(run.mesh.rest_vertices), run.mesh.length_unit, run.mesh.force_unit) for run in runs}
    if len(kinds) != 1:
        came = " and ".join(f"{vertices} vertices in {length}, {force}" for vertices, length, force in sorted(kinds))
        raise tm.MembraneError(f"runs with {came}; expected results of one sensor, grid and unit")
    refuse_existing(root)
    ((vertices, _, _),) = kinds
    dataset = LeRobotDataset.create(repo_id, fps, tactile.features(name, vertices), root=root, use_videos=False)
    for run in runs:
        area = vertex_areas(run.mesh.rest_vertices, run.mesh.triangles)
        for frame in moments_of(run):
            if frame is None:
                values = tactile.unreadable(vertices)
            else:
                values = tactile.felt(frame) | {"points": tactile.points(frame, area)}
            dataset.add_frame({tactile.key(name, what): value for what, value in values.items()} | {"task": task})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset(repo_id, root=root)


def moments_of(run: Results) -> Iterator[Frame | None]:
    """Yield the frames of a run in name order, and None for each image that could not be read: the others keep their times."""
    try:
        rows = read_summary(run.folder)
    except tm.MembraneError:  # without a table, no such image is known
        rows = []
    unread = {row["name"] for row in rows if row["status"] == str(UNREADABLE)} - set(run.names)
    frames = iter(run)
    for name in sorted([*run.names, *unread], key=in_order):
        yield None if name in unread else next(frames)


def refuse_existing(root: Path) -> None:
    """Refuse to write a data set to an existing path."""
    if root.exists():
        raise tm.MembraneError(f"{root}: exists; expected the folder of a new data set: give another one")


def vertex_areas(rest: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return a third of the area of the triangles around every vertex, `[V]`."""
    a, b, c = (rest[triangles[:, k]] for k in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.bincount(triangles.ravel(), np.repeat(third, 3), len(rest))
