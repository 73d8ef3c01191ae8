"""What every benchmark writes: results with the machine and versions that gave them."""

import json
import os
import platform
import re
import statistics
import time
from importlib.metadata import version
from pathlib import Path

import torch


def median_seconds(function, repeats: int = 7) -> tuple[float, float]:
    """Median and spread (max - min) of the wall time of `function()`, after one warm-up call."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return statistics.median(times), max(times) - min(times)


def write(path: Path | None, results: dict) -> None:
    """Write the results with the machine's description, if a path is given."""
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(dict(machine=machine(), **results), indent=1))
        print(f"written to {path}")


def processor() -> str:
    """Name of the processor and the widest vectors that torch uses on it, as in "Intel Xeon Processor, AVX512"."""
    name, cpuinfo = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if cpuinfo.exists() and (found := re.search(r"^model name\s*: (.+)", cpuinfo.read_text(), re.M)):
        name = re.sub(r"\((R|TM)\)", "", found[1])
    return f"{name}, {torch.backends.cpu.get_cpu_capability()}"


def machine() -> dict:
    """The processor, and the versions of what was measured."""
    versions = {name: version(name) for name in ("torch", "kornia", "numpy", "scipy", "torchmembrane")}
    return dict(
        processor=processor(),
        cores=os.cpu_count(),
        torch_threads=torch.get_num_threads(),
        python=platform.python_version(),
        cuda=torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        **versions,
    )
