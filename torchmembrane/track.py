"""One stream of images: dots are followed from frame to frame, and drift of the rest image is detected."""

from math import isfinite
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .errors import MembraneError, expect, is_number
from .markers.drift import FEWEST_FRAMES, DriftWatch
from .reconstruct import Reconstructor
from .results.reconstruction import Reconstruction
from .results.status import Status
from .stiffness import StiffnessWatch
from .user_warnings import warn_user

LOOKED_AT = (Status.OK, Status.UNEXPLAINED, Status.OUT_OF_RANGE, Status.VIEW_LEFT_OUT)
"""Statuses of frames that reveal a drift: a camera that moved may leave them unexplained."""
STEADY = 100
"""Frames in which a contact holds still from the beginning before it is said that it may be a drift."""
FOUND_PRESSURE_ERROR = 0.06
"""Relative error of a pressure change that is found (docs/calibration.md)."""
LARGEST_STEADY = 0.3
"""px, rms: how far such a contact moves the markers at most."""


class Tracker:
    """Reconstructs the frames of one sensor one after another.

    Dots are looked for where the frame before had them, a texture as in a frame alone. All else is as for a frame alone, and so
    are its answers, to the last digit where the same dots are found: they do not hang on where a stream began. After a frame
    without a surface the next one is alone.

    Frames without contact tell whether the markers still rest where the rest image has them. When they do not, beyond chance,
    for temperature, creep, swelling, another pressure or a moved camera, the tracker warns once, with the remedy, `rezero`. A
    slow drift may itself be taken for a contact: frames whose markers hardly leave where they lay without one count as well. So
    may one from before the stream: a contact from its beginning that is light, moves the markers as a drift does and holds
    still for `STEADY` frames is said too, as what it may be.

    Args:
        reconstructor: the sensor's.

    Attributes:
        time: time of the latest frame, as it was given; None where it was not.
        stiffness: what known loads, given by `weigh` and `gauge`, tell of the membrane's modulus.

    Limitations:
        A sudden change amid a stream that is taken for a contact is not noticed (see docs/drift.md). A touch too light to be
        found, or held still from the beginning, may be said to be a drift.

    Example:
        >>> import torchmembrane as tm
        >>> reconstructor = tm.Reconstructor.from_file("examples/sensor.toml")
        >>> tracker = tm.Tracker(reconstructor)
        >>> rest, press = reconstructor.read("examples/rest.png", "examples/press_on_axis.png")
        >>> [int(tracker(frame).status[0]) for frame in (press, press)]
        [0, 0]
        >>> tracker.rezero(rest)
        >>> for _ in range(10):
        ...     result = tracker(rest)
        >>> tracker.drift
        0.0
    """

    def __init__(self, reconstructor: Reconstructor):
        if not hasattr(reconstructor, "observer"):
            raise MembraneError(f"Tracker: reconstructor is a {type(reconstructor).__name__}; expected a tm.Reconstructor")
        self.reconstructor = reconstructor
        self.time: float | None = None
        self.stiffness, self._said_due = StiffnessWatch(), False
        self._before: Reconstruction | None = None
        self._latest: Tensor | None = None
        self._latest_result: Reconstruction | None = None
        self._rest_pixels: Tensor | None = None
        self._watch_from(reconstructor.observer.rest_covariance)

    def __call__(self, frame: Any, pressure: float | None = None, time: float | None = None) -> Reconstruction:
        """The frame's result, a batch of one.

        Args:
            frame: `[H, W]`, `[1 | 3, H, W]` or `[H, W, 1 | 3]`, or a batch of one as for `Reconstructor`; of views that have
                images of their own a list of these, or `[W, H, W']`.
            pressure: that a gauge reads, as for `Reconstructor`.
            time: when the frame was taken, seconds of any clock; kept in `time`, later than that of the frame before.

        Raises:
            MembraneError: more than one frame, another size, shape or type; a time that is no finite number, or not after that
                of the frame before.
        """
        images = self._one(frame)
        expected = "seconds of any clock, a finite number"
        expect(time is None or (is_number(time) and isfinite(time)), "Tracker: time", time, expected)
        if time is not None and self.time is not None and not time > self.time:
            raise MembraneError(
                f"Tracker: a frame of time {time} after one of {self.time}; expected frames in order: call reset() where "
                "another recording begins"
            )
        with torch.no_grad():
            result: Reconstruction = self.reconstructor(images, self._before, self._rest_pixels, pressure)
        self.time, self._latest, self._latest_result = time, images, result
        self._before = result if Status(int(result.status[0])).has_surface else None
        if int(result.status[0]) in LOOKED_AT:
            self._look_for_drift(result)
        return result

    @property
    def drift(self) -> float:
        """How far the markers lie off their rest, px, rms over the markers of their mean displacement in the latest frames
        without contact as a smooth field, beyond what noise explains; NaN before there are some. A moved camera's motion is
        in it, as `pixels` have it. Where a contact that holds still is said to be a drift, that one's."""
        return (self._steady if self._is_steady() else self._watch).drift().size

    def warm_up(self) -> None:
        """Do now what the first frame would wait for: machine code is compiled where there is none yet, which takes a minute or
        more (`machine_code`). A stream's frames do not wait for it then; what the tracker has seen stays as it was."""
        r = self.reconstructor
        images = [torch.zeros(height, width) for width, height in r.camera.image_sizes if r.sensor.views_apart]
        width, height = r.image_size
        with torch.no_grad():
            r.from_pixels(r.rest_pixels)
            r(images or torch.zeros(height, width))

    def reset(self) -> None:
        """Forget the frames before, what `rezero` took for rest, the drift and the time."""
        self._before = self._latest = self._latest_result = self._rest_pixels = self.time = None
        self._watch_from(self.reconstructor.observer.rest_covariance)

    def weigh(self, force: float) -> float:
        """Compare the latest frame, in which something of known weight stands on the membrane alone, with that weight.

        A membrane that softens or stiffens shows in nothing else but this and a gauge (`gauge`). Once the latest comparisons
        say so for certain, a warning says that a calibration is due.

        Args:
            force: the weight, N.

        Returns:
            The force that is found, over the weight.

        Raises:
            MembraneError: there is no frame, its status is not ok, its contact reaches the rim, which bears a part of the
                weight, or forces are relative.
        """
        result = self._relied_on("weigh")
        if bool((result.contact_at_rim[0] == 1).any()):
            raise MembraneError(
                "Tracker.weigh: the contact reaches the rim, which bears a part of the weight; expected the weight on the "
                "middle of the membrane"
            )
        expect(is_number(force) and isfinite(force) and force > 0, "Tracker.weigh: force", force, "the weight in N, positive")
        deviation = float(result.force_deviation[0].norm())
        return self._compared(float(result.force[0].norm()), float(force), deviation if isfinite(deviation) else 0.0)

    def gauge(self, pressure_change: float) -> float:
        """Compare the latest frame, which was taken without a `pressure`, with the change since rest that a gauge reads; as
        `weigh`.

        Args:
            pressure_change: N / length^2, not zero.

        Returns:
            The change that is found, over that one.

        Raises:
            MembraneError: as of `weigh`, or the change is zero.
        """
        result = self._relied_on("gauge")
        right = is_number(pressure_change) and isfinite(pressure_change) and pressure_change != 0
        expect(right, "Tracker.gauge: pressure_change", pressure_change, "a change since rest, not zero: press the membrane")
        found = float(result.pressure_change[0])
        return self._compared(found, float(pressure_change), FOUND_PRESSURE_ERROR * abs(found))

    def _relied_on(self, name: str) -> Reconstruction:
        result, unit = self._latest_result, self.reconstructor.sensor.force_unit
        if result is None:
            raise MembraneError(f"Tracker.{name}: no frame yet; expected one with the load")
        if int(result.status[0]) != Status.OK:
            raise MembraneError(f"Tracker.{name}: the latest frame is not ok ({Status(int(result.status[0])).text})")
        if unit != "N":
            raise MembraneError(f"Tracker.{name}: forces are {unit}; expected a sensor file with shear_modulus and thickness")
        return result

    def _compared(self, found: float, known: float, deviation: float) -> float:
        self.stiffness.add(found, known, deviation)
        if self.stiffness.is_due and not self._said_due:
            self._said_due = True
            warn_user(stiffness_in_words(self.stiffness))
        return found / known

    def rezero(self, frame: Any = None) -> None:
        """Take a frame without contact, default the latest, for the rest state: what drifted since the rest image is nulled.

        Markers that are not found in it keep their places in the sensor's rest image. Where a contact is found in the frame, it
        is taken for rest all the same, as a drift may look like a contact, and a warning says with what force.

        Raises:
            MembraneError: there is no frame yet, or too few of its markers are found.
        """
        images, result = self._latest, self._latest_result
        if frame is not None:
            images = self._one(frame)
            with torch.no_grad():
                result = self.reconstructor(images, None, self._rest_pixels)
        if images is None or result is None:
            raise MembraneError("Tracker.rezero: no frame yet; pass one without contact")
        rest = self.reconstructor.observer.rest_of(images)
        if self.is_pressed(result):
            force = float(result.force[0].norm()) if self.reconstructor.finds_tractions else float("nan")
            warn_user(press_in_words(force, self.reconstructor.sensor.force_unit))
        self._rest_pixels, self._before = rest.pixels, None
        self._watch_from(rest.covariance)

    def _watch_from(self, rest_covariance: Tensor) -> None:
        """Begin to look for a drift from a rest state with this noise, `[N, 2, 2]` px^2."""
        observer = self.reconstructor.observer
        rest, sizes = (observer.rest_pixels, rest_covariance, observer.seen_at_rest), self.reconstructor.camera.image_sizes
        self._watch, self._steady, self._said = DriftWatch(*rest, *sizes), DriftWatch(*rest, *sizes), False

    def is_pressed(self, result: Reconstruction) -> bool:
        """Whether the one frame of a result has a contact that is neither a moved camera's nor a drift that frames without one
        have shown."""
        moved = self._moved(result)
        touched = bool(result.contact_points.isfinite().any()) and not self._watch.is_rigid(*moved)
        return touched and not self._watch.is_near(*moved)

    def _moved(self, result: Reconstruction) -> tuple[Tensor, Tensor]:
        """How far the markers are off their rest, `[N, 2]` px, and their confidence `[N]`, one view after the other."""
        observer = self.reconstructor.observer
        return observer.sighted(result.pixels)[0] - observer.rest_pixels, observer.sighted(result.confidence)[0]

    def _look_for_drift(self, result: Reconstruction) -> None:
        moved = self._moved(result)
        if not self.is_pressed(result):
            self._watch.add(*moved)
            self._steady.forget()
        else:
            if self._steady.frames >= FEWEST_FRAMES and not self._steady.is_near(*moved):
                self._steady.forget()
            self._steady.add(*moved)
        if not self._said and (self._is_steady() or self._watch.drift().is_certain):
            self._said = True
            warn_user(drift_in_words(self.drift, *self._camera_motion(result), self._is_steady()))

    def _is_steady(self) -> bool:
        """Whether a contact that was there from the beginning has held still, and moves the markers as a drift does."""
        found, was_free = self._steady.drift(), self._watch.frames >= FEWEST_FRAMES
        return not was_free and self._steady.frames >= STEADY and found.is_certain and found.size < LARGEST_STEADY

    def _camera_motion(self, result: Reconstruction) -> tuple[Tensor | None, str]:
        """The camera's motion `[4]` in a frame, if that is most of the drift; of several views that of the one whose markers it
        moves most, and its name."""
        r, motion = self.reconstructor, result.camera_motion
        shift = r.camera.shift_of(r.camera.motion_in_pixels(motion), r.observer.rest_pixels)
        shift2 = torch.where(r.observer.seen_at_rest, shift.square().sum(-1), torch.nan)
        if not float(shift2.nanmean().sqrt()) > self.drift / 2:
            return None, ""
        if not r.sensor.views:
            return motion[0], ""
        view = int(r.observer.by_view(shift2).nanmean(-1)[0].argmax())
        return motion[0, view], r.sensor.views[view].name

    def _one(self, frame: Any) -> Tensor:
        width, height = self.reconstructor.image_size
        is_colour = not self.reconstructor.sensor.views_apart and np.shape(frame) == (3, height, width)
        images = self.reconstructor.grey(frame[None] if is_colour else frame)  # of a batch, these would be three grey frames
        if len(images) != 1:
            raise MembraneError(f"Tracker: {len(images)} frames; expected one, each call is the next one of a stream")
        return images


