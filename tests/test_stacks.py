"""Files of several pictures give a frame each, or are refused."""

import struct
from pathlib import Path

import numpy as np
import pytest
from image_files import levels, saved, tiff
from PIL import Image
from test_batch import HEIGHT, WIDTH, Denting, grey_image, reconstruct, summary_of

from torchmembrane.cli.main import main
from torchmembrane.errors import MembraneError
from torchmembrane.files.images import image_size, mean_image, picture_count, read_image, read_pixels, stack_images
from torchmembrane.jobs.inputs import find_inputs, single_images
from torchmembrane.live.sources import folder_images, video_images
from torchmembrane.results.read import read_results

SIZE = (32, 24)
EIGHT, SIXTEEN = levels(3), [257 * image.astype(np.uint16) for image in levels(3)]
GREY = [Image.fromarray(image) for image in EIGHT]
STACKS = {
    "pages.tif": dict(images=GREY),
    "lzw.tiff": dict(images=GREY, compression="tiff_lzw"),
    "deep.tif": dict(images=[Image.fromarray(image) for image in SIXTEEN]),
    "float.tif": dict(images=[Image.fromarray(image.astype(np.float32) / 255) for image in EIGHT]),
    "whole.tif": dict(images=[Image.fromarray(image.astype(np.int32) * 257) for image in EIGHT]),
    "colour.TIF": dict(images=[image.convert("RGB") for image in GREY]),
    "animated.png": dict(images=GREY),
    "still_first.png": dict(images=GREY, default_image=True),
    "animated.webp": dict(images=GREY, lossless=True),
    "pair.mpo": dict(images=GREY, format="MPO"),
    "pair.jpg": dict(images=GREY, format="MPO"),
}
every_stack = pytest.mark.parametrize("name", STACKS)


def stack_in(folder: Path, name: str) -> Path:
    return saved(folder / name, **STACKS[name])


@every_stack
def test_each_picture_of_a_file_is_read(tmp_path, name):
    path = stack_in(tmp_path, name)
    found = list(stack_images(path, SIZE))
    assert picture_count(path) == len(found) == 3 and picture_count(path, 2) == 2
    for image, expected in zip(found, EIGHT, strict=True):
        assert image.dtype == np.float32 and image.shape == (24, 32)
        error = np.abs(image - expected / 255)
        assert error.mean() < 0.05 if path.suffix in (".mpo", ".jpg") else error.max() < 1e-6


@every_stack
def test_a_file_of_several_pictures_is_no_image(tmp_path, name):
    path = stack_in(tmp_path, name)
    for read in (read_image, read_pixels, image_size, lambda path: mean_image([path])):
        with pytest.raises(MembraneError, match=rf"{name}: it holds 3 pictures; expected one: save the one that is meant"):
            read(path)


@pytest.mark.parametrize("name", ["one.tif", "one.png", "one.webp", "one.jpg", "one.bmp"])
def test_a_file_of_one_picture_is_an_image(tmp_path, name):
    GREY[0].save(tmp_path / name)
    assert picture_count(tmp_path / name) == 1 and read_image(tmp_path / name).shape == (24, 32)
    assert find_inputs([tmp_path]).images == [tmp_path / name]


def test_previews_belong_to_the_picture_that_they_show(tmp_path):
    """Reduced pages and masks of a TIFF, also before the page; pictures of other sizes in an MPO."""
    small = EIGHT[0][::2, ::2]
    for pages in (
        [(EIGHT[0], {}), (small, {254: 1})],
        [(small, {254: 1}), (EIGHT[0], {})],
        [(EIGHT[0], {}), (EIGHT[1], {254: 4}), (small, {255: 2})],
    ):
        (tmp_path / "a.tif").write_bytes(tiff(pages))
        np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif"), EIGHT[0])
        (found,) = stack_images(tmp_path / "a.tif", SIZE)
        np.testing.assert_allclose(found, EIGHT[0] / 255, atol=1e-6)
    path = saved(tmp_path / "a.jpg", [GREY[0], GREY[0].resize((16, 12))], format="MPO")
    assert picture_count(path) == 1 and read_image(path).shape == (24, 32)


