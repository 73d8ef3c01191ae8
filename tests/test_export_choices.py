"""Every choice that the command offers, exported and run; models that cannot be written, or are not the same when they are."""

from itertools import product

import numpy as np
import onnx
import pytest
import torch

from torchmembrane.cli import main as cli
from torchmembrane.estimators.settings import ELEMENTS, FLOWS, VOLUMES
from torchmembrane.onnx import check, export
from torchmembrane.onnx.check import Agreement, check_images, compare
from torchmembrane.onnx.graph import traced
from torchmembrane.reconstruct import ESTIMATORS, Reconstructor
from torchmembrane.sensor.sensor import Sensor

CHOICES = [
    *(
        ("minimum-energy", dict(element=element, volume=volume, flow=flow), model)
        for element, volume, flow, model in (
            ("triangle", "exact", "smooth", "mooney_rivlin"),
            ("triangle", "linear", "bilinear", "harmonic"),
            ("quadrilateral", "exact", "bilinear", None),
            ("quadrilateral", "linear", "smooth", None),
        )
    ),
    *(("paper", dict(flow=flow), None) for flow in FLOWS),
]
"""Every element with every volume, and every flow: between them all that any combination is put together of."""


@pytest.fixture(scope="module")
def shared(small_sensor):
    """What finds the markers, one for all, and what it was traced as."""
    sensor, known, trace = Sensor.from_file(small_sensor / "sensor.toml"), {}, export.traced

    def once(piece, inputs, outputs):
        key = piece.owner, piece.function, *inputs
        known[key] = known.get(key) or trace(piece, inputs, outputs)
        return known[key]

    return sensor, Reconstructor(sensor, "paper", locator="fit").observer, once


def test_the_choices_are_all_there_are():
    chosen = [options for estimator, options, _ in CHOICES if estimator == "minimum-energy"]
    assert {(c["element"], c["volume"]) for c in chosen} == set(product(ELEMENTS, VOLUMES))
    assert {c["flow"] for c in chosen} == set(FLOWS)


def nodes(graph):
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            yield from nodes(attribute.g)


@pytest.mark.parametrize("estimator, options, model", CHOICES)
def test_every_choice_of_the_command_agrees_with_torch(shared, small_images, estimator, options, model, tmp_path, monkeypatch):
    sensor, observer, once = shared
    made = Reconstructor(sensor, estimator, settings=ESTIMATORS[estimator].Settings(**options), model=model, locator="fit")
    made.observer = observer
    images = made.read(*small_images)
    monkeypatch.setattr(export, "traced", once)
    monkeypatch.setattr(check, "check_images", lambda reconstructor: images)
    written = export.export(made, tmp_path / "model.onnx")
    assert {node.domain for node in nodes(written.graph)} == {""}
    found = compare((tmp_path / "model.onnx").read_bytes(), made, images)
    assert found.status == found.expected == [0, 0, 0] and found.distance < 1e-4
    with torch.no_grad():
        assert made(images).displacement.norm(dim=-1).max() > 0.05


def test_a_model_is_checked_on_the_sensor_at_rest_and_pressed(shared):
    sensor, observer, _ = shared
    made = Reconstructor(sensor, "minimum-energy")
    with torch.no_grad():
        rest, pressed, again = made(check_images(made)).displacement.norm(dim=-1).amax(-1)
    assert max(rest, again) < 0.05 < 0.1 < pressed


class Doubled(torch.nn.Module):
    def forward(self, *x):
        return torch.ones(len(x[0]), 3) * x[0]


def test_what_holds_for_one_batch_only_is_refused():
    with pytest.raises(ValueError, match="this batch alone"):
        traced(Doubled(), {"x": torch.rand(2, 3)}, ["y"])


def in_one_line(code, captured):
    said = captured.err.strip().splitlines()
    assert code == 2 and len(said) == 1, captured.err
    return said[0]


def test_a_model_that_is_not_the_same_is_not_written(shared, small_sensor, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(export, "traced", shared[2])
    monkeypatch.setattr(check, "compare", lambda *_: Agreement(0.02, [0, 0], [0, 0]))
    path = tmp_path / "model.onnx"
    call = ["export", str(small_sensor / "sensor.toml"), "--estimator", "minimum-energy", "-o", str(path)]
    assert "2.0e-02 from torch's" in in_one_line(cli.main(call), capsys.readouterr())
    monkeypatch.setattr(check, "compare", lambda *_: Agreement(0.0, [0, 0], [0, 2]))
    assert "statuses [0, 0], torch's [0, 2]" in in_one_line(cli.main(call), capsys.readouterr())
    monkeypatch.setattr(check, "compare", lambda *_: Agreement(np.nan, [0, 0], [0, 0]))
    assert "nan from torch's" in in_one_line(cli.main(call), capsys.readouterr())
    assert list(tmp_path.iterdir()) == []


def test_what_the_exporter_cannot_write_is_said_in_one_line(small_sensor, tmp_path, monkeypatch, capsys):
    def refuse(*_):
        raise onnx.shape_inference.InferenceError("[ShapeInferenceError] ranks differ\n  in node 3\n")

    monkeypatch.setattr(export, "traced", refuse)
    call = ["export", str(small_sensor / "sensor.toml"), "-o", str(tmp_path / "model.onnx")]
    assert "cannot be written as ONNX: [ShapeInferenceError] ranks differ" in in_one_line(cli.main(call), capsys.readouterr())
    assert list(tmp_path.iterdir()) == []


def test_single_precision_only(shared, tmp_path):
    with pytest.raises(export.MembraneError, match="float64; expected torch.float32"):
        export.export(Reconstructor(shared[0], "minimum-energy", dtype=torch.float64), tmp_path / "model.onnx")
