"""A recording's own rest: the markers in images of it without contact."""

from collections.abc import Iterator
from itertools import islice
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..errors import MembraneError
from ..files.order import warn_of_file_times
from .decode import Source, sources
from .inputs import Inputs, find_inputs

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

FIRST = "first:"


def recording_rest(reconstructor: "Reconstructor", arguments: list[str], inputs: Inputs) -> Tensor:
    """The markers at rest, `[D, 2]` px, averaged over images without contact.

    Args:
        reconstructor: the sensor's.
        arguments: image files, globs or folders; or `first:N`, the first N frames of the inputs.
        inputs: of the call.

    Raises:
        MembraneError: no such image, one that cannot be read, or one that does not show the markers.
    """
    chosen: Iterator[Source]
    if arguments[0].startswith(FIRST):
        count = arguments[0].removeprefix(FIRST)
        if len(arguments) > 1 or not count.isdigit() or not int(count):
            raise MembraneError(f"--rest {' '.join(arguments)}: expected images, or first:N with N of at least 1")
        warn_of_file_times(inputs.images)
        chosen = islice(sources(inputs, reconstructor), int(count))
    else:
        chosen = sources(find_inputs(arguments), reconstructor)
    images = [source.load(reconstructor) for source in chosen]
    try:
        return reconstructor.observer.rest_of(torch.cat(images)).pixels
    except MembraneError as error:
        raise MembraneError(f"--rest {' '.join(arguments)}: {error}") from error
