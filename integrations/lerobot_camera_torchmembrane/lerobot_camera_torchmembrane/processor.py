"""A step of a LeRobot pipeline that adds a membrane's tactile results to the observations."""

from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs.types import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.processor.pipeline import ObservationProcessorStep, ProcessorStepRegistry

import torchmembrane as tm

from . import tactile


@ProcessorStepRegistry.register(name="torchmembrane_tactile")
@dataclass
class TactileProcessorStep(ObservationProcessorStep):
    """Reconstruct the image of a membrane's camera, and add the results in the form of the observations that hold the image.

    In a robot's observations, the image is `NAME`, and plain numbers are added, `NAME.Fx` ... `NAME.Mz` and `NAME.status`,
    which LeRobot's `record` writes. In a policy's observations, the image is `observation.images.NAME`, and tensors are added,
    `observation.tactile.NAME.wrench [6]`, `.contacts [24]`, `.status [1]` and `.points [V, 6]`, with the image's batch axis of
    size one.

    Args:
        sensor: path of the sensor file.
        name: name of the camera.

    Raises:
        MembraneError: the sensor file is invalid or of views with images of their own; or an image is missing or has another
            size.

    Limitations:
        Frames without a surface give zeros, which `status` reveals. All frames must come from one stream; `reset()` starts a
        new one. Machine code is compiled when the step is created, which takes a minute or more after an installation.
    """

    sensor: str
    name: str
    tracker: tm.Tracker = field(init=False, repr=False)

    def __post_init__(self) -> None:
        reconstructor = tm.Reconstructor.from_file(self.sensor)
        tactile.refuse_views_apart(reconstructor.sensor, self.sensor)
        self.tracker = tm.Tracker(reconstructor)
        self.tracker.warm_up()
        self.area = self.tracker.reconstructor.estimator.membrane.rest_area.numpy()

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with the tactile results added."""
        key = next((key for key in (self.name, self._image_key) if key in observation), None)
        if key is None:
            raise tm.MembraneError(
                f"TactileProcessorStep: observations {', '.join(observation)}; expected {self.name} or {self._image_key}"
            )
        image = observation[key]
        frame = self.tracker(image).frame(0)
        if key == self.name:
            return observation | tactile.scalars(frame, self.name)
        values = tactile.felt(frame) | {"points": tactile.points(frame, self.area)}
        tensors = {tactile.key(self.name, what): torch.from_numpy(value) for what, value in values.items()}
        return observation | {key: value[None] if image.ndim == 4 else value for key, value in tensors.items()}

    def get_config(self) -> dict[str, Any]:
        """Return the arguments from which the step can be created again."""
        return {"sensor": self.sensor, "name": self.name}

    def reset(self) -> None:
        """Start the next frame from the rest state."""
        self.tracker.reset()

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Return the features with those of the tactile results added."""
        observed = features.get(PipelineFeatureType.OBSERVATION, {})
        if self.name in observed:
            added: dict[str, Any] = dict.fromkeys(tactile.scalar_names(self.name), float)
        else:
            declared = tactile.features(self.name, len(self.area))
            added = {key: PolicyFeature(FeatureType.STATE, each["shape"]) for key, each in declared.items()}
        return features | {PipelineFeatureType.OBSERVATION: observed | added}

    @property
    def _image_key(self) -> str:
        return f"observation.images.{self.name}"
