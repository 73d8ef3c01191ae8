"""The step of a LeRobot pipeline that adds what a membrane feels to the observations."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.processor.pipeline import ObservationProcessorStep, ProcessorStepRegistry

import torchmembrane as tm

from .tactile import keys, points


@ProcessorStepRegistry.register(name="torchmembrane_tactile")
@dataclass
class TactileProcessorStep(ObservationProcessorStep):
    """From the image of a membrane's camera to its points `[V, 6]` (dx, dy, dz, Fx, Fy, Fz) and wrench `[6]`.

    Args:
        sensor: path of the sensor file.
        name: of the camera: the image is `name`, `observation.images.name` or `observation.image.name`.

    Raises:
        MembraneError: the sensor file is wrong, or an image is of another size.

    Limitations:
        Frames without a surface give zeros. Frames of one stream: each starts from the one before, until `reset`.
    """

    sensor: str
    name: str
    tracker: tm.Tracker = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.tracker = tm.Tracker(tm.Reconstructor.from_file(self.sensor))
        self.area = self.tracker.reconstructor.estimator.membrane.rest_area.numpy()

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """The observation with the two keys added."""
        image = next((observation[key] for key in self._image_keys() if key in observation), None)
        if image is None:
            came = ", ".join(observation)
            raise tm.MembraneError(
                f"TactileProcessorStep: observations {came}; expected one of {', '.join(self._image_keys())}"
            )
        result = self.tracker(image).frame(0)
        felt = points(result["displacement"], result["traction"], self.area), np.nan_to_num(result["wrench"])
        return observation | {key: torch.from_numpy(value) for key, value in zip(keys(self.name), felt, strict=True)}

    def get_config(self) -> dict[str, Any]:
        """What the step is made from again."""
        return {"sensor": self.sensor, "name": self.name}

    def reset(self) -> None:
        """The next frame starts from rest."""
        self.tracker.reset()

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """The features with the two keys added."""
        shapes = (len(self.area), 6), (6,)
        added = {key: PolicyFeature(FeatureType.STATE, shape) for key, shape in zip(keys(self.name), shapes, strict=True)}
        observations = features.get(PipelineFeatureType.OBSERVATION, {}) | added
        return features | {PipelineFeatureType.OBSERVATION: observations}

    def _image_keys(self) -> tuple[str, ...]:
        return self.name, f"observation.images.{self.name}", f"observation.image.{self.name}"
