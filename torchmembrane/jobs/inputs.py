"""The inputs of a job: the files, globs and folders given in a call, resolved to images, videos, bags and image stacks in the
order of the call."""

import glob
import os
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from filecmp import cmp
from pathlib import Path
from typing import NamedTuple

from ..errors import MembraneError
from ..files.images import IMAGES, VIDEOS, picture_count
from ..files.order import in_order
from ..files.provenance import printable
from ..files.system_files import is_hidden, is_of_system
from ..integrations.rosbag import BAGS, METADATA, is_bag, metadata_of
from ..results.store import MESH
from ..sensor.view_images import view_files, view_of

PICTURE = re.compile("[0-9]{6}|[1-9][0-9]{6,}")
"""Number of a picture in a frame's name, as `picture_name` writes it."""


class Inputs(NamedTuple):
    """Image and video files, in the order of the call.

    Attributes:
        images: image files.
        videos: files of several frames: videos, image files of several pictures, and bags, given by their `metadata.yaml` or a
            storage file.
        topic: image topic of the bags; None: the only one.
        views: names of the views that have images of their own; `images`, and the videos that are not bags, are those of the
            first view.
        topics: image topic in the bags for each of these views.
        rest: images of the sensor at rest that were found in a folder and are skipped.
    """

    images: list[Path]
    videos: list[Path]
    topic: str | None = None
    views: Sequence[str] = ()
    topics: Sequence[str] = ()
    rest: Sequence[Path] = ()

    @property
    def image_topics(self) -> Sequence[str | None]:
        """Image topics of the bags, one per view."""
        return self.topics or (self.topic,)

    @property
    def bags(self) -> list[Path]:
        """The videos that are bags."""
        return [path for path in self.videos if is_bag(path)]

    @property
    def need_pyav(self) -> bool:
        """Whether some of the videos are neither bags nor image files."""
        return any(not is_bag(path) and not picture_count(path, 1) for path in self.videos)

    def video_of(self, name: str) -> Path | None:
        """Return the video with a frame of this name, STEM_NUMBER, or None.

        Example:
            >>> Inputs([], [Path("day/press.mp4")]).video_of("press_000012").name
            'press.mp4'
        """
        stem, _, number = name.rpartition("_")
        return next((path for path in self.videos if frame_name(path) == stem and PICTURE.fullmatch(number)), None)


def frame_name(path: Path) -> str:
    r"""Return the name of an image's frame, or the prefix of a video's frame names, in UTF-8: the file name without its
    extension, or the name of a bag's folder.

    Example:
        >>> frame_name(Path("day/caf\udce9.png"))
        'caf\\xe9'
    """
    return printable(Path(os.path.abspath(path.parent)).name if path.name == METADATA else path.stem)


def picture_name(path: Path, number: int) -> str:
    """Return the name of a picture in a video or bag.

    Example:
        >>> picture_name(Path("day/press.mp4"), 12)
        'press_000012'
    """
    return f"{frame_name(path)}_{number:06d}"


def find_inputs(arguments: Iterable[str | Path], video: bool = False, topic: str | None = None) -> Inputs:
    """Resolve files, globs and folders to files.

    Args:
        arguments: paths of files, folders (their images in name order, or the bag that the folder is) and glob patterns.
            Numbers in names are sorted by value: 2 before 10. Hidden files and files of operating systems are ignored.
        video: whether to treat every file as a video.
        topic: image topic of the bags.

    Returns:
        The files, images and videos each in the order of the call; if that is the lexical order of the names, as shells produce
        it, the files are sorted by the numbers in their names instead.

    Raises:
        MembraneError: an argument matches no file, or two frames would have the same name.

    Example:
        >>> [path.name for path in find_inputs(["examples/*_*.png"]).images]
        ['flat_plate.png', 'press_on_axis.png', 'two_contacts.png']
    """
    paths = [path for argument in arguments for path in _expanded(str(argument), VIDEOS if video else IMAGES)]
    paths = [path for path in paths if not is_of_system(path)] or paths  # a shell's pattern may give them
    if paths == sorted(paths):  # as a shell expands a pattern
        paths.sort(key=in_order)
    is_video = {path: video or path.suffix.lower() in VIDEOS or is_bag(path) or picture_count(path, 2) > 1 for path in paths}
    inputs = Inputs([path for path in paths if not is_video[path]], [path for path in paths if is_video[path]], topic)
    if topic is not None and not inputs.bags:
        raise MembraneError(f"--topic {topic}: none of the inputs is a bag, {' or '.join(BAGS)}")
    for name, count in Counter(map(frame_name, paths)).items():
        if count > 1:
            twins = ", ".join(printable(str(path)) for path in paths if frame_name(path) == name)
            raise MembraneError(
                f"several inputs have the name {name!r} ({twins}), so their results would have the same name: rename them, or "
                "reconstruct them in separate calls with different output folders"
            )
    for image in inputs.images:
        if of_video := inputs.video_of(frame_name(image)):
            raise MembraneError(
                f"{image}: a frame of {of_video} has the same name: rename one, or reconstruct them in separate calls with "
                "different output folders"
            )
        if f"{image.stem}.npz" == MESH:
            raise MembraneError(f"{image}: its result would be {MESH}, which holds the mesh; rename the image")
    return inputs


