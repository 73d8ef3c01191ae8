"""Photographs of a camera with its settings held, for rest images and weights."""

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np

from ..files.optional import load_opencv
from .sources import images_of, opened_camera

SETTLING = 30
"""Images after which what a camera sets by itself has settled."""
STALE = 3
"""Images that were taken before the settings were held, and wait in the driver."""
NEAR = 1e-3
"""By how much a setting that was set may be read otherwise, over itself."""


class Setting(NamedTuple):
    """A setting of a camera, as OpenCV calls its value and the switch that gives it to the camera; "" where there is none."""

    name: str
    value: str
    switch: str = ""


SETTINGS = (
    Setting("exposure", "EXPOSURE", "AUTO_EXPOSURE"),
    Setting("gain", "GAIN"),
    Setting("white balance", "WB_TEMPERATURE", "AUTO_WB"),
    Setting("focus", "FOCUS", "AUTOFOCUS"),
)


class Held(NamedTuple):
    """The names of the settings that are held, and of those that the driver does not let be held."""

    held: list[str]
    free: list[str]

    @property
    def said(self) -> str:
        """In words."""
        held = f"{', '.join(self.held)} held" if self.held else "nothing held"
        return held + (
            f"; the driver does not let {', '.join(self.free)} be held: keep the light as it is" if self.free else ""
        )


def hold(opened: Any) -> Held:
    """Take a camera's settings from its automatics, and set them to what they are now.

    Args:
        opened: `cv2.VideoCapture`.
    """
    cv2 = load_opencv("cameras need OpenCV")
    found: dict[bool, list[str]] = {True: [], False: []}

    def is_set(key: str, value: float) -> bool:
        number = getattr(cv2, f"CAP_PROP_{key}")
        return bool(opened.set(number, value)) and abs(opened.get(number) - value) <= NEAR * abs(value)

    for setting in SETTINGS:
        value = opened.get(getattr(cv2, f"CAP_PROP_{setting.value}"))
        by_hand = _by_hand(setting.switch, opened.getBackendName())
        taken = not setting.switch or is_set(setting.switch, by_hand)
        found[taken and is_set(setting.value, value)].append(setting.name)
    return Held(found[True], found[False])


def _by_hand(switch: str, backend: str) -> float:
    """The value of a switch that gives a setting to the user: of the exposure V4L2 and the other systems have their own."""
    return (1.0 if backend == "V4L2" else 0.25) if switch == "AUTO_EXPOSURE" else 0.0


class Photographs:
    """A camera's photographs: `for name, image in Photographs(0)`; the names are times, UTC, as `summary.csv` reads them.

    Args:
        camera: its number, or the path or address of a stream that OpenCV opens.
        size: width and height that are asked for and expected, px; None: the camera's own.

    Attributes:
        settings: which are held.

    Raises:
        MembraneError: OpenCV is missing or cannot open it; it gives images of another size, or none any more.
    """

    def __init__(self, camera: int | str, size: tuple[int, int] | None = None):
        opened = opened_camera(camera, size)
        self._images = images_of(opened, camera, size)
        self._skip(SETTLING)
        self.settings = hold(opened)
        self._skip(STALE)

    def _skip(self, count: int) -> None:
        for _ in range(count):
            next(self._images)

    def take(self, count: int, every: float = 0.0) -> Iterator[tuple[str, np.ndarray]]:
        """So many photographs, at least `every` seconds apart; the camera is released after the last one.

        Yields:
            The name, a time as `20260927T113829250`, and the image, RGB `[height, width, 3]` or grey `[height, width]`.
        """
        due = time.monotonic()
        try:
            for _ in range(count):
                image = next(self._images)
                while time.monotonic() < due:  # what comes meanwhile is dropped: none waits in the driver
                    image = next(self._images)
                due += every
                yield datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")[:-3], image
        finally:
            self._images.close()
