"""Processor time of each command of the tutorials, run from top to bottom as a reader would.

python -m bench.speed.walks [--pages own_sensor,own_bubble] [--json FILE]

The commands of the blocks ```sh of docs/PAGE.md are run in a folder that holds only the tables of the page. Measured for each
command: its user time and its wall-clock time. A row also says whether the command only stands in for what the reader already
has, which are the file and the photographs of a real sensor. Machine code is in the cache if the page was run before.
"""

import argparse
import os
import re
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.data.record import write

DOCS = Path(__file__).parents[2] / "docs"
ROOT = DOCS.parent


def commands(page: str) -> list[list[str]]:
    """The commands of the blocks that begin with ```sh, as lists of arguments.

    >>> commands("```sh\\ntorchmembrane check mine.toml --out \\\\\\n  mine.png\\n```")
    [['torchmembrane', 'check', 'mine.toml', '--out', 'mine.png']]
    """
    text = "\n".join(re.findall(r"```sh\n(.*?)```", page, re.S)).replace("\\\n", " ")
    return [shlex.split(line) for line in text.splitlines() if line.strip()]


def is_stand_in(command: list[str]) -> bool:
    """Whether it makes what the reader has: the real sensor, or photographs of it."""
    return command[1] == "simulate" or (command[1] == "init" and "--rest" not in command)


def spent(command: list[str], folder: str) -> tuple[float, float]:
    """User time of a command, and wall-clock time, s."""
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    called = [sys.executable, "-m", "torchmembrane", *command[1:]]
    subprocess.run(called, cwd=folder, check=True, env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)})
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before, time.perf_counter() - began


def of_page(name: str) -> list[dict]:
    """A row for each command of a page."""
    rows = []
    page = (DOCS / f"{name}.md").read_text()
    with tempfile.TemporaryDirectory() as folder:
        for file, content in re.findall(r"`(\w+\.csv)`:\n\n```csv\n(.*?)```", page, re.S):
            (Path(folder) / file).write_text(content)
        for command in commands(page):
            seconds, elapsed = spent(command, folder)
            said = " ".join(command[1:])
            print(f"{name}: {seconds:.1f} s, {elapsed:.1f} s by the clock: {said}", flush=True)
            rows.append(dict(page=name, command=said, seconds=seconds, elapsed=elapsed, stands_in=is_stand_in(command)))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pages", default="own_sensor,own_bubble", help="names of pages, with commas")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = [row for name in args.pages.split(",") for row in of_page(name)]
    write(args.json, {"rows": rows})


if __name__ == "__main__":
    main()
