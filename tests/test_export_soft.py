"""The soft locator as ONNX agrees with torch, for any batch."""

import numpy as np
import onnx
import onnxruntime
import torch
from test_soft import SMALL_SIZE, drawn, found

from torchmembrane.markers.soft import SoftLocator
from torchmembrane.onnx.export import Tracer
from torchmembrane.onnx.graph import described


def located_by_the_exported(locate, images):
    """What onnxruntime finds in `images [B, 1, H, W]` by a locator exported with two of them."""
    tracer, names = Tracer(), ("pixels", "confidence")
    outputs = locate(tracer.given("image", images[:2]))[:2]
    for name, value in zip(names, outputs, strict=True):
        tracer.assembly.named(value.name, name)
    shapes = [described(n, shape=["batch", *v.example.shape[1:]]) for n, v in zip(names, outputs, strict=True)]
    model = tracer.assembly.model([described("image", shape=["batch", *images.shape[1:]])], shapes, {})
    onnx.checker.check_model(model, full_check=True)
    assert {node.domain for node in model.graph.node} <= {"", "ai.onnx"}
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {"image": images.numpy()})


def test_dots_are_located_as_by_torch():
    pattern, image = drawn((2.0, -1.5), torch.float32)
    locate = SoftLocator(pattern, SMALL_SIZE, "dark")
    images = torch.cat([image, drawn((-1.0, 0.5), torch.float32)[1], 0 * image + 0.5])
    for expected, got in zip(found(locate, images), located_by_the_exported(locate, images), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-3)
