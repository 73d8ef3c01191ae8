"""Photographs taken with locked camera settings, for rest images and weights."""

import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np

from ..files.optional import load_opencv
from .sources import images_of, opened_camera

SETTLING = 30
"""Number of images after which the camera's automatic settings have settled."""
STALE = 3
"""Number of images in the driver's queue that were taken before the settings were locked."""
QUEUED = 5
"""Number of images after which a driver's queue holds none that was taken before."""
NEAR = 1e-3
"""Largest relative difference between the value that was set and the value that is read back."""


class Setting(NamedTuple):
    """A camera setting: OpenCV's names of its value and of the switch of its automatic control; "" if there is none."""

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
    """Names of the settings that are locked, and of those that the driver does not allow to lock."""

    held: list[str]
    free: list[str]

    @property
    def said(self) -> str:
        """Return a description in words."""
        held = f"{', '.join(self.held)} held" if self.held else "nothing held"
        return held + (
            f"; the driver does not let {', '.join(self.free)} be held: keep the light as it is" if self.free else ""
        )


def hold(opened: Any) -> Held:
    """Switch off a camera's automatic settings, and fix them at their current values.

    Args:
        opened: an open `cv2.VideoCapture`.
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
    """Return the value that switches a setting to manual control; for the exposure, V4L2 differs from the other backends."""
    return (1.0 if backend == "V4L2" else 0.25) if switch == "AUTO_EXPOSURE" else 0.0


class Photographs:
    """Photographs of a camera: `for name, image in Photographs(0)`; names are UTC times, in the format of `summary.csv`.

    Args:
        camera: number of the camera, or the path or address of a stream that OpenCV opens.
        size: requested and expected width and height, px; None: the camera's own.

    Attributes:
        settings: which settings are locked.

    Raises:
        MembraneError: OpenCV is missing or cannot open the camera; the images have another size, or no image comes any more.
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

    def newest(self) -> np.ndarray:
        """Return an image that is taken from now on; those that wait in the driver are dropped."""
        self._skip(QUEUED)
        return next(self._images)

    def close(self) -> None:
        """Release the camera."""
        self._images.close()

    def take(self, count: int, every: float = 0.0) -> Iterator[tuple[str, np.ndarray]]:
        """Yield `count` photographs, at least `every` seconds apart; the camera is released after the last one.

        Yields:
            The name, a time such as `20260927T113829250`, and the image, RGB `[height, width, 3]` or grey `[height, width]`.
        """
        due, taken = time.monotonic(), ""
        try:
            for _ in range(count):
                image, now, name = next(self._images), time.monotonic(), _name_now()
                while now < due or name == taken:  # what comes meanwhile is dropped: none waits in the driver
                    image, now, name = next(self._images), time.monotonic(), _name_now()
                due, taken = time.monotonic() + every, name
                yield name, image
        finally:
            self.close()


def taken_together(cameras: Sequence[Photographs], count: int, every: float = 0.0) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Yield `count` times the photographs of all cameras, each taken when the one before it is, whatever waits in the drivers.

    Args:
        cameras: one or more cameras, which are released after the last photographs.
        count: number of photographs of each.
        every: shortest time between two photographs of a camera, seconds.

    Yields:
        The name, as of `Photographs.take`, and the image of each camera.
    """
    try:
        for name, image in cameras[0].take(count, every):
            yield name, [image] if len(cameras) == 1 else [each.newest() for each in cameras]
    finally:
        for each in cameras:
            each.close()


def _name_now() -> str:
    """Return the time (UTC) in milliseconds as the name of a photograph."""
    return datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")[:-3]