def press_in_words(force: float, unit: str) -> str:
    """A contact in what is taken for rest, and the remedy.

    Args:
        force: force of the contact; NaN where it is not known.
        unit: unit of the force.
    """
    known = f"of {force:.3g} {unit} " if np.isfinite(force) else ""
    return (
        f"Tracker.rezero: a contact {known}is found in the frame that is taken for rest, and reads as none from now on. If "
        "something touches, call rezero() again in a frame without contact, or reset(), which takes the sensor's rest image"
    )


def drift_in_words(size: float, camera_motion: Tensor | None = None, view: str = "", is_steady: bool = False) -> str:
    """A drift and its remedy.

    Args:
        size: px.
        camera_motion: du, dv (px), rotation (degrees) and scale, `[4]`, where it is that.
        view: whose, of several.
        is_steady: whether it was found in frames with a contact.
    """
    camera = ""
    if camera_motion is not None:
        whose = f"the moved camera's of view {view!r}" if view else "a moved camera's"
        motion = "{:z.1f}, {:z.1f} px, {:z.2f} degrees, scale {:.4f}".format(*camera_motion.tolist())
        camera = f"; it is {whose}: {motion}"
    where = f"in a contact that has held still from the beginning, for {STEADY} frames," if is_steady else "without contact"
    aged = "if nothing touches, it" if is_steady else "it"
    return (
        f"Tracker: {where} the markers lie {size:.2f} px (rms) off the rest image, more than noise explains: {aged} has aged "
        f"(temperature, creep, swelling, pressure, a moved camera){camera}. Call Tracker.rezero() in a frame without contact"
    )


def stiffness_in_words(watch: StiffnessWatch) -> str:
    """A changed modulus and its remedy."""
    percent, changed = 100 * abs(watch.ratio - 1), "softened" if watch.ratio > 1 else "stiffened"
    said = "too large" if watch.ratio > 1 else "too small"
    return (
        f"Tracker: loads are found {percent:.0f} % {said}, {100 * watch.deviation:.0f} % uncertain: the membrane has {changed} "
        "since it was calibrated, and all forces are off by as much. A calibration is due: `torchmembrane calibrate material "
        "--weight`, or --pressure with a gauge"
    )
