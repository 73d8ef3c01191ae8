"""The commands `torchmembrane-to-lerobot` and `torchmembrane-lerobot-add`."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from torchmembrane import MembraneError


def to_lerobot(arguments: list[str] | None = None) -> int:
    """Convert folders of results to the episodes of a new data set."""
    parser = argparse.ArgumentParser("torchmembrane-to-lerobot", description="Folders of results as a data set of LeRobot.")
    parser.add_argument("folders", nargs="+", type=Path, help="results of runs, an episode each")
    parser.add_argument("--root", required=True, type=Path, help="the data set's folder, new")
    parser.add_argument("--repo-id", default="local/tactile")
    parser.add_argument("--name", required=True, help="of the sensor")
    parser.add_argument("--fps", required=True, type=int)
    parser.add_argument("--task", default="press")
    args = parser.parse_args(arguments)

    def run() -> str:
        from .convert import convert

        dataset = convert(args.folders, args.root, args.repo_id, args.name, args.fps, args.task)
        return f"{args.root}: {dataset.num_episodes} episodes, {len(dataset)} frames"

    return finished(parser, run)


def lerobot_add(arguments: list[str] | None = None) -> int:
    """Add wrenches, contacts and statuses to a recorded data set."""
    parser = argparse.ArgumentParser(
        "torchmembrane-lerobot-add",
        description="A data set of LeRobot written anew with wrenches, contacts and statuses of the membranes in its images.",
        epilog="Example: torchmembrane-lerobot-add runs/press --sensor finger=sensor.toml --sensor thumb=thumb/sensor.toml",
    )
    parser.add_argument("dataset", type=Path, help="its folder, which stays as it is")
    parser.add_argument("--sensor", required=True, action="append", metavar="CAMERA=SENSOR.toml", help="once per membrane")
    parser.add_argument("--out", type=Path, help="the new data set's folder; default: DATASET_tactile")
    parser.add_argument("--repo-id", help="of the new data set; default: local/ and the folder's name")
    args = parser.parse_args(arguments)
    sensors = dict(each.partition("=")[::2] for each in args.sensor)
    if len(sensors) < len(args.sensor) or not all(sensors.values()):
        parser.error(f"--sensor {' '.join(args.sensor)}: expected CAMERA=SENSOR.toml, once per camera")
    out = args.out or args.dataset.with_name(f"{args.dataset.name}_tactile")

    def run() -> str:
        from .add import add

        files = {name: Path(path) for name, path in sensors.items()}
        dataset = add(args.dataset, files, out, args.repo_id or f"local/{out.name}")
        return f"{out}: {dataset.num_episodes} episodes, {len(dataset)} frames"

    return finished(parser, run)


def finished(parser: argparse.ArgumentParser, run: Callable[[], str]) -> int:
    """Run a command and print its final message; return the exit code."""
    try:
        print(run())
    except ImportError as error:  # LeRobot says which of its packages is missing
        print(f'{parser.prog}: error: {error}: pip install "lerobot[dataset]"', file=sys.stderr)
        return 2
    except MembraneError as error:
        print(f"{parser.prog}: error: {error}", file=sys.stderr)
        return 2
    return 0
