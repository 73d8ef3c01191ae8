"""Figures as files: written whole, and known by the command that drew them. Nothing here loads matplotlib."""

from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from ..files.atomic import make_folder, whole_file
from ..files.safe_read import DAMAGE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save(drawing: "Figure", path: str | Path, command: str = "") -> None:
    """Write a figure as PNG, whole or not at all.

    Args:
        drawing: the figure.
        path: the file; its folder is made if need be.
        command: that draws it; the file says so, and `drawn_by` reads it.

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
    """Whether a file is a figure that a command of torchmembrane drew, which may draw it anew.

    Args:
        command: as for `save` was told.
        path: any file.

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
