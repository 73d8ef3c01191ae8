"""What tests simulate is kept in `out/tests/kept` between runs."""

import functools
import inspect
from collections.abc import Callable
from hashlib import blake2b
from pathlib import Path

import numpy as np
import torch
from filelock import FileLock

from torchmembrane.files.atomic import whole_file

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "out" / "tests" / "kept"
ROOMS = ("camera", "files", "markers", "mechanics", "presets", "sensor", "simulate", "solve", "surface")
"""Packages of `torchmembrane` on which a simulated press or image depends."""

Arrays = dict[str, np.ndarray]


def kept(name: str, parameters: object, make: Callable[[], Arrays]) -> Arrays:
    """Arrays that are made once, and again when their sources or parameters have changed.

    Safe in several processes: one makes them, the others wait for it.

    Args:
        name: of the file.
        parameters: what `make` depends on and its file does not say; their `repr` is compared.
        make: a function of the test's own file, all of which is compared.

    Returns:
        The arrays by their names.
    """
    key = blake2b(sources() + Path(inspect.getfile(make)).read_bytes() + repr(parameters).encode(), digest_size=8).hexdigest()
    path = FOLDER / f"{name}-{key}.npz"
    FOLDER.mkdir(parents=True, exist_ok=True)
    with FileLock(FOLDER / f"{name}.lock"):
        if not path.exists():
            arrays = make()
            for old in FOLDER.glob(f"{name}-*.npz"):
                old.unlink()
            with whole_file(path) as partial, partial.open("wb") as file:
                np.savez(file, **arrays)
        with np.load(path, allow_pickle=False) as found:
            return {key: found[key] for key in found}


@functools.cache
def sources() -> bytes:
    """A hash of all modules of `ROOMS`, and torch's version."""
    digest = blake2b(torch.__version__.encode())
    for room in ROOMS:
        for path in sorted((ROOT / "torchmembrane" / room).rglob("*.py")):
            digest.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    return digest.digest()
