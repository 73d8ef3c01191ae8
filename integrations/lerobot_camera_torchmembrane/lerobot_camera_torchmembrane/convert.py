"""Recorded runs as LeRobot data sets (v3): a folder of results is an episode."""

import argparse
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

import torchmembrane as tm

from .tactile import features, keys, points


def convert(folders: list[Path], root: Path, repo_id: str, name: str, fps: int, task: str = "press") -> LeRobotDataset:
    """Write folders of results as the episodes of a new data set.

    Args:
        folders: what `torchmembrane reconstruct` wrote, each a run, its frames in the order of their names.
        root: the data set's folder, which must not exist.
        repo_id: its name, `owner/name`.
        name: of the sensor in the keys `observation.tactile.NAME.points` and `.wrench`.
        fps: frames per second of the runs.
        task: what was done, in words.

    Returns:
        The data set, read again.

    Raises:
        MembraneError: a folder holds no results, or the runs are of different grids or units.
    """
    runs = [tm.read_results(folder) for folder in folders]
    kinds = {(len(run.mesh.rest_vertices), run.mesh.length_unit, run.mesh.force_unit) for run in runs}
    if len(kinds) != 1:
        came = " and ".join(f"{vertices} vertices in {length}, {force}" for vertices, length, force in sorted(kinds))
        raise tm.MembraneError(f"runs with {came}; expected results of one sensor, grid and unit")
    ((vertices, _, _),) = kinds
    dataset = LeRobotDataset.create(repo_id, fps, features(name, vertices), root=root, use_videos=False)
    for run in runs:
        area = vertex_areas(run.mesh.rest_vertices, run.mesh.triangles)
        for frame in run:
            felt = points(frame["displacement"], frame["traction"], area), np.nan_to_num(frame["wrench"])
            dataset.add_frame(dict(zip(keys(name), felt, strict=True)) | {"task": task})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset(repo_id, root=root)


def vertex_areas(rest: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A third of the area of the triangles around every vertex, `[V]`."""
    a, b, c = (rest[triangles[:, k]] for k in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.bincount(triangles.ravel(), np.repeat(third, 3), len(rest))


def main() -> None:
    """The command `torchmembrane-to-lerobot`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path, help="results of runs, an episode each")
    parser.add_argument("--root", required=True, type=Path, help="the data set's folder, new")
    parser.add_argument("--repo-id", default="local/tactile")
    parser.add_argument("--name", required=True, help="of the sensor")
    parser.add_argument("--fps", required=True, type=int)
    parser.add_argument("--task", default="press")
    args = parser.parse_args()
    dataset = convert(args.folders, args.root, args.repo_id, args.name, args.fps, args.task)
    print(f"{args.root}: {dataset.num_episodes} episodes, {len(dataset)} frames")


if __name__ == "__main__":
    main()
