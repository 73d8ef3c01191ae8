"""`torchmembrane view`: draw stored results, one as a figure, or all of a folder as a film or in Rerun."""

import os
import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import MembraneError
from .arguments import add_command, add_force, add_rerun, positive, wants_rerun
from .film import DEFAULT_RATE, MOST_FRAMES, FrameImages, draw_film, draw_sheet, images_in

if TYPE_CHECKING:
    from ..results.read import Results

PURPOSE = "draw stored results"
EXAMPLES = """\
examples:
  torchmembrane view results/press.npz --out press.png
  torchmembrane view results/press.npz --image press.png
  torchmembrane view results --frame press          # from a folder of either format; default: its first frame
  torchmembrane view results/frames/part-00000.parquet
  torchmembrane view results --video-out press.mp4 --images frames/        # all frames, in name order; or press.gif
  torchmembrane view results --plot forces.png      # over time; `results day2/ --plot ...`: side by side
  torchmembrane view results --sheet sheet.png      # all frames, small
  torchmembrane view results --rerun                # all frames, in the viewer Rerun; with --save press.rrd in a file
  torchmembrane view results --dataset press        # a data set for Hugging Face's datasets, with a card
  torchmembrane view results --frame press --ply press.ply   # the contact as a point cloud, without a figure

Without --out, a window is opened. If there is no display, NAME_view.png is written beside the results."""


def add_parser(commands: Any) -> None:
    """Add the parser of the command."""
    add = add_command(commands, "view", run, PURPOSE, EXAMPLES)
    what = "the result of a frame, NAME.npz, a part of a Parquet dataset, or a folder; with --plot also several folders"
    add("result", metavar="RESULT", type=Path, nargs="+", help=what)
    add("--frame", metavar="NAME", help="name of the frame in a folder or a part (default: the first)")
    add("--mesh", metavar="mesh.npz", type=Path, help="the mesh of the results (default: mesh.npz beside them)")
    add("--image", metavar="IMAGE", type=Path, help="the frame's image, drawn behind the flow")
    add("--out", metavar="FILE.png", type=Path, help="file of the figure (default: a window, if there is a display)")
    plot = "draw force, moment and pressure of a folder's frames over time; several folders side by side"
    add("--plot", metavar="FILE.png", type=Path, help=plot)
    add("--sheet", metavar="FILE.png", type=Path, help=f"draw at most {MOST_FRAMES} frames of a folder, small, on one sheet")
    film = "draw all frames of a folder, one after another: .mp4, .mov, .mkv (extra video) or .gif"
    add("--video-out", metavar="FILE", type=Path, help=film)
    add(
        "--rate",
        metavar="HZ",
        type=positive,
        default=DEFAULT_RATE,
        help="frames per second of --video-out (default: %(default)g)",
    )
    pictures = (
        "folder of the images of all frames, named like the frames (default: RESULT/images, where live --record stores them)"
    )
    add("--images", metavar="FOLDER", type=Path, help=pictures)
    add_rerun(add)
    add(
        "--dataset",
        metavar="FOLDER",
        type=Path,
        help="write all frames and their images as a data set for Hugging Face's datasets (extra parquet)",
    )
    add("--ply", metavar="FILE.ply", type=Path, help="write the touched vertices as a point cloud, and draw nothing")
    mesh = "write the whole surface as a mesh, .ply or .vtk, with the fields that --fields stored, and draw nothing"
    add("--surface", metavar="FILE", type=Path, help=mesh)
    add_force(add)


