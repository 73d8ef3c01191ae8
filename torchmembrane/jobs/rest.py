"""The rest state of a recording: the markers in the recording's own images without contact."""

from collections.abc import Iterator
from itertools import islice
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..errors import MembraneError
from ..files.order import warn_of_file_times
from ..track import Tracker
from ..user_warnings import warn_user
from .decode import Source, existing_files, files_of, source_file_of, sources
from .inputs import Inputs, find_inputs, frame_name, of_first_view

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

FIRST = "first:"


def recording_rest(reconstructor: "Reconstructor", arguments: list[str], inputs: Inputs) -> Tensor:
    """Return the marker positions at rest, `[D, 2]` px, averaged over images without contact.

    Args:
        reconstructor: reconstructor of the sensor.
        arguments: image files, globs or folders; or `first:N` for the first N frames of the inputs.
        inputs: inputs of the call.

    Raises:
        MembraneError: an image is missing, cannot be read, or does not show the markers.
    """
    chosen: Iterator[Source]
    if arguments[0].startswith(FIRST):
        count = arguments[0].removeprefix(FIRST)
        if len(arguments) > 1 or not count.isdigit() or not int(count):
            raise MembraneError(f"--rest {' '.join(arguments)}: expected images, or first:N with N of at least 1")
        warn_of_file_times(inputs.images)
        chosen = islice(sources(inputs, reconstructor), int(count))
    else:
        chosen = sources(of_first_view(find_inputs(arguments), inputs.views, inputs.topics), reconstructor)
    said = f"--rest {' '.join(arguments)}"
    images = [_loaded(source, reconstructor, said) for source in chosen]
    try:
        rest = reconstructor.observer.rest_of(torch.cat(images)).pixels
    except MembraneError as error:
        raise MembraneError(f"{said}: {error}") from error
    _warn_of_contact(reconstructor, rest, said)
    return rest


def rest_hash(arguments: list[str], inputs: Inputs) -> str:
    """Return the content hash of the images of the rest state; "" for `first:N`, whose images are among the inputs.

    Args:
        arguments: as for `recording_rest`.
        inputs: inputs of the call.

    Raises:
        MembraneError: an image is missing or cannot be read.
    """
    if not arguments or arguments[0].startswith(FIRST):
        return ""
    found = of_first_view(find_inputs(arguments), inputs.views, inputs.topics)
    files = [existing_files(path, found.views) for path in found.images] + [files_of(path, found) for path in found.videos]
    return source_file_of(*(file for each in files for file in each)).content_hash


def _loaded(source: Source, reconstructor: "Reconstructor", said: str) -> Tensor:
    try:
        return source.load(reconstructor).image
    except MembraneError as error:
        picture = "" if source.name == frame_name(source.file) else f", {source.name}"
        cause = str(error).removeprefix(f"{source.file}: ")
        raise MembraneError(f"{said}: {source.file}{picture}: {cause}") from error


def _warn_of_contact(reconstructor: "Reconstructor", rest: Tensor, said: str) -> None:
    """Warn if the rest images show a press, compared with the sensor's rest image, or a drift that looks like a press."""
    observer = reconstructor.observer
    pixels, before = (observer.by_view(located[None]) for located in (rest, observer.measured_rest))
    with torch.no_grad():
        result = reconstructor.from_pixels(pixels, rest_pixels=before[0])
    if Tracker(reconstructor).is_pressed(result):
        known = (
            f"of {float(result.force[0].norm()):.3g} {reconstructor.sensor.force_unit} "
            if reconstructor.finds_tractions
            else ""
        )
        warn_user(
            f"{said}: a contact {known}is found in the images that are taken for rest, and reads as none in the results. If "
            "something touches there, name images without contact"
        )
