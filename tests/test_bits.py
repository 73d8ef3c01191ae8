"""One key tells how many bits of 16 a camera uses, for all images."""

import json
import re
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from PIL import Image

import torchmembrane as tm
from torchmembrane.calibrate.camera import _with
from torchmembrane.camera.model import Camera
from torchmembrane.cli.main import main
from torchmembrane.files.images import read_image, to_grey
from torchmembrane.files.levels import too_few_bits
from torchmembrane.integrations.messages import grey_of
from torchmembrane.live.line import described
from torchmembrane.live.loop import LiveFrame, StreamStats
from torchmembrane.live.recording import Recording
from torchmembrane.live.sources import folder_images
from torchmembrane.live.streams import ModelStream, TrackedStream
from torchmembrane.onnx.export import metadata_of
from torchmembrane.results.read import read_results
from torchmembrane.sensor.sensor import Sensor

ROOT = Path(__file__).parents[1]
BITS = (10, 12, 14)


@pytest.fixture(scope="module")
def rest_image(small_sensor):
    """That of the small sensor, grey of 8 bits."""
    from torchmembrane.simulate.simulator import Simulator

    return np.rint(255 * Simulator(Sensor.from_file(small_sensor / "sensor.toml")).rest_image()).astype(np.uint8)


def stored(image: np.ndarray, bits: int) -> np.ndarray:
    """An image of 8 bits as a camera of so many has it."""
    return np.rint(image / 255 * (2**bits - 1)).astype(np.uint16)


@pytest.fixture(scope="module")
def folder(small_sensor, small_images, rest_image, tmp_path_factory):
    """Sensor files and images of cameras of 8, 10, 12 and 14 bits; of each also a file that does not say so."""
    folder = tmp_path_factory.mktemp("bits")
    text = (small_sensor / "sensor.toml").read_text()
    (folder / "sensor_dots.csv").write_bytes((small_sensor / "sensor_dots.csv").read_bytes())
    press = np.asarray(Image.open(small_images[2]).convert("L"))
    for bits in (8, *BITS):
        for name, image in (("rest", rest_image), ("press", press)):
            values = image if bits == 8 else stored(image, bits)
            Image.fromarray(values).save(folder / f"{name}{bits}.png")
        found = text.replace('polarity = "dark"', f'polarity = "dark"\nrest_image = "rest{bits}.png"')
        (folder / f"unsaid{bits}.toml").write_text(found)
        key = "" if bits == 8 else f"bits = {bits}\n"
        (folder / f"sensor{bits}.toml").write_text(found.replace("distortion = []\n", f"distortion = []\n{key}"))
    return folder


@pytest.fixture(scope="module")
def expected(folder):
    """The press of the camera of 8 bits."""
    reconstructor = tm.Reconstructor.from_file(folder / "sensor8.toml")
    return reconstructor(reconstructor.read(folder / "press8.png"))


@pytest.mark.parametrize("bits", BITS)
def test_rest_and_frames_are_read_with_the_camera_s_bits_on_every_path(folder, expected, bits):
    reconstructor = tm.Reconstructor.from_file(folder / f"sensor{bits}.toml")
    values = stored(np.asarray(Image.open(folder / "press8.png")), bits)
    message = types.SimpleNamespace(
        encoding="mono16", width=160, height=120, step=320, is_bigendian=0, data=values.astype("<u2").tobytes()
    )
    assert reconstructor.sensor.camera.bits == bits
    for image in (
        reconstructor.read(folder / f"press{bits}.png"),
        values,
        torch.from_numpy(values),
        np.repeat(values[..., None], 3, -1),
        grey_of(message, (160, 120), bits),
        next(folder_images(folder / f"press{bits}.png", (160, 120), 1.0, bits)).image,
    ):
        np.testing.assert_allclose(reconstructor.grey(image)[0, 0], reconstructor.read(folder / "press8.png")[0, 0], atol=2e-3)
        found = reconstructor(image)
        assert int(found.status[0]) == 0
        np.testing.assert_allclose(found.force, expected.force, atol=0.02 * float(expected.force.norm()))


@pytest.mark.parametrize("bits", (10, 12))
def test_what_shows_nothing_says_how_high_its_values_go(folder, bits, capsys, tmp_path):
    unscaled = 2**bits - 1
    said = f"of 65535, as of a camera of {bits} bits: say bits = {bits} in the file's [camera]"
    assert main(["reconstruct", str(folder / "sensor8.toml"), str(folder / "press10.png"), "--out", str(tmp_path / "a")]) == 1
    err = capsys.readouterr().err
    assert "press10.png: blank or saturated image: no contrast; no surface; its values go up to " in err
    with pytest.raises(tm.MembraneError, match=re.escape(said)):
        tm.Reconstructor.from_file(folder / f"unsaid{bits}.toml")
    high = np.asarray(Image.open(folder / f"press{bits}.png")).max()
    assert high <= unscaled and f"up to {high} {said}" in too_few_bits(read_image(folder / f"press{bits}.png"))