def run(arguments: Namespace) -> int:
    """Draw the results; return the exit code."""
    from ..files.order import warn_of_times
    from ..live.recording import times_of
    from ..results.read import read_results
    from ..user_warnings import warn_user

    rerun, folders = wants_rerun(arguments), arguments.result
    others = arguments.out, arguments.video_out, arguments.sheet, arguments.save, arguments.ply, arguments.surface
    alone = not rerun and all(made is None for made in (*others, arguments.dataset))
    if len(folders) > 1 and not (alone and arguments.plot):
        raise MembraneError(f"view: {len(folders)} results; expected one, or --plot FILE.png alone, which draws several")
    _spare_files(arguments, folders, arguments.plot, *others)
    arguments.result = folders[0]
    if arguments.plot is not None:
        _plot(folders, arguments.plot)
    if not rerun and all(made is None for made in (arguments.video_out, arguments.sheet, arguments.dataset)):
        return 0 if arguments.plot is not None else _draw(arguments)
    results, times = read_results(arguments.result), times_of(arguments.result)
    warn_of_times((name, times[name]) for name in results.names if name in times)
    found = images_in(arguments.images or arguments.result / "images")
    images = FrameImages(found, results.mesh)
    if found and not any(name in images.files for name in results.names):
        warn_user(f"{next(iter(found.values())).parent}: no image has the name of a frame; the frames are shown without images")
    if arguments.sheet is not None:
        draw_sheet(results, images, arguments.sheet)
    if arguments.video_out is not None:
        draw_film(results, images, arguments.video_out, arguments.rate)
    if arguments.dataset is not None:
        from ..results.data_set import write_data_set

        write_data_set(results, arguments.dataset, images.files, times)
        print(f"{len(results)} frames in {arguments.dataset}")
    if rerun:
        _show(results, images, times, arguments.save)
    return 0


def _spare_files(arguments: Namespace, folders: list[Path], *targets: Path | None) -> None:
    """Refuse to overwrite files other than earlier drawings."""
    from functools import partial

    from ..files.targets import refuse_overwriting
    from ..plot.files import drawn_by

    patterns = "*.npz", "frames/*.parquet", "*.csv"
    read = [path for folder in folders for pattern in patterns for path in folder.glob(pattern)]
    read += [path for path in (*folders, arguments.mesh, arguments.image) if path is not None]
    read += images_in(arguments.images or folders[0] / "images").values()
    written = [path for path in targets if path is not None]
    refuse_overwriting("view", written, read, arguments.force, partial(drawn_by, "view"))


def _plot(folders: list[Path], path: Path) -> None:
    """Draw the tables of folders over time, and print the path."""
    from ..plot.files import save
    from ..plot.series import series_figure
    from ..results.summary import read_summary

    runs = {str(folder): read_summary(folder) for folder in folders}
    units = {folder: f"{rows[0]['force_unit']} (force), {rows[0]['length_unit']} (length)" for folder, rows in runs.items()}
    if len(set(units.values())) > 1:
        said = "; ".join(f"{folder}: {unit}" for folder, unit in units.items())
        raise MembraneError(f"view --plot: {said}; expected the same units in all folders")
    save(series_figure(runs), path, "view")
    print(f"{sum(map(len, runs.values()))} frames of {', '.join(runs)} drawn in {path}")


def _show(results: "Results", images: FrameImages, times: dict[str, float], save: Path | None) -> None:
    from ..integrations.rerun import RerunLog

    with RerunLog(results.mesh, save) as log:
        for number, (name, frame) in enumerate(zip(results.names, results, strict=True)):
            log.add(number, frame, images.named(name), times.get(name))
    print(f"{len(results)} frames {f'written to {save}' if save else 'shown in Rerun'}")


def _draw(arguments: Namespace) -> int:
    from ..files.images import read_image
    from ..plot.drawing import show
    from ..plot.files import save
    from ..plot.frames import figure
    from ..results.point_cloud import save_contact_cloud
    from ..results.read import read_frame
    from ..results.store import MESH, Mesh
    from ..results.surface_file import save_surface

    name, frame, home = read_frame(arguments.result, arguments.frame)
    if arguments.ply:
        print(f"{name}: {save_contact_cloud(arguments.ply, frame)} points of the contact written to {arguments.ply}")
        return 0
    mesh = Mesh.load(arguments.mesh or home / MESH)
    mesh.check(frame, arguments.result)
    if arguments.surface:
        fields = save_surface(arguments.surface, frame, mesh)
        print(f"{name}: surface with {', '.join(fields)} in {arguments.surface}")
        return 0
    image = mesh.first_region(read_image(arguments.image)) if arguments.image else None
    drawing = figure(frame, mesh, image, name)
    if arguments.out is None and _has_display():
        show(drawing)
        return 0
    out = arguments.out or home / f"{name}_view.png"
    _spare_files(arguments, [arguments.result], out)
    save(drawing, out, "view")
    print(f"{name} drawn in {out}")
    return 0


def _has_display() -> bool:
    return sys.platform in ("win32", "darwin") or any(os.environ.get(key) for key in ("DISPLAY", "WAYLAND_DISPLAY"))