def test_a_stack_of_imagej_without_its_directory_is_refused(tmp_path):
    path = tmp_path / "large.tif"
    path.write_bytes(tiff([(EIGHT[0], {270: "ImageJ=1.53t\nimages=500\nslices=500\n"})]))
    for read in (lambda: read_image(path), lambda: list(stack_images(path, SIZE))):
        with pytest.raises(
            MembraneError, match=r"large.tif: holds 500 images by its ImageJ description, .*directory has 1; expected one page"
        ):
            read()
    path.write_bytes(tiff([(image, {270: "ImageJ=1.53t\nimages=3\n"}) for image in EIGHT]))
    assert len(list(stack_images(path, SIZE))) == 3


def test_a_picture_of_another_size_is_refused_alone(tmp_path):
    path = saved(tmp_path / "a.tif", [GREY[0], GREY[1].resize((16, 12)), GREY[2]])
    first, second, third = stack_images(path, SIZE)
    assert isinstance(second, MembraneError) and "the image is 16 x 12 px, expected 32 x 24" in str(second)
    np.testing.assert_allclose([first, third], np.array(EIGHT)[[0, 2]] / 255, atol=1e-6)


@pytest.mark.parametrize("name, kept", [("pages.tif", 1), ("deep.tif", 1), ("animated.png", 0), ("animated.webp", 0)])
def test_a_stack_that_ends_early_says_so(tmp_path, name, kept):
    path = stack_in(tmp_path, name)
    whole, found = path.read_bytes(), []
    path.write_bytes(whole[: int(0.6 * len(whole))])
    with pytest.raises(MembraneError, match=rf"{name}: (damaged, or ends early, after \d pictures|not readable as an image)"):
        found.extend(stack_images(path, SIZE))  # what came before is lost to `extend`
    images = stack_images(path, SIZE)
    assert all(next(images).shape == (24, 32) for _ in range(kept))


def test_pictures_of_an_mpo_are_checked_one_by_one(tmp_path):
    path = saved(tmp_path / "a.mpo", [image.resize(SIZE) for image in GREY], format="MPO")
    whole = path.read_bytes()
    second = whole.index(b"\xff\xda", whole.index(b"\xff\xd9"))
    path.write_bytes(whole[: second + 40] + bytes(60) + whole[second + 100 :])
    first, damaged, third = stack_images(path, SIZE)
    assert isinstance(damaged, MembraneError) and "not readable as an image" in str(damaged)
    assert first.shape == third.shape == (24, 32)


@pytest.fixture
def run(tmp_path) -> Path:
    """A stack of three greys, of the size of the quick reconstructor."""
    grey = [Image.fromarray(np.full((HEIGHT, WIDTH), 60 + 40 * k, np.uint8)) for k in range(3)]
    return saved(tmp_path / "run.tif", grey)


def pressures(out: Path) -> list[float]:
    return [round(255 * float(frame["pressure"])) for frame in read_results(out)]


def test_frames_of_a_stack_are_named_as_those_of_a_video(run, tmp_path):
    inputs = find_inputs([run, grey_image(tmp_path / "one.png", 99)])
    assert inputs.videos == [run] and inputs.images == [tmp_path / "one.png"] and not inputs.need_pyav
    outcome, lines, _ = reconstruct([tmp_path / "one.png", run], tmp_path / "out")
    assert outcome[0] == 4 and not lines
    assert read_results(tmp_path / "out").names == ["one", "run_000000", "run_000001", "run_000002"]
    assert pressures(tmp_path / "out") == [99, 60, 100, 140]
    assert reconstruct([run], tmp_path / "out")[0] == (0, 0, 0, 0, 0, 0, 3)
    with pytest.raises(MembraneError, match="run_000001.png: a frame of .*run.tif has the same name"):
        find_inputs([run, grey_image(tmp_path / "run_000001.png", 9)])


@pytest.mark.parametrize("name", ["run.png", "run.webp", "run.jpg"])
def test_frames_come_of_every_kind_of_stack_and_also_by_the_option_video(run, tmp_path, name):
    with Image.open(run) as image:
        pages = []
        for k in range(3):
            image.seek(k)
            pages.append(image.convert("RGB"))
    path = saved(tmp_path / name, pages, **({"format": "MPO"} if name == "run.jpg" else {"lossless": True}))
    for video in (False, True):
        out = tmp_path / f"out{video}"
        inputs = find_inputs([path], video=video)
        assert inputs.videos == [path]
        reconstruct([path], out)
        assert pressures(out) == pytest.approx([60, 100, 140], abs=2)