def test_only_values_of_fewer_bits_are_said_to_be_such():
    rng = np.random.default_rng(0)
    dark = rng.integers(0, 4, (9, 9, 3), np.uint8)
    for image in (
        dark[..., 0],
        to_grey(dark),
        to_grey(dark[..., 0]),
        np.zeros((4, 4), np.uint16),
        np.zeros((4, 4), np.float32),
    ):
        assert too_few_bits(image) == ""
    values = rng.integers(0, 40000, (3, 8, 8), np.uint16)
    assert too_few_bits(values) == "" and "of 10 bits" in too_few_bits(values // 64)
    for averaged in (to_grey(values[0] // 64), np.mean([to_grey(each // 64) for each in values], 0)):
        assert "of 10 bits" in too_few_bits(averaged)
    blocks = to_grey(values[0] // 16).reshape(4, 2, 4, 2).mean((1, 3)).astype(np.float32)  # a camera's mode
    assert "of 12 bits" in too_few_bits(blocks)


def test_values_beyond_the_bits_are_refused_and_the_batch_goes_on(folder, tmp_path, capsys):
    images = [str(folder / f"press{bits}.png") for bits in (10, 12)]
    assert main(["reconstruct", str(folder / "sensor10.toml"), *images, "--out", str(tmp_path / "out")]) == 1
    assert "press12.png: values up to" in (err := capsys.readouterr().err) and "expected at most 1023, as bits = 10" in err
    assert read_results(tmp_path / "out").names == ["press10"]
    reconstructor = tm.Reconstructor.from_file(folder / "sensor10.toml")
    for values in (np.full((120, 160), 1024, np.uint16), torch.full((120, 160), 1024, dtype=torch.uint16)):
        with pytest.raises(tm.MembraneError, match="values up to 1024; expected at most 1023"):
            reconstructor(values)
    with pytest.raises(tm.MembraneError, match=r"rest_image = .rest12.png.: .*values up to .* as bits = 10"):
        (folder / "wrong.toml").write_text((folder / "sensor10.toml").read_text().replace("rest10.png", "rest12.png"))
        Sensor.from_file(folder / "wrong.toml")


@pytest.mark.parametrize(
    "value, said",
    [("7", "bits is 7; expected a whole number from 8 to 16"), ("17", "bits is 17"), ("10.0", "bits = 10.0; expected a whole"),
     ('"12"', "expected a whole number"), ("[12]", "expected a whole number"), ("true", "expected a whole number")],
)  # fmt: skip
def test_bits_that_no_camera_has_are_refused(folder, value, said):
    text = (folder / "sensor10.toml").read_text().replace("bits = 10", f"bits = {value}")
    (folder / "wrong.toml").write_text(text)
    with pytest.raises(tm.MembraneError, match=re.escape(said)) as caught:
        Sensor.from_file(folder / "wrong.toml")
    assert str(caught.value).startswith(f"{folder / 'wrong.toml'}: [camera]")


@pytest.mark.parametrize("bits", [None, *BITS, 16])
def test_a_sensor_is_written_and_read_with_its_bits(folder, tmp_path, bits):
    sensor = Sensor.from_file(folder / "sensor8.toml")
    camera = sensor.camera
    lens = camera.model, camera.image_size, camera.focal.tolist(), camera.centre.tolist()
    grey = sensor.markers.rest_image if bits is None else to_grey(stored(np.rint(255 * sensor.markers.rest_image), bits), bits)
    made = replace(sensor, camera=Camera(*lens, bits=bits), markers=replace(sensor.markers, rest_image=grey))
    again = Sensor.from_file(made.to_file(tmp_path))
    assert again.camera.bits == bits and again.fingerprint == made.fingerprint
    np.testing.assert_array_equal(again.markers.rest_image, grey)
    assert ("bits" in (tmp_path / "sensor.toml").read_text()) == (bits is not None)
    if bits is None:
        assert made.fingerprint == sensor.fingerprint
    for other in (made.camera.in_mode(None, 2), _with(made.camera, {"medium_index": torch.ones(())})):
        assert other.bits == bits


def test_an_exported_model_says_the_bits(folder):
    models = [tm.Reconstructor.from_file(folder / f"sensor{bits}.toml") for bits in (8, 12)]
    assert [metadata_of(model).get("bits") for model in models] == [None, "12"]
    assert json.loads(metadata_of(models[1])["mesh"])["name"] == "cap"


@pytest.fixture
def model12(folder, tmp_path):
    """A model that gives back its image, with the metadata of a sensor of 12 bits."""
    made = tm.Reconstructor.from_file(folder / "sensor12.toml")
    width, height = made.image_size
    outputs = ("seen", "vertices", "displacement", "force", "status")
    ends = {name: onnx.helper.make_tensor_value_info(name, 1, ["batch", 1, height, width]) for name in ("image", *outputs)}
    nodes = [onnx.helper.make_node("Identity", ["image"], [name]) for name in outputs]
    graph = onnx.helper.make_graph(nodes, "seen", [ends["image"]], [ends[name] for name in outputs])
    model = onnx.helper.make_model(graph, ir_version=8, opset_imports=[onnx.helper.make_opsetid("", 18)])
    onnx.helper.set_model_props(model, metadata_of(made))
    onnx.save(model, tmp_path / "model.onnx")
    return tmp_path / "model.onnx", made.sensor.fingerprint, (height, width)


def test_the_edge_package_and_live_scale_by_the_bits_of_a_model(model12, monkeypatch):
    path, sensor, shape = model12
    monkeypatch.syspath_prepend(ROOT / "export")
    monkeypatch.setattr("torchmembrane.live.streams.completed", lambda frame: frame)
    from torchmembrane_edge import Session

    session, stream = Session(path), ModelStream(path, sensor)
    assert session.bits == 12
    values = np.linspace(0, 4095, shape[0] * shape[1]).astype(np.uint16).reshape(shape)
    for image in (values, to_grey(values, 12)):
        np.testing.assert_array_equal(session.run(image)["seen"][0, 0], to_grey(values, 12))
        np.testing.assert_array_equal(stream(image, 0.0)["seen"][0], to_grey(values, 12))
    colour = np.repeat(values[..., None], 3, -1)
    np.testing.assert_allclose(session.run(colour[None])["seen"][0, 0], to_grey(values, 12), atol=1e-6)
    values[3, 4] = 4096
    with pytest.raises(
        tm.MembraneError,
        match="--model .*: the model refuses the camera's image: values up to 4096; expected at most 4095 for the 12 bits",
    ):
        stream(values, 0.0)


def test_a_recording_of_such_a_camera_is_read_as_it_was_followed(folder, tmp_path):
    reconstructor = tm.Reconstructor.from_file(folder / "sensor12.toml")
    stream, values = TrackedStream(reconstructor), np.asarray(Image.open(folder / "press12.png"))
    images = [values, np.repeat(values[..., None], 3, -1), to_grey(values, 12)]
    with Recording(tmp_path / "day", stream.mesh, 12) as recording:
        for k, image in enumerate(images):
            recording.keep(LiveFrame(k, float(k), image, stream(image, float(k)), 0.0))
    for path in sorted((tmp_path / "day" / "images").iterdir()):
        np.testing.assert_allclose(reconstructor.read(path)[0, 0], to_grey(values, 12), atol=1e-6)


def test_the_line_of_live_says_what_bits_a_blank_image_looks_like(folder):
    stream = TrackedStream(tm.Reconstructor.from_file(folder / "sensor8.toml"))
    for image in (np.asarray(Image.open(folder / "press10.png")), read_image(folder / "press10.png")):
        seen, stats = LiveFrame(0, 0.0, image, stream(image, 0.0), 0.1), StreamStats()
        stats.add(seen)
        assert "blank or saturated" in (said := described(seen, stats, stream.mesh)) and "as of a camera of 10 bits" in said
        stream.tracker.reset()


def test_init_takes_the_bits_of_its_rest_image(folder, tmp_path, capsys):
    options = "--shape cap --radius 8 --height 4 --distance 14 --focal 100 --centre 79,60 --rest".split()
    command = ["init", str(tmp_path / "s.toml"), *options, str(folder / "rest10.png")]
    assert main(command) == 2 and "as of a camera of 10 bits: say bits = 10" in capsys.readouterr().err
    assert main([*command, "--bits", "10"]) == 0
    assert Sensor.from_file(tmp_path / "s.toml").camera.bits == 10
    assert main([*command, "--bits", "9", "--force"]) == 2 and "as bits = 9 in" in capsys.readouterr().err


@pytest.mark.parametrize("count", [1, 3, 16])
def test_means_of_up_to_sixteen_images_of_few_bits_are_recognised(count):
    images = np.random.default_rng(0).integers(0, 2**10, (count, 12, 16))
    assert "as of a camera of 10 bits" in too_few_bits(images.mean(0).astype(np.float32) / 65535)
    assert too_few_bits(images.mean(0) / 1023 * 0.9) == ""