def without_rest(inputs: Inputs, arguments: Iterable[str | Path], files: Iterable[Path]) -> Inputs:
    """Remove the sensor's rest images from the contents of folders, unless nothing else remains.

    `simulate` and calibration write the sensor's rest image beside the other images; a file given by its own name is kept.

    Args:
        inputs: inputs as returned by `find_inputs`.
        arguments: the arguments of that call.
        files: files of the sensor, as returned by `files_of`.

    Example:
        >>> found = without_rest(find_inputs(["examples"]), ["examples"], [Path("examples/rest.png")])
        >>> [path.name for path in found.rest], Path("examples/rest.png") in found.images
        (['rest.png'], False)
    """
    folders = [Path(argument) for argument in arguments if Path(argument).is_dir()]
    known = [path for path in files if path.suffix.lower() in IMAGES and path.is_file()]
    beside = [path for path in inputs.images if path.parent in folders]
    rest = [path for path in beside if any(cmp(path, image, shallow=False) for image in known)]
    images = [path for path in inputs.images if path not in rest]
    return inputs._replace(images=images, rest=rest) if images or inputs.videos else inputs


def of_first_view(inputs: Inputs, views: Sequence[str], topics: Sequence[str] = ()) -> Inputs:
    """Reduce inputs to one image or video per frame or recording: for views with images of their own, NAME_VIEW.png or
    NAME_VIEW.mp4, that of the first view stands for all. If the first view lacks an image, its path is given nevertheless.

    Args:
        inputs: inputs as returned by `find_inputs`.
        views: names of the sensor's views with images of their own; empty for a single view, or for regions of one image.
        topics: image topics of these views in bags.

    Raises:
        MembraneError: a file belongs to no view, a recording lacks the video of a view, or a bag is given without topics.

    Example:
        >>> both = Inputs([Path("press_left.png"), Path("press_right.png")], [])
        >>> [path.name for path in of_first_view(both, ["left", "right"]).images]
        ['press_left.png']
    """
    if not views:
        return inputs
    if inputs.bags and not topics:
        wanted = " ".join(f"--topic {view}=TOPIC" for view in views)
        raise MembraneError(f"{inputs.bags[0]}: a bag with several views; expected the topic of each, {wanted}")
    bags = inputs.bags
    images, videos = _firsts(inputs.images, views), _firsts([path for path in inputs.videos if path not in bags], views)
    for path in videos:
        files = view_files(path, views)
        if missing := [file for file in files if not file.exists()]:
            there = next(file for file in files if file.exists())
            raise MembraneError(
                f"{there}: no {missing[0].name} beside it; expected a video of each view, of the same recording"
            )
    kept = [path for path in inputs.videos if path in bags or path in videos]
    return inputs._replace(images=images, videos=kept, views=views, topics=topics)


def _firsts(paths: list[Path], views: Sequence[str]) -> list[Path]:
    """Return the first view's path for each NAME among the files NAME_VIEW of all views."""
    firsts: dict[Path, Path] = {}
    for path in paths:
        view = view_of(path, views)
        if view is None:
            raise MembraneError(f"{path}: of no view; expected NAME_{', NAME_'.join(views)} of each frame")
        frame = path.with_name(path.stem.removesuffix(view))
        if frame not in firsts or view == views[0]:
            firsts[frame] = path.with_name(f"{frame.name}{views[0]}{path.suffix}")
    return list(firsts.values())


def single_images(inputs: Inputs) -> list[Path]:
    """Return the image files of inputs that must be images, each in its own file.

    Raises:
        MembraneError: the inputs include a file of several pictures.
    """
    if inputs.videos:
        raise MembraneError(f"{inputs.videos[0]}: holds several pictures; expected images here, each as a file of its own")
    return inputs.images


def _expanded(argument: str, suffixes: Sequence[str]) -> list[Path]:
    path = Path(argument)
    if path.is_dir():
        files = (p for p in path.iterdir() if p.suffix.lower() in suffixes and p.is_file() and not is_hidden(p))
        found = metadata_of(path) or sorted(files, key=in_order)
        if not found:
            raise MembraneError(f"{path}: the folder holds no files {' '.join(suffixes)}; {_remedy(path)}")
        return found
    if path.exists():
        return [path]
    matches = map(Path, sorted(glob.glob(argument, recursive=True), key=in_order))
    found = [path for path in matches if path.is_file() and not is_of_system(path)]
    if not found:
        raise MembraneError(f"{argument}: no such file, no pattern that matches one; expected images, globs, folders")
    return found


def _remedy(folder: Path) -> str:
    """Return the remedy for a folder that holds no images."""
    if any(path.suffix.lower() in BAGS for path in folder.iterdir()):
        return f"expected images, or a bag with its {METADATA}, which `ros2 bag reindex {folder.name}` makes: or give its files"
    return "expected one or more"
