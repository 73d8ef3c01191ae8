"""Reconstruction of one image stream: dots are followed from frame to frame, and drift of the rest image is detected."""

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
"""Statuses of frames that are examined for drift: with a moved camera they may be `UNEXPLAINED`."""
STEADY = 100
"""Frames for which a contact must have been motionless from the start before it is reported as a possible drift."""
FOUND_PRESSURE_ERROR = 0.06
"""Relative error of a reconstructed pressure change (docs/calibration.md)."""
LARGEST_STEADY = 0.3
"""px, rms: largest displacement of the markers by a contact that is reported as a possible drift."""


class Tracker:
    """Reconstructs the frames of one sensor one after another.

    The search for dots starts at their pixels in the preceding frame; texture is searched for as in a single frame. Everything
    else is the same as for a single frame, and so are the results, to the last digit if the same dots are found: they do not
    depend on where the stream began. A frame that follows one without a surface is treated as a single frame.

    Frames without contact show whether the markers still rest where the rest image has them. If they do not, by more than
    chance, because of temperature, creep, swelling, another pressure or a moved camera, the tracker warns once and recommends
    `rezero`. A slow drift may itself be mistaken for a contact. Therefore frames whose markers hardly deviate from their
    mean positions in earlier frames without contact, or from those in the latest such frame, count as well. A drift from before
    the stream may also look like a contact: a light contact that exists from the first frame, displaces the markers as a drift
    does and does not move for `STEADY` frames is reported as a possible drift.

    Args:
        reconstructor: the `Reconstructor` of the sensor.

    Attributes:
        time: time of the latest frame as given by the caller, or None.
        stiffness: comparisons with known loads, from `weigh` and `gauge`, that monitor the membrane's modulus.

    Limitations:
        A sudden change in the middle of a stream that is mistaken for a contact is not noticed (see docs/drift.md). A touch
        that is too light to be detected, or motionless from the start, may be reported as a drift.

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
        """Reconstruct the next frame of the stream; the result is a batch of one.

        Args:
            frame: `[H, W]`, `[1 | 3, H, W]` or `[H, W, 1 | 3]`, or a batch of one as for `Reconstructor`; if views have
                separate images, a list of an image, or None, for each view, or an array `[views, H, W]` of grey images.
            pressure: measured pressure, as for `Reconstructor`.
            time: time of the frame, in seconds of any clock, later than the preceding frame's; kept in `time`.

        Raises:
            MembraneError: there is more than one frame, the size, shape or type is wrong, the time is not finite or not later
                than the preceding frame's, or this sensor or estimator takes no pressure.
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
        """Return the drift of the markers from rest, px: the rms over the markers of their mean displacement in the latest
        frames without contact, fitted by a smooth field, beyond what noise explains. It is NaN before there are enough frames,
        and includes a camera motion, as `pixels` does. If a motionless contact is reported as a drift, it is that contact's."""
        return (self._steady if self._is_steady() else self._watch).drift().size

    def warm_up(self) -> None:
        """Compile the machine code now, if it is not compiled yet, so that the first frame does not wait for it; this takes a
        minute or more (`machine_code`). The tracker's state does not change."""
        r = self.reconstructor
        images = [r.rest_pixels.new_zeros(height, width) for width, height in r.camera.image_sizes if r.sensor.views_apart]
        width, height = r.image_size
        with torch.no_grad():
            r.from_pixels(r.rest_pixels)
            r(images or r.rest_pixels.new_zeros(height, width))

    def reset(self) -> None:
        """Forget the preceding frames, the rest state set by `rezero`, the drift and the time."""
        self._before = self._latest = self._latest_result = self._rest_pixels = self.time = None
        self._watch_from(self.reconstructor.observer.rest_covariance)

    def weigh(self, force: float) -> float:
        """Compare the force in the latest frame, in which only an object of known weight rests on the membrane, with that
        weight.

        Only this comparison and that of a gauge (`gauge`) reveal that a membrane softens or stiffens. Once the latest
        comparisons are significant, a warning recommends a calibration.

        Args:
            force: the weight, N.

        Returns:
            The ratio of the reconstructed force to the weight.

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
        """Compare the pressure change of the latest frame, which was reconstructed without a `pressure`, with that of a gauge
        since rest. Everything else is as in `weigh`.

        Args:
            pressure_change: measured change since rest, N / length^2, not zero.

        Returns:
            The ratio of the reconstructed to the measured change.

        Raises:
            MembraneError: as for `weigh`, or the change is zero.
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
            raise MembraneError(
                f"Tracker.{name}: the latest frame is not ok ({Status(int(result.status[0])).text}); expected status ok: "
                "apply the load again and pass another frame"
            )
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
        """Use a frame without contact, by default the latest, as the new rest state, which removes the drift since the rest
        image.

        Markers that are not found in it keep their pixels in the sensor's rest image; so do, with a warning, those of a view
        that does not show them, if another view does. If a contact is found in the frame, the
        frame is used all the same, because a drift may look like a contact, and a warning states the contact's force.

        Raises:
            MembraneError: there is no frame yet, or too few markers are found in it, in every view.
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
        """Start the detection of drift from a rest state with this noise, covariance `[N, 2, 2]` px^2."""
        observer = self.reconstructor.observer
        rest, sizes = (observer.rest_pixels, rest_covariance, observer.seen_at_rest), self.reconstructor.camera.image_sizes
        self._watch, self._steady, self._said = DriftWatch(*rest, *sizes), DriftWatch(*rest, *sizes), False

    def is_pressed(self, result: Reconstruction) -> bool:
        """Return whether a result of one frame shows a contact that neither a moved camera nor a drift, known from frames
        without contact, explains."""
        moved = self._moved(result)
        return has_contact(result) and not self._watch.is_rigid(*moved) and not self._watch.is_near(*moved)

    def _moved(self, result: Reconstruction) -> tuple[Tensor, Tensor]:
        """Return the displacements of the markers from rest, `[N, 2]` px, and their confidence `[N]`, view by view."""
        observer = self.reconstructor.observer
        return observer.sighted(result.pixels)[0] - observer.rest_pixels, observer.sighted(result.confidence)[0]

    def _look_for_drift(self, result: Reconstruction) -> None:
        moved = self._moved(result)
        if not self.is_pressed(result):
            self._watch.add(*moved, not has_contact(result))
            self._steady.forget()
        else:
            if self._steady.frames >= FEWEST_FRAMES and not self._steady.is_near(*moved):
                self._steady.forget()
            self._steady.add(*moved)
        if not self._said and (self._is_steady() or self._watch.drift().is_certain):
            self._said = True
            warn_user(drift_in_words(self.drift, *self._camera_motion(result), self._is_steady()))

    def _is_steady(self) -> bool:
        """Return whether a contact has been motionless from the first frame and displaces the markers as a drift does."""
        found, was_free = self._steady.drift(), self._watch.frames >= FEWEST_FRAMES
        return not was_free and self._steady.frames >= STEADY and found.is_certain and found.size < LARGEST_STEADY

    def _camera_motion(self, result: Reconstruction) -> tuple[Tensor | None, str]:
        """Return the camera's motion `[4]` in a frame if it explains most of the drift, else None, and the name of its view. Of
        several views, the one whose markers move most by it is chosen."""
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
        apart, sizes = self.reconstructor.sensor.views_apart, self.reconstructor.camera.image_sizes
        if apart and isinstance(frame, list | tuple) and len(frame) == len(sizes):
            frame = [_as_frames(image, size) for image, size in zip(frame, sizes, strict=True)]
        images = self.reconstructor.grey(frame if apart else _as_frames(frame, self.reconstructor.image_size))
        if len(images) != 1:
            raise MembraneError(f"Tracker: {len(images)} frames; expected one, each call is the next one of a stream")
        return images


def _as_frames(image: Any, size: tuple[int, int]) -> Any:
    """Return one colour image `[3, H, W]`, which would be read as three grey frames, as `[1, 3, H, W]`; `size`: W and H."""
    return image[None] if np.shape(image) == (3, *size[::-1]) else image


def has_contact(result: Reconstruction) -> bool:
    """Return whether a contact is found in a result of one frame."""
    return bool(result.contact_points.isfinite().any())


def press_in_words(force: float, unit: str) -> str:
    """Return the warning that the new rest frame shows a contact, with the remedy.

    Args:
        force: force of the contact, NaN if unknown.
        unit: unit of the force.
    """
    known = f"of {force:.3g} {unit} " if np.isfinite(force) else ""
    return (
        f"Tracker.rezero: a contact {known}is found in the frame that is taken for rest, and reads as none from now on. If "
        "something touches, call rezero() again in a frame without contact, or reset(), which takes the sensor's rest image"
    )


def drift_in_words(size: float, camera_motion: Tensor | None = None, view: str = "", is_steady: bool = False) -> str:
    """Return the warning of a drift, with the remedy.

    Args:
        size: size of the drift, px.
        camera_motion: du, dv (px), rotation (degrees) and scale, `[4]`, if the camera's motion explains the drift.
        view: name of the view concerned, if there are several.
        is_steady: whether the drift was found in frames with a contact.
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
    """Return the warning of a changed modulus, with the remedy."""
    percent, changed = 100 * abs(watch.ratio - 1), "softened" if watch.ratio > 1 else "stiffened"
    said = "too large" if watch.ratio > 1 else "too small"
    return (
        f"Tracker: loads are found {percent:.0f} % {said}, {100 * watch.deviation:.0f} % uncertain: the membrane has {changed} "
        "since it was calibrated, and all forces are off by as much. A calibration is due: `torchmembrane calibrate material "
        "--weight`, or --pressure with a gauge"
    )
