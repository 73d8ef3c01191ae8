"""Depth images as cameras and ROS give them."""

import numpy as np
import pytest
from PIL import Image

from torchmembrane.cli.calibrate.files import read_depth
from torchmembrane.errors import MembraneError


@pytest.mark.parametrize("kind", ["float32.npy", "float16.npy", "float.tiff", "16UC1.png", "16UC1.npy", "[H, W, 1].npy"])
def test_depth_images_are_read_as_ros_has_them(tmp_path, kind):
    """Metres with NaN and infinities where there is no depth, or whole millimetres with 0 there; the sensor is in mm."""
    true = np.array([[21.0, 22.0, 23.0, 24.0], [0.0, 0.0, 0.0, 30.0]])
    metres, path = np.where(true > 0, true / 1000, [[0, 0, 0, 0], [np.nan, np.inf, -np.inf, 0]]), tmp_path / kind
    if "16UC1" in kind:
        values, unit = true.astype(np.uint16), 1.0
    else:
        values, unit = metres.astype(np.float16 if "16" in kind else np.float32), 1000.0
    if "H, W" in kind:
        values = values[..., None]
    Image.fromarray(values).save(path) if path.suffix != ".npy" else np.save(path, values)
    found = read_depth(path, unit, "mm")
    assert found.shape == (2, 4) and found.dtype == np.float64
    seen = true > 0
    np.testing.assert_allclose(found[seen], true[seen], rtol=1e-3 if "16" in kind and unit > 1 else 1e-6)
    assert not (found[~seen] > 0).any()


@pytest.mark.parametrize("unit, millimetre", [("mm", 1.0), ("cm", 0.1), ("m", 1e-3), ("um", 1e3), ("inch", 1 / 25.4)])
def test_steps_of_16_bits_are_millimetres_and_other_depths_of_the_sensors_unit(tmp_path, unit, millimetre):
    depth = np.array([[21.0, 22.0], [23.0, 0.0]])
    for name in ("a.npy", "a.tiff"):
        path, stored = tmp_path / name, (millimetre * depth).astype(np.float32)
        Image.fromarray(stored).save(path) if name.endswith("tiff") else np.save(path, stored)
        np.testing.assert_allclose(read_depth(path, None, unit), millimetre * depth, rtol=1e-6)
    Image.fromarray(depth.astype(np.uint16)).save(tmp_path / "a.png")
    np.testing.assert_allclose(read_depth(tmp_path / "a.png", None, unit), millimetre * depth)


@pytest.mark.parametrize("values", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros(4), np.zeros((4, 4, 2))])
def test_what_is_no_depth_image_is_refused(tmp_path, values):
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(
        MembraneError, match=r"a.npy: an array \[4.*\] of (uint8|float64); expected \[H, W\] of float or of 16 bits"
    ):
        read_depth(tmp_path / "a.npy", 1.0, "mm")
    if values.dtype == np.uint8:
        Image.fromarray(values).save(tmp_path / "a.png")
        with pytest.raises(MembraneError, match=r"a.png: an array \[4, 4\] of uint8"):
            read_depth(tmp_path / "a.png", 1.0, "mm")
