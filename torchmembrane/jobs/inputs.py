"""The inputs of a job: the files, globs and folders of a call, resolved to images, videos, bags and stacks of images in the
order of the call."""

import glob
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from filecmp import cmp
from pathlib import Path
from typing import NamedTuple

from ..errors import MembraneError
from ..files.images import picture_count
from ..files.order import in_order
from ..files.provenance import printable
from ..files.system_files import is_hidden, is_of_system
from ..integrations.rosbag import BAGS, METADATA, is_bag, metadata_of
from ..results.store import MESH
from ..sensor.view_images import view_files

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEOS = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".gif")


class Inputs(NamedTuple):
    """Image and video files in the order of the call.

    Attributes:
        images: image files.
        videos: files of several frames: videos, image files of several pictures, and bags, which are their `metadata.yaml`
            or a storage file.
        topic: topic of the bags' images; None: the only one.
        views: names of the views that have images of their own; `images` and the videos that are no bags are the first one's.
        topics: topics of the bags' images of each of these views.
        rest: images of the sensor at rest that were in a folder, and are left out.
    """

    images: list[Path]
    videos: list[Path]
    topic: str | None = None
    views: Sequence[str] = ()
    topics: Sequence[str] = ()
    rest: Sequence[Path] = ()

    @property
    def image_topics(self) -> Sequence[str | None]:
        """Of the bags' images, of each view."""
        return self.topics or (self.topic,)

    @property
    def bags(self) -> list[Path]:
        """The videos that are bags."""
        return [path for path in self.videos if is_bag(path)]

    @property
    def need_pyav(self) -> bool:
        """Whether some of the videos are neither bags nor images."""
        return any(not is_bag(path) and not picture_count(path, 1) for path in self.videos)

    def video_of(self, name: str) -> Path | None:
        """The video whose frame would have this name, STEM_NUMBER.

        Example:
            >>> Inputs([], [Path("day/press.mp4")]).video_of("press_000012").name
            'press.mp4'
        """
        stem, _, number = name.rpartition("_")
        return next((path for path in self.videos if frame_name(path) == stem and number.isdigit()), None)


def frame_name(path: Path) -> str:
    r"""The name of an image's frame, or the first part of the names of a video's: the file's, without its ending, or the
    bag's folder's, in UTF-8.

    Example:
        >>> frame_name(Path("day/caf\udce9.png"))
        'caf\\xe9'
    """
    return printable(Path(os.path.abspath(path.parent)).name if path.name == METADATA else path.stem)


def picture_name(path: Path, number: int) -> str:
    """The name of a picture of a video or bag.

    Example:
        >>> picture_name(Path("day/press.mp4"), 12)
        'press_000012'
    """
    return f"{frame_name(path)}_{number:06d}"


def find_inputs(arguments: Iterable[str | Path], video: bool = False, topic: str | None = None) -> Inputs:
    """Files, globs and folders as files.

    Args:
        arguments: paths of files, folders (their images in name order, or the bag that it is) and glob patterns. Numbers in
            names count as numbers: 2 before 10. Hidden files and those that operating systems leave in folders are ignored.
        video: take every file for a video.
        topic: topic of the bags' images.

    Returns:
        The files, images and videos each in the order of the call; where that is the plain order of their names, which shells
        give, in that of the numbers in them.

    Raises:
        MembraneError: an argument names no file, or two frames would have one name.

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
                f"two inputs have the name {name!r} ({twins}), as would their results: rename one, or use two calls"
            )
    for image in inputs.images:
        if of_video := inputs.video_of(frame_name(image)):
            raise MembraneError(f"{image}: a frame of {of_video} has the same name; use two calls")
        if f"{image.stem}.npz" == MESH:
            raise MembraneError(f"{image}: its result would be {MESH}, which holds the mesh; rename the image")
    return inputs


def without_rest(inputs: Inputs, arguments: Iterable[str | Path], files: Iterable[Path]) -> Inputs:
    """Inputs without the sensor's rest images among what folders hold, unless there is nothing else.

    `simulate` and calibration write the sensor's rest image beside the others; a file that is given by its own name stays.

    Args:
        inputs: as `find_inputs` gives them.
        arguments: what it was given.
        files: the sensor's, as of `files_of`.

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
    """Inputs with one image or video for each frame or recording: of views with images of their own, NAME_VIEW.png or
    NAME_VIEW.mp4, the first view's.

    Args:
        inputs: as for `find_inputs` gives them.
        views: names of the sensor's views with images of their own; none of one view, or of regions of one image.
        topics: of these views' images in bags.

    Raises:
        MembraneError: a file is of none of the views, a frame has no image of the first one, a recording no video of one of
            them, or a bag no topics.

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
        if missing := [file for file in view_files(path, views) if not file.exists()]:
            raise MembraneError(f"{path}: no {missing[0].name} beside it; expected a video of each view, of the same recording")
    kept = [path for path in inputs.videos if path in bags or path in videos]
    return inputs._replace(images=images, videos=kept, views=views, topics=topics)


def _firsts(paths: list[Path], views: Sequence[str]) -> list[Path]:
    """The first view's files among those of all."""
    firsts = [path for path in paths if path.stem.endswith(f"_{views[0]}")]
    names = {path.stem.removesuffix(views[0]) for path in firsts}
    for path in paths:
        stem = next((path.stem.removesuffix(view) for view in views if path.stem.endswith(f"_{view}")), None)
        if stem not in names:
            raise MembraneError(f"{path}: of no view, or of none of the frames; expected NAME_{', NAME_'.join(views)} of each")
    return firsts


def single_images(inputs: Inputs) -> list[Path]:
    """The image files of inputs that may only be images with a file each.

    Raises:
        MembraneError: there are files of several pictures among the inputs.
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
    """What to give in place of a folder that holds no images."""
    if any(path.suffix.lower() in BAGS for path in folder.iterdir()):
        return f"expected images, or a bag with its {METADATA}, which `ros2 bag reindex {folder.name}` makes: or give its files"
    return "expected one or more"
