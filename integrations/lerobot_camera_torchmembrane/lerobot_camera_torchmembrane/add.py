"""Addition of wrenches, contacts and statuses to a data set that was recorded with images only."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import compute_episode_stats
from lerobot.datasets.dataset_tools import add_features, recompute_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tqdm import tqdm

import torchmembrane as tm

from . import tactile
from .convert import refuse_existing


def add(root: Path, sensors: dict[str, Path], out: Path, repo_id: str) -> LeRobotDataset:
    """Write a new data set that adds the tactile results of its cameras' membranes.

    Args:
        root: folder of the data set, which is not changed.
        sensors: sensor files by the name of their camera: images `observation.images.NAME` yield
            `observation.tactile.NAME.wrench`, `.contacts` and `.status`.
        out: folder of the new data set, which must not exist.
        repo_id: name of the new data set, `owner/name`.

    Returns:
        The new data set, including statistics.

    Raises:
        MembraneError: `root` holds no data set, `out` exists, a camera is not in the data set or has another size than in its
            sensor file, or the data set already has the features to be added.
    """
    if not (root / "meta/info.json").is_file():
        raise tm.MembraneError(f"{root}: no data set of LeRobot (meta/info.json is missing); expected its folder")
    refuse_existing(out)
    dataset = LeRobotDataset(f"local/{root.resolve().name}", root=root)
    trackers = {name: tm.Tracker(tm.Reconstructor.from_file(path)) for name, path in sensors.items()}
    for name, tracker in trackers.items():
        tactile.refuse_views_apart(tracker.reconstructor.sensor, sensors[name])
        refuse_camera(dataset.meta.features, name, tracker.reconstructor.image_size)
    values = felt_in(dataset, trackers)
    declared = {key: each for name in sensors for key, each in tactile.features(name).items()}
    added = add_features(dataset, {key: (values[key], declared[key]) for key in declared}, out, repo_id)
    recompute_stats(added)
    keep_episode_statistics(added, values, declared)
    return LeRobotDataset(repo_id, root=out)


def refuse_camera(features: dict[str, dict], name: str, size: tuple[int, int]) -> None:
    """Refuse a camera that is not in the data set, has another image size, or already has the features to be added."""
    key = f"observation.images.{name}"
    if key not in features:
        images = "observation.images."
        found = ", ".join(each.removeprefix(images) for each in features if each.startswith(images))
        raise tm.MembraneError(f"--sensor {name}=...: the data set has images of {found or 'no camera'}; expected one of them")
    height, width = features[key]["shape"][:2]
    if (width, height) != tuple(size):
        raise tm.MembraneError(f"{key} is {width} x {height} px; expected {size[0]} x {size[1]}, as its sensor file has")
    there = [each for each in tactile.features(name) if each in features]
    if there:
        raise tm.MembraneError(f"the data set has {there[0]} already; expected one without it: remove it first")


def felt_in(dataset: LeRobotDataset, trackers: dict[str, tm.Tracker]) -> dict[str, np.ndarray]:
    """Return the tactile results of all frames by key, `[N, ...]`; every episode starts from the rest state."""
    values: dict[str, list[np.ndarray]] = {key: [] for name in trackers for key in tactile.features(name)}
    episode = None
    for item in tqdm((dataset[k] for k in range(len(dataset))), total=len(dataset), unit=" frames"):
        for name, tracker in trackers.items():
            if item["episode_index"] != episode:
                tracker.reset()
            frame = tracker(item[f"observation.images.{name}"]).frame(0)
            for what, value in tactile.felt(frame).items():
                values[tactile.key(name, what)].append(value)
        episode = item["episode_index"]
    return {key: np.stack(each) for key, each in values.items()}


def keep_episode_statistics(dataset: LeRobotDataset, values: dict[str, np.ndarray], declared: dict[str, dict]) -> None:
    """Write each episode's statistics of the new features beside the others, since deleting or merging episodes aggregates
    them."""
    for path in sorted((dataset.root / "meta/episodes").glob("*/*.parquet")):
        table = pq.read_table(path)
        spans = list(zip(*(table[f"dataset_{end}_index"].to_pylist() for end in ("from", "to")), strict=True))
        for key, feature in declared.items():
            found = [compute_episode_stats({key: values[key][a:b]}, {key: feature})[key] for a, b in spans]
            for statistic in found[0]:
                column = pa.array([np.atleast_1d(each[statistic]).tolist() for each in found])
                table = table.append_column(f"stats/{key}/{statistic}", column)
        pq.write_table(table, path)
