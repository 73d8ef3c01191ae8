"""Soft locators and a reconstructor that has one as ONNX, against torch: standard operators, any batch."""

import numpy as np
import onnx
import onnxruntime
import torch
from test_soft import SMALL_SIZE, drawn, found
from test_texture import bump, photograph, still

from torchmembrane.markers.soft import SoftLocator, SoftTextureLocator
from torchmembrane.markers.texture.patches import choose_patches
from torchmembrane.onnx.export import Tracer
from torchmembrane.onnx.graph import described


def located_by_the_exported(locate, images):
    """What onnxruntime finds in `images [B, 1, H, W]` by a locator exported with two of them."""
    tracer, names = Tracer(), ("pixels", "confidence")
    outputs = locate(tracer.given("image", images[:2]))
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


def test_texture_is_located_as_by_torch():
    rest = photograph(still, 0)[60:180, 90:230]
    locate = SoftTextureLocator(rest, choose_patches(rest, np.ones(rest.shape, bool), 150))
    images = [rest, photograph(bump, 1)[60:180, 90:230], 0 * rest + 0.5]
    images = torch.as_tensor(np.stack(images), dtype=torch.float32)[:, None]
    expected, sure = found(locate, images)
    got, confidence = located_by_the_exported(locate, images)
    np.testing.assert_allclose(confidence, sure, atol=2e-3)
    np.testing.assert_allclose(got[:2], expected[:2], atol=1e-2)
    assert (sure[:2] > 0.5).mean() > 0.5
