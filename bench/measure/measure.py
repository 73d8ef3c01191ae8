"""Measures what the documents quote, part by part, and writes their tables.

python -m bench.measure.measure [PART ...] [--list] [--tables] [--independent FOLDER] [--recordings FOLDER]

Without a PART, those parts are measured that were never measured or whose code has changed since; an interrupted run is taken
up again where it ended. Every part writes docs/measured/PART.json with its results, the revision, date, processor and seconds,
from which the tables and figures of the documents are made. --list says what was measured when, how long it took and how many
commits have changed it since; --tables only makes the tables and figures.
"""

import argparse
import datetime
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import torch

from bench.measure.pages import PAGES, RECORDS, ROOT, block, blocks, changes_since, filled, git, record, uncommitted
from bench.measure.parts import MADE, PARTS, words
from bench.measure.tables import FIGURES, SUMMARIES, TABLES

OUT = Path("out/measure")
ENVIRONMENT = dict(
    OMP_NUM_THREADS="1",
    ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
    MALLOC_TRIM_THRESHOLD_="2000000000",
    MALLOC_MMAP_THRESHOLD_="2000000000",
)
"""One thread, and freed memory is kept: a quarter less time in batches."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--tables", action="store_true")
    parser.add_argument("--independent", type=Path)
    parser.add_argument("--recordings", type=Path)
    args = parser.parse_args()
    if unknown := set(args.parts) - set(PARTS):
        parser.error(f"no such part: {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    if args.list:
        print("\n".join(f"{name:16s} {state(name)}" for name in PARTS))
        return
    if not args.tables:
        for name in args.parts or [name for name in PARTS if is_due(name)]:
            measure(name, dict(independent=args.independent, recordings=args.recordings))
    write_pages()


def state(name: str) -> str:
    """One line: what was measured when, and what has changed since."""
    found = record(name)
    if found is None:
        return "never measured"
    changes = changes_since(found["revision"], PARTS[name].paths)
    took = f"{found['seconds']:.0f} s" if found["seconds"] else "taken from the documents"
    since = f"old: {len(changes)} commits have changed it since" if changes else "current"
    return f"{found['revision']} {found['date']}, {took}; {since}"


def is_due(name: str) -> bool:
    """Whether a part was never measured, or has changed since."""
    found = record(name)
    return found is None or bool(changes_since(found["revision"], PARTS[name].paths))


def measure(name: str, elsewhere: dict[str, Path | None]) -> None:
    """Run a part and write its record; `elsewhere` are the folders of data that are not distributed."""
    part = PARTS[name]
    if changed := uncommitted(part.paths):
        sys.exit(f"measure {name}: commit {', '.join(changed)} first, so that the record can name a revision")
    folder = elsewhere[part.data] if part.data in elsewhere else OUT / str(part.data)
    if folder is None:
        print(f"{name}: left out, its data are not distributed; --{part.data} FOLDER names them")
        return
    if part.needs_gpu and not torch.cuda.is_available():
        print(f"{name}: left out, torch finds no GPU here")
        return
    if part.python and not (ROOT / part.python).exists():
        print(f"{name}: left out, there is no {part.python} here")
        return
    made, result = MADE[part.data] if part.data else (), OUT / f"{name}.json"
    began, load = time.perf_counter(), os.getloadavg()[0]
    for command in (*made, f"{part.command} --json {result}"):
        print(f"{name}: python -m {command}", flush=True)
        called = [part.python or sys.executable, "-m", *words(command, str(folder))]
        subprocess.run(called, cwd=ROOT, check=True, env=os.environ | ENVIRONMENT)
    results = json.loads((ROOT / result).read_text())
    machine, seconds = results.pop("machine"), time.perf_counter() - began
    revision = git("rev-parse", "--short=7", "HEAD").strip()
    processor = machine["cuda"] if part.needs_gpu else machine["processor"]
    results = SUMMARIES[name](results) if name in SUMMARIES else results
    found = dict(
        command=part.shown,
        revision=revision,
        date=datetime.date.today().isoformat(),
        processor=processor,
        cores=os.cpu_count(),
        load=max(load, os.getloadavg()[0]),
        seconds=round(seconds),
        torch=machine["torch"],
        results=beside_others(name, processor, results | {"revision": revision}) if part.by_processor else results,
    )
    RECORDS.mkdir(exist_ok=True)
    (RECORDS / f"{name}.json").write_text(json.dumps(rounded(found), indent=1) + "\n")


def beside_others(name: str, processor: str, results: dict) -> dict:
    """Results by processor: those of this one first, then those that other processors gave before."""
    before = record(name)
    others = before["results"] if before else {}
    return {processor: results} | {other: kept for other, kept in others.items() if other != processor}


def rounded(value: object) -> object:
    """Numbers to five digits, which is as much as any table shows.

    >>> rounded({"a": [1.23456, 3, "b"]})
    {'a': [1.2346, 3, 'b']}
    """
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def write_pages() -> None:
    """The tables of all pages, and the figures."""
    for page in PAGES:
        text = page.read_text()
        made = {name: block(*TABLES[name]) if all(map(record, TABLES[name][0])) else old for name, old in blocks(text).items()}
        if (new := filled(text, made)) != text:
            page.write_text(new)
            print(f"written: {page.relative_to(ROOT)}")
    for path, (part, draw) in FIGURES.items():
        if found := record(part):
            draw(found["results"], ROOT / path)


if __name__ == "__main__":
    main()
