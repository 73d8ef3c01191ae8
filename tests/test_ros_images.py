"""ROS images of every encoding are read as the same grey."""

from io import BytesIO
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from torchmembrane import Camera, MembraneError
from torchmembrane.files.bayer import PATTERNS, demosaiced
from torchmembrane.files.images import GREY
from torchmembrane.integrations.messages import (
    MOSAICS,
    PLANES,
    SAMPLES,
    camera_mismatch,
    grey_of,
    info_topic,
    mode_of,
    projected,
    size_of,
)

SIZE = WIDTH, HEIGHT = 10, 6
LEVELS = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
COLOUR = {"r": 200, "g": 100, "b": 30}
GREY_OF_COLOUR = sum(weight * COLOUR[c] for weight, c in zip(GREY, "rgb", strict=True)) / 255


def message(encoding, lines, padding=0, more=b"", **changed):
    """An Image of lines `[H, N]` of values, each followed by some bytes, and of what comes after the lines."""
    octets = np.ascontiguousarray(lines).view(np.uint8)
    data = np.frombuffer(np.pad(octets, ((0, 0), (0, padding))).tobytes() + more, np.uint8)
    fields = dict(encoding=encoding, width=WIDTH, height=HEIGHT, step=octets.shape[1] + padding, is_bigendian=0, data=data)
    return SimpleNamespace(**fields | changed)


def noise(*shape):
    return np.random.default_rng(1).integers(0, 256, shape, np.uint8)


def packed_yuv(encoding, first):
    """Y and colours in turns, as the encoding has them."""
    values = np.stack([LEVELS, noise(*LEVELS.shape)], -1)
    return message(encoding, (values if first == "y" else values[..., ::-1]).reshape(HEIGHT, -1), padding=4)


