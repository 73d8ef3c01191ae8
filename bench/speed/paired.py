"""Two checkouts of the package against each other: the same work in turn, in one process each.

python -m bench.speed.paired A B [--sensor examples/sensor.toml] [--image examples/two_contacts.png] [--only WORK ...]
    [--turns 20] [--pairs 5] [--json FILE]

A, B: folders that hold `torchmembrane/`; of the package only what all its versions have is used. One thread. Every turn asks A,
B, B, A (the next B, A, A, B) for each piece of work, so that what slows the machine slows both alike. Printed for each piece:
medians of processor and wall time in ms; median and quartiles over the turns of the ratio B / A of both calls' sums. Where its
memory lies makes a process up to a tenth faster or slower for as long as it lives, so the turns are shared out among several
pairs of processes; what is left of that, a checkout against its own copy shows.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

WORK = ("cold 1", "cold 16", "warm 1", "energy 1", "energy 16", "locator 1", "locator 16")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def work(sensor: str, image: str, names: list[str]) -> Iterator[tuple[str, Callable[[], object]]]:
    """What is timed: force balance from rest and from its own result, minimum energy, the locator; batches of 1 and 16."""
    import torch

    from torchmembrane.reconstruct import Reconstructor

    balance, energy = (Reconstructor.from_file(sensor, estimator=name) for name in ("force-balance", "minimum-energy"))
    locator = getattr(balance, "observer", balance).locator
    for name in names:
        kind, batch = name.split()
        images = balance.read(image).expand(int(batch), -1, -1, -1).contiguous()
        if kind == "warm":
            with torch.no_grad():
                before = balance(images)
            yield name, lambda images=images, before=before: balance(images, before)
        else:
            module = {"cold": balance, "energy": energy, "locator": locator}[kind]
            yield name, lambda images=images, module=module: module(images)


def answer(sensor: str, image: str, names: list[str]) -> None:
    """A worker: does the work whose name it reads, and writes processor and wall seconds."""
    import torch

    torch.set_num_threads(1)
    with torch.no_grad():
        functions = dict(work(sensor, image, names))
        for function in functions.values():  # warm-up
            function()
        package = [module for name, module in sys.modules.items() if name.partition(".")[0] == "torchmembrane"]
        print(json.dumps([module.__file__ for module in package]), flush=True)
        for line in sys.stdin:
            wall, processor = time.perf_counter(), time.process_time()
            functions[line.strip()]()
            print(json.dumps((time.process_time() - processor, time.perf_counter() - wall)), flush=True)


class Worker:
    """A process that has the package of one checkout."""

    def __init__(self, checkout: Path, sensor: Path, image: Path, names: list[str]):
        files = [str(path.resolve()) for path in (sensor, image)]
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--worker", *files, *names],
            env=os.environ | ONE_THREAD | {"PYTHONPATH": str(checkout.resolve())},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        strangers = [path for path in self._answer() if not Path(path).is_relative_to(checkout.resolve())]
        if strangers:
            raise SystemExit(f"{checkout}: imports {strangers[0]}; expected a folder that holds torchmembrane/")

    def _answer(self) -> list:
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"a worker ended with {self.process.wait()}")
        return json.loads(line)

    def __call__(self, name: str) -> list[float]:
        """Processor and wall seconds of one piece of work."""
        self.process.stdin.write(name + "\n")
        self.process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()


def timed(workers: list[Worker], names: list[str], turns: int) -> dict[str, np.ndarray]:
    """Seconds `[turns, checkout, call, (processor, wall)]` of each piece of work."""
    seconds = {name: np.zeros((turns, 2, 2, 2)) for name in names}
    for turn in range(turns):
        order = (0, 1, 1, 0) if turn % 2 == 0 else (1, 0, 0, 1)
        for name in names:
            for call, which in enumerate(order):
                seconds[name][turn, which, call // 2] = workers[which](name)
    return seconds


def summary(name: str, seconds: np.ndarray) -> dict:
    """Medians in ms and ratios B / A of seconds `[turns, checkout, call, (processor, wall)]`."""
    medians = 1000 * np.median(seconds, axis=(0, 2))
    row = dict(work=name)
    for kind, ab, both in zip(("processor", "wall"), medians.T, np.moveaxis(seconds.sum(2), -1, 0), strict=True):
        lower, ratio, upper = np.quantile(both[:, 1] / both[:, 0], (0.25, 0.5, 0.75))
        row[kind] = dict(a=float(ab[0]), b=float(ab[1]), ratio=float(ratio), quartiles=[float(lower), float(upper)])
    return row


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", type=Path, nargs=2, metavar="CHECKOUT")
    parser.add_argument("--sensor", type=Path, default=Path("examples/sensor.toml"))
    parser.add_argument("--image", type=Path, default=Path("examples/two_contacts.png"))
    parser.add_argument("--only", nargs="+", choices=WORK, default=list(WORK), metavar="WORK", help=", ".join(WORK))
    parser.add_argument("--turns", type=int, default=20)
    parser.add_argument("--pairs", type=int, default=5, help="of processes (default: %(default)s)")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    parts = []
    for pair in range(args.pairs):
        workers = [Worker(checkout, args.sensor, args.image, args.only) for checkout in args.checkouts]
        parts.append(timed(workers, args.only, len(range(pair, args.turns, args.pairs))))
        for worker in workers:
            worker.close()
    rows = [summary(name, np.concatenate([part[name] for part in parts])) for name in args.only]
    for row in rows:
        for kind in ("processor", "wall"):
            found = row[kind]
            print(
                f"{row['work']:10s} {kind:9s} A {found['a']:7.2f} ms, B {found['b']:7.2f} ms, B / A {found['ratio']:.3f} "
                "({:.3f} .. {:.3f})".format(*found["quartiles"])
            )
    if args.json:
        from bench.data.record import write

        write(args.json, dict(checkouts=[str(checkout) for checkout in args.checkouts], turns=args.turns, rows=rows))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        answer(*sys.argv[2:4], sys.argv[4:])
    else:
        main()