def test_a_gif_is_a_video_and_no_image(run, tmp_path):
    path = saved(tmp_path / "run.gif", [Image.new("L", (WIDTH, HEIGHT), 60 + 40 * k) for k in range(3)], duration=100)
    run.unlink()
    assert find_inputs([path]).videos == [path] and find_inputs([path]).need_pyav
    reconstruct([path], tmp_path / "out")
    assert pressures(tmp_path / "out") == pytest.approx([60, 100, 140], abs=2)
    assert [due for due, _ in video_images(path, (WIDTH, HEIGHT), None)] == pytest.approx([0.0, 0.1, 0.2])
    with pytest.raises(MembraneError, match="run.gif: not readable as an image"):
        read_image(path)


def test_a_damaged_end_of_a_stack_is_a_failed_frame_and_the_batch_goes_on(run, tmp_path):
    run.write_bytes(run.read_bytes()[:-20])
    outcome, lines, _ = reconstruct([run, grey_image(tmp_path / "one.png", 99)], tmp_path / "out")
    assert outcome[0] == 3 and outcome.failed == 1 and len(lines) == 1
    assert f"{run}, run_000002: not readable as an image" in lines[0]
    assert summary_of(tmp_path / "out")["run_000002"]["status"] == "-1"


def test_a_stack_of_a_folder_is_followed_picture_by_picture(tmp_path):
    for name in ("a.tif", "b10.png", "b9.webp"):
        saved(tmp_path / name, GREY, lossless=True)
    Image.fromarray(255 - EIGHT[0]).save(tmp_path / "c.png")
    found = list(folder_images(tmp_path, SIZE, 10.0))
    assert [round(10 * due) for due, _ in found] == list(range(10))
    for (_, image), expected in zip(found, [*3 * EIGHT, 255 - EIGHT[0]], strict=True):
        np.testing.assert_allclose(image, expected / 255, atol=1e-6)
    as_video = list(video_images(tmp_path / "a.tif", SIZE, None))
    assert [due for due, _ in as_video] == pytest.approx([0, 1 / 30, 2 / 30])


def test_where_images_are_meant_stacks_and_videos_are_refused(run, tmp_path):
    with pytest.raises(MembraneError, match="run.tif: holds several pictures; expected images here, each as a file of its own"):
        single_images(find_inputs([run]))
    (tmp_path / "a.mp4").touch()
    with pytest.raises(MembraneError, match="a.mp4: holds several pictures"):
        single_images(find_inputs([tmp_path / "a.mp4"]))


@pytest.mark.parametrize("step", ["rest_image", "camera", "rest", "material", "init", "image"])
def test_commands_take_no_picture_of_a_stack_for_an_image(small_sensor, tmp_path, capsys, step):
    sensor, out = str(small_sensor / "sensor.toml"), str(tmp_path / "out")
    stack = str(saved(tmp_path / "stack.tif", [image.resize((160, 120)) for image in GREY]))
    if step == "rest_image":
        text = (small_sensor / "sensor.toml").read_text()
        (tmp_path / "s.toml").write_text(text + 'rest_image = "stack.tif"\n')
        (tmp_path / "sensor_dots.csv").write_bytes((small_sensor / "sensor_dots.csv").read_bytes())
    options = {
        "rest_image": ["check", str(tmp_path / "s.toml")],
        "camera": ["calibrate", "camera", sensor, stack, "--corners", "9,6", "--square", "3", "--out", out],
        "rest": ["calibrate", "rest", sensor, stack, "--out", out],
        "material": ["calibrate", "material", sensor, stack, "--out", out],
        "init": ["init", str(tmp_path / "i.toml"), *"--shape dome --radius 8 --distance 9 --view 90 --rest".split(), stack],
        "image": ["view", str(tmp_path / "a.npz"), "--image", stack],
    }
    if step == "image":
        reconstruct([grey_image(tmp_path / "a.png", 99)], tmp_path / "results", reconstructor=Denting())
        options["image"] = ["view", str(tmp_path / "results"), "--frame", "a", "--image", stack, "--out", out]
    assert main(options[step]) == 2
    said = capsys.readouterr().err
    assert "stack.tif: " in said and ("it holds 3 pictures" in said or "holds several pictures" in said)


def test_pages_in_a_ring_end(tmp_path):
    """The last page's link leads back to the first."""
    content = bytearray(tiff([(image, {}) for image in EIGHT]))
    first = struct.unpack("<I", content[4:8])[0]
    content[-4:] = struct.pack("<I", first)
    (tmp_path / "ring.tif").write_bytes(content)
    assert picture_count(tmp_path / "ring.tif") == 3