def mosaic(encoding, scene):
    """What a camera with this pattern sees of a scene `[H, W, 3]` of 8 bits."""
    pattern = encoding.removeprefix("bayer_")[:4]
    values = np.empty((HEIGHT, WIDTH), np.uint16 if encoding.endswith("16") else np.uint8)
    for k, c in enumerate(pattern):
        values[k // 2 :: 2, k % 2 :: 2] = scene[k // 2 :: 2, k % 2 :: 2, "rgb".index(c)]
    return values * (257 if encoding.endswith("16") else 1)


@pytest.mark.parametrize("encoding, first", [("yuyv", "y"), ("yuv422_yuy2", "y"), ("uyvy", "colour"), ("yuv422", "colour")])
def test_of_yuv_the_grey_value_is_y(encoding, first):
    np.testing.assert_allclose(grey_of(packed_yuv(encoding, first), SIZE), LEVELS / 255, rtol=1e-6)


@pytest.mark.parametrize("encoding", PLANES)
@pytest.mark.parametrize("padding", [0, 6])
def test_of_planes_the_first_is_grey(encoding, padding):
    colours = noise(round((PLANES[encoding] - 1) * HEIGHT) * (WIDTH + padding)).tobytes()
    np.testing.assert_allclose(grey_of(message(encoding, LEVELS, padding, colours), SIZE), LEVELS / 255, rtol=1e-6)


@pytest.mark.parametrize("encoding, step", [("nv12", 15), ("nv21", 15), ("nv24", 20), ("nv24", 30)])
def test_a_step_that_counts_the_colours_too_leaves_the_grey_where_it_is(encoding, step):
    colours = noise(round((PLANES[encoding] - 1) * HEIGHT * WIDTH)).tobytes()
    np.testing.assert_allclose(grey_of(message(encoding, LEVELS, 0, colours, step=step), SIZE), LEVELS / 255, rtol=1e-6)


@pytest.mark.parametrize("encoding", MOSAICS)
def test_a_bayer_pattern_gives_the_grey_of_one_colour_everywhere(encoding):
    scene = np.broadcast_to([COLOUR[c] for c in "rgb"], (HEIGHT, WIDTH, 3))
    np.testing.assert_allclose(grey_of(message(encoding, mosaic(encoding, scene), 2), SIZE), GREY_OF_COLOUR, rtol=1e-6)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_bayer_pattern_moves_nothing(pattern):
    """A ramp of grey is interpolated to itself, but for the border."""
    ramp = np.add.outer(np.arange(20.0), 3 * np.arange(20.0))
    np.testing.assert_allclose(demosaiced(ramp, pattern)[1:-1, 1:-1], np.stack([ramp] * 3, -1)[1:-1, 1:-1])


@pytest.mark.parametrize("pattern, name", [*zip(PATTERNS, ("BG", "RG", "GR", "GB"), strict=True)])
def test_a_bayer_pattern_is_that_of_opencv(pattern, name):
    cv2 = pytest.importorskip("cv2")
    values = noise(20, 24)
    expected = cv2.cvtColor(values, getattr(cv2, f"COLOR_Bayer{name}2RGB"))  # OpenCV names a pattern by its second line
    found = demosaiced(values.astype(float), pattern)
    assert np.abs(found - expected)[2:-2, 2:-2].max() <= 0.5


@pytest.mark.parametrize("encoding", ["mono16", "16UC1", "rgb16", "bgra16", "16UC3", "bayer_rggb16"])
def test_the_order_of_bytes_is_obeyed(encoding):
    count = {"mono16": 1, "16UC1": 1, "rgb16": 3, "16UC3": 3, "bgra16": 4}.get(encoding, 1)
    values = np.full((HEIGHT, count * WIDTH), 258, ">u2")
    np.testing.assert_allclose(grey_of(message(encoding, values, 6, is_bigendian=1), SIZE), 258 / 65535, rtol=1e-6)


@pytest.mark.parametrize(
    "encoding, order", [("rgba16", [0, 1, 2, 3]), ("bgra16", [2, 1, 0, 3]), ("8UC4", [2, 1, 0, 3]), ("16UC3", [2, 1, 0])]
)
def test_alpha_does_not_count_and_colours_have_their_order(encoding, order):
    kind, white = (np.uint8, 255) if encoding == "8UC4" else (np.uint16, 65535)
    pixel = (np.array([0.8, 0.4, 0.2, 0.1]) * white).astype(kind)[order]
    grey = grey_of(message(encoding, np.tile(pixel, (HEIGHT, WIDTH))), SIZE)
    np.testing.assert_allclose(grey, np.dot(GREY, [0.8, 0.4, 0.2]), atol=2 / white)


def whole(encoding):
    """A message of zeros whose step and data are as the encoding needs them."""
    values = 2 if encoding in ("yuyv", "uyvy") else 1
    octets = 2 if "16" in encoding else 1
    more = bytes(round((PLANES.get(encoding, 1) - 1) * HEIGHT * WIDTH))
    return message(encoding, np.zeros((HEIGHT, WIDTH * values * octets), np.uint8), more=more)


@pytest.mark.parametrize("encoding", ["mono8", "yuyv", "uyvy", "nv12", "nv21", "nv24", "bayer_gbrg8", "bayer_grbg16", "16UC1"])
def test_steps_and_data_that_are_too_short_are_refused_by_name(encoding):
    message = whole(encoding)
    assert not grey_of(message, SIZE).any()
    for change, said in (
        (
            dict(step=message.step - 1),
            f"{len(message.data)} bytes in lines of {message.step - 1}; expected 6 of {message.step}",
        ),
        (
            dict(data=message.data[:-1]),
            f"{len(message.data) - 1} bytes in lines of {message.step}; expected 6 of {message.step}",
        ),
        (dict(data=message.data[:0]), "0 bytes in lines"),
        (dict(height=HEIGHT - 1), "the image is 10 x 5 px, the sensor's 10 x 6"),
    ):
        with pytest.raises(MembraneError, match=said):
            grey_of(SimpleNamespace(**message.__dict__ | change), SIZE)


@pytest.mark.parametrize("encoding", ["32FC1", "16SC1", "8UC2", "yuv444", "bayer_xyzw8", "", "MONO8"])
def test_encodings_without_a_grey_value_are_refused_by_name(encoding):
    with pytest.raises(MembraneError, match=f"image of encoding '{encoding}'; expected one of mono8, .*nv12.*bayer_rggb8"):
        grey_of(message(encoding, LEVELS), SIZE)


def compressed(form, array, kind="PNG"):
    content = BytesIO()
    Image.fromarray(array).save(content, kind)
    return SimpleNamespace(format=form, data=np.frombuffer(content.getvalue(), np.uint8))


@pytest.mark.parametrize(
    "form, kind",
    [
        *(("png", "PNG"), ("mono8; png compressed ", "PNG"), ("16UC1; png compressed ", "PNG")),
        *(
            ("jpeg", "JPEG"),
            ("jpg", "JPEG"),
            ("bgr8; jpeg compressed bgr8", "JPEG"),
            ("yuv422_yuy2; jpeg compressed bgr8", "JPEG"),
        ),
    ],
)
def test_every_format_of_a_compressed_image_is_read(form, kind):
    ramp = np.tile(np.linspace(60, 90, WIDTH).astype(np.uint8), (HEIGHT, 1))
    levels = ramp.astype(np.uint16) * 257 if "16" in form else np.stack([ramp] * 3, -1) if "bgr8" in form else ramp
    message = compressed(form, levels, kind)
    assert size_of(message) == SIZE
    np.testing.assert_allclose(grey_of(message, SIZE), ramp / 255, atol=0.02 if kind == "JPEG" else 1e-6)


@pytest.mark.parametrize("encoding", ["bayer_grbg8", "bayer_rggb16"])
def test_a_compressed_bayer_pattern_is_one(encoding):
    scene = np.broadcast_to([COLOUR[c] for c in "rgb"], (HEIGHT, WIDTH, 3))
    values = mosaic(encoding, scene)
    np.testing.assert_allclose(grey_of(compressed(f"{encoding}; png compressed ", values), SIZE), GREY_OF_COLOUR, rtol=1e-6)
    colour = compressed(f"{encoding}; jpeg compressed bgr8", np.uint8(scene), "PNG")  # interpolated by who sent it
    np.testing.assert_allclose(grey_of(colour, SIZE), GREY_OF_COLOUR, rtol=1e-6)


@pytest.mark.parametrize(
    "form, said",
    [
        ("16UC1; compressedDepth", "holds depths; expected an image: name the topic of the camera's images"),
        ("32FC1; compressedDepth png", "holds depths"),
        ("h264", "an image of format 'h264': not readable as an image"),
    ],
)
def test_compressed_messages_without_an_image_are_refused_by_name(form, said):
    with pytest.raises(MembraneError, match=said):
        grey_of(SimpleNamespace(format=form, data=bytes(40)), SIZE)


FULL = (640, 480)
LENSES = {"plumb_bob": ("pinhole", [-0.2, 0.05, 1e-3, -2e-3, 0.01]), "equidistant": ("fisheye", [0.02, -5e-3, 1e-3, -1e-4])}
MODES = {
    "full": (None, (1, 1)),
    "binning 0": (None, (0, 0)),
    "binned": (None, (2, 2)),
    "binned along u": (None, (4, 1)),
    "binned by 3": ((0, 0, 639, 480), (3, 3)),
    "a region": ((80, 40, 320, 240), (1, 1)),
    "a region, binned": ((80, 40, 320, 240), (2, 4)),
    "at the far corner": ((320, 240, 320, 240), (2, 2)),
}


def full_camera(lens):
    model, distortion = LENSES[lens]
    return Camera(model, FULL, (300.0, 310.0), (318.0, 243.0), distortion)


def camera_info(lens, region, binning, size=FULL):
    camera = full_camera(lens)
    (f, g), (u, v) = camera.focal.tolist(), camera.centre.tolist()
    left, top, width, height = region or (0, 0, 0, 0)
    roi = SimpleNamespace(x_offset=left, y_offset=top, width=width, height=height, do_rectify=False)
    d, k = camera.distortion.numpy(), np.array([f, 0, u, 0, g, v, 0, 0, 1.0])
    fields = dict(width=size[0], height=size[1], distortion_model=lens, d=d, k=k)
    return SimpleNamespace(**fields, roi=roi, binning_x=binning[0], binning_y=binning[1])


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("mode", MODES)
def test_region_and_binning_see_what_a_camera_in_that_mode_sees(lens, mode):
    region, binning = MODES[mode]
    blocks = tuple(max(b, 1) for b in binning)
    camera = full_camera(lens).in_mode(region or (0, 0, *FULL), blocks)
    info = camera_info(lens, region, binning)
    pixels = np.stack(np.meshgrid(*(np.linspace(0, side - 1, 7) for side in camera.image_size)), -1)
    rays = camera.pixel_to_ray(torch.from_numpy(pixels)).direction.numpy()
    assert mode_of(info).size == camera.image_size
    np.testing.assert_allclose(projected(info, rays), pixels, atol=1e-6)  # px
    assert camera_mismatch(info, camera) is None


@pytest.mark.parametrize("mode", ["binned", "a region", "a region, binned"])
def test_what_disagrees_in_a_mode_is_said_in_its_pixels(mode):
    region, binning = MODES[mode]
    camera = full_camera("plumb_bob").in_mode(region or (0, 0, *FULL), binning)
    info = camera_info("plumb_bob", region, binning)
    info.k[2] += 8  # of the full image
    assert f"{8 / binning[0]:.1f} px off" in camera_mismatch(info, camera)


@pytest.mark.parametrize(
    "region, binning, size, camera_mode, said",
    [
        (
            None,
            (2, 2),
            FULL,
            ((0, 0, *FULL), (1, 1)),
            r"of 320 x 240 px images .roi and binning of 640 x 480., the sensor file of 640 x 480",
        ),
        (None, (1, 1), FULL, ((0, 0, *FULL), (2, 2)), "of 640 x 480 px images, the sensor file of 320 x 240"),
        ((80, 40, 320, 240), (2, 2), FULL, ((80, 40, 320, 240), (1, 1)), "of 160 x 120 px images"),
        (None, (2, 2), (320, 240), ((0, 0, *FULL), (2, 2)), "of 160 x 120 px images"),
    ],
)
def test_another_mode_than_the_file_s_is_refused_with_the_remedy(region, binning, size, camera_mode, said):
    camera = full_camera("plumb_bob").in_mode(*camera_mode)
    with pytest.raises(MembraneError, match=f"CameraInfo is {said}.*say so in the file's .camera"):
        camera_mismatch(camera_info("plumb_bob", region, binning, size), camera)


def test_what_the_lens_of_a_camera_info_does_not_see_counts_as_the_image_s_diagonal():
    """A fisheye of 244 degrees and a pinhole: the tangent of the angle for the angle, 800 px at most, and behind it 800 px."""
    camera, info = Camera("fisheye", FULL, (150.0, 150.0), (319.5, 239.5)), camera_info("plumb_bob", None, (1, 1))
    info.d, info.k = np.zeros(5), np.array([150.0, 0, 319.5, 0, 150.0, 239.5, 0, 0, 1.0])
    u, v = np.meshgrid(np.linspace(0, 639, SAMPLES), np.linspace(0, 479, SAMPLES))
    angle = np.hypot(u - 319.5, v - 239.5) / 150
    apart = np.where(angle < np.pi / 2, 150 * (np.tan(angle) - angle), 800.0).clip(max=800.0)
    assert 0.1 < (angle > np.pi / 2).mean() < 0.5
    said = f"{np.sqrt((apart**2).mean()):.1f} px off (rms over the image, at most 800.0)"
    assert said in camera_mismatch(info, camera)


@pytest.mark.parametrize("topic", ["/finger/image_raw", "/finger/image_raw/compressed", "/finger/image", "/finger/image_mono"])
def test_a_camera_info_lies_beside_the_images(topic):
    assert info_topic(topic) == "/finger/camera_info"
