"""Access to stored results: a folder of `torchmembrane reconstruct` as a sequence of frames that are loaded on demand."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import MembraneError, check_arguments, expect
from ..files.optional import load_pandas
from ..files.order import in_order
from ..user_warnings import warn_user
from .frame_table import PART_ROWS, read_part
from .frames import frames_of
from .npz import load_frame, stack_frames
from .reconstruction import Frame, Reconstruction
from .store import MESH, Mesh

AGAIN = "run the same reconstruct command again, which does its frame again, or delete it"


@check_arguments
def read_results(folder: str | Path) -> "Results":
    """Open the results in a folder, in either format.

    Only the names and `mesh.npz` are read at first; frames are read on access. Failed frames are included, with NaN and their
    status; images that could not be read have no frame (`summary.csv` lists them). Frames that are written to the folder later
    are not included. A warning names damaged results; they are included, and reading one of them raises an error.

    Args:
        folder: the folder given to `torchmembrane reconstruct --out`.

    Returns:
        The frames, in name order.

    Raises:
        MembraneError: the folder contains no results, or no frame.

    Example:
        Here the folder is written by hand, for a surface without vertices; `torchmembrane reconstruct` writes such folders.

        >>> import numpy as np, tempfile
        >>> from torchmembrane.results.frame_shapes import SHAPES, shape_of
        >>> from torchmembrane.results.npz import save_frame
        >>> folder = Path(tempfile.mkdtemp())
        >>> none = {2: np.zeros((0, 2)), 3: np.zeros((0, 3))}
        >>> arrays = [none[3], none[3], none[3], np.zeros(0), np.zeros(2), none[2], none[2], np.zeros(2)]
        >>> Mesh(*arrays, "mm", "N", "finger", "", "force-balance", "neo_hookean", "", "npz").save(folder / MESH)
        >>> for name in ("rest", "press"):
        ...     save_frame(folder / f"{name}.npz", {key: np.zeros(shape_of(key, {"V": 0, "D": 0, "P": 4})) for key in SHAPES})
        >>> results = read_results(folder)
        >>> results.names, results.mesh.length_unit, int(results["press"]["status"])
        (['press', 'rest'], 'mm', 0)
        >>> [float(frame["pressure"]) for frame in results], results.batch().pressure
        ([0.0, 0.0], tensor([0., 0.], dtype=torch.float64))
    """
    return Results(Path(folder))


class FoundFrame(NamedTuple):
    """A requested frame, and the folder that should contain its `mesh.npz`."""

    name: str
    frame: Frame
    home: Path


@check_arguments
def read_frame(path: str | Path, name: str | None = None) -> FoundFrame:
    """Read one frame from a file or a folder of results.

    Args:
        path: NAME.npz, a part of a Parquet dataset, or a folder of results.
        name: name of the frame in a part or a folder; default: the first.

    Raises:
        MembraneError: the path contains no results, or no frame of this name.
    """
    path = Path(path)
    if path.is_dir():
        results = read_results(path)
        chosen = results.names[0] if name is None else name
        return FoundFrame(chosen, results[chosen], path)
    if path.suffix != ".parquet":
        expected = f"{path.stem!r} or no name: {path} holds only this frame; to choose a frame, give a folder or a Parquet part"
        expect(name in (None, path.stem), "name of the frame (--frame)", name, expected)
        return FoundFrame(path.stem, load_frame(path), path.parent)
    frames = read_part(path)
    first = min(frames, key=in_order)
    chosen = first if name is None else name
    if chosen not in frames:
        raise MembraneError(f"{path}: no frame {chosen!r}; expected one of its {len(frames)} frames, such as {first!r}")
    return FoundFrame(chosen, frames[chosen], path.parent.parent if path.parent.name == "frames" else path.parent)


class Results:
    """The frames of a folder of results: a sequence in name order, and a mapping by name.

    `len(results)` is the number of frames. `for frame in results` yields each as a dict of arrays (`Reconstruction.frame`), in
    the order of `results.names`; `results["press"]` returns one, and `"press" in results` tests for it. Frames are read from
    disk on each access and not kept, so that iteration over a folder of any size needs little memory. For a Parquet dataset,
    iteration is faster than access by name, which reads a part of the dataset each time.

    Args:
        folder: the folder of results.

    Attributes:
        folder: the folder of results.
        mesh: the data that all frames share: rest surface, triangles, units, settings.
        names: names of all frames, in natural order: numbers within them are compared as numbers.

    Raises:
        MembraneError: the folder contains no results, or no frame.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.mesh = Mesh.load(folder / MESH)
        self._frames = frames_of(folder, self.mesh)
        self.names = sorted(self._frames.names(), key=in_order)
        if damaged := self._frames.damaged:
            more = f" and {len(damaged) - 1} more" if damaged[1:] else ""
            warn_user(f"{damaged[0]}{more}: damaged, and refused when read; {AGAIN}")
        self._known = frozenset(self.names)
        if not self.names:
            raise MembraneError(f"{folder}: no frames; expected results of `torchmembrane reconstruct`")

    def __len__(self) -> int:
        return len(self.names)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self._known

    def __getitem__(self, name: str) -> Frame:
        if name not in self:
            first = f"the first of which is {self.names[0]!r}"
            raise MembraneError(f"{self.folder}: no frame {name!r}; expected one of its {len(self)} frames, {first}")
        return self._read([name])[0]

    def __iter__(self) -> Iterator[Frame]:
        names = iter(self.names)
        while group := list(islice(names, PART_ROWS)):
            yield from self._read(group)

    def _read(self, names: list[str]) -> list[Frame]:
        frames = self._frames.read(names)
        for name, frame in zip(names, frames, strict=True):
            self.mesh.check(frame, f"{self.folder}: {name}")
        return frames

    def __repr__(self) -> str:
        return f"Results({str(self.folder)!r}: {len(self)} frames of {self.mesh.name!r})"

    def batch(self) -> Reconstruction:
        """Load all frames as one batch of tensors on the CPU, in the order of `names`.

        Returns:
            A `Reconstruction` whose tensors have `len(self)` rows; all frames are in memory at once.
        """
        return stack_frames(list(self))

    def to_pandas(self) -> Any:
        """Return the frames' scalars (pressure, residual, status ...) as a table.

        Returns:
            A `pandas.DataFrame` with one row per frame, indexed by name, and one column per scalar field.

        Raises:
            MembraneError: pandas is not installed (extra `pandas`).
        """
        pandas = load_pandas()
        rows = [{key: array[()] for key, array in frame.items() if array.ndim == 0} for frame in self]
        return pandas.DataFrame(rows, index=pandas.Index(self.names, name="name"))
