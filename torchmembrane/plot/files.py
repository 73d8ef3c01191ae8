"""Figures as PNG files that name the command which drew them. This module does not load matplotlib."""

from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from ..files.atomic import make_folder, whole_file
from ..files.safe_read import DAMAGE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save(drawing: "Figure", path: str | Path, command: str = "") -> None:
    """Write a figure as PNG, atomically.

    Args:
        drawing: the figure.
        path: path of the file; its folder is created if necessary.
        command: name of the command that draws the figure, stored in the file for `drawn_by`.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     save(Figure(), Path(folder) / "empty.png")
        ...     [path.name for path in Path(folder).iterdir()]
        ['empty.png']
    """
    path = Path(path)
    make_folder(path.parent)
    with whole_file(path) as partial:
        drawing.savefig(partial, format="png", metadata={"Software": _software(command)})


def drawn_by(command: str, path: Path) -> bool:
    """Return whether a file is a figure drawn by this command of torchmembrane, which may then overwrite it.

    Args:
        command: name of the command, as given to `save`.
        path: path of any file.

    Example:
        >>> drawn_by("check", Path("examples/rest.png"))
        False
    """
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return image.info.get("Software") == _software(command)
    except DAMAGE:
        return False


def _software(command: str) -> str:
    return f"torchmembrane {command}".rstrip()
