"""Machine code is used where it exists, one way for a whole job."""

import logging
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

import torchmembrane as tm
from torchmembrane import machine_code
from torchmembrane.cli.main import main
from torchmembrane.jobs import local
from torchmembrane.machine_code import Kept, is_used, kept, takes, using

SINGLE, DOUBLE = np.dtype("float32"), np.dtype("float64")


@pytest.fixture
def function(tmp_path, monkeypatch):
    """A function whose machine code is kept in a folder of its own."""

    class OnDisk:
        class stats:
            cache_path = str(tmp_path)

    return OnDisk


def test_what_is_compiled_is_known_by_precision_in_this_process_and_the_next(function):
    first = Kept(function, "sources")
    assert not first.is_compiled(SINGLE)
    with first.compiling(SINGLE):
        pass
    assert first.is_compiled(SINGLE) and not first.is_compiled(DOUBLE)
    assert Kept(function, "sources").is_compiled(SINGLE) and not Kept(function, "sources").is_compiled(DOUBLE)


def test_other_sources_are_not_compiled_yet(function):
    with Kept(function, "sources").compiling(SINGLE):
        pass
    assert not Kept(function, "changed").is_compiled(SINGLE)


def test_another_function_of_the_same_sources_is_not_compiled_yet(function):
    with Kept(function, "sources").compiling(SINGLE):
        pass
    other = type("Other", (), {"stats": function.stats})
    assert not Kept(other, "sources").is_compiled(SINGLE)


def test_a_call_that_fails_has_compiled_nothing(function):
    code = Kept(function, "sources")
    with pytest.raises(ValueError), code.compiling(SINGLE):
        raise ValueError
    assert not code.is_compiled(SINGLE)


def test_compiling_is_said_once_with_its_expected_time(function, caplog):
    code = Kept(function, "sources")
    with caplog.at_level(logging.WARNING, "torchmembrane"):
        for _ in range(2):
            with code.compiling(DOUBLE):
                pass
    assert [record.getMessage() for record in caplog.records] == [
        "torchmembrane: compiling machine code for float64, about 60 s, once"
    ]


def test_threads_that_begin_together_say_it_once(function, caplog):
    code, begun = Kept(function, "sources"), threading.Barrier(4)

    def call(_):
        with code.compiling(SINGLE):
            begun.wait(60)  # all are within before one has compiled

    with caplog.at_level(logging.WARNING, "torchmembrane"), ThreadPoolExecutor(4) as pool:
        list(pool.map(call, range(4)))
    assert len(caplog.records) == 1


def test_where_nothing_can_be_kept_this_process_knows_it_alone():
    code = Kept(kept(lambda x: x), "sources")
    code.folder = None
    with code.compiling(SINGLE):
        pass
    assert code.is_compiled(SINGLE)


def test_tensor_operations_find_what_machine_code_finds(reconstructor):
    images = reconstructor.read("examples/two_contacts.png")
    with torch.no_grad():
        by_code = reconstructor(images)
        with using(False):
            assert not is_used() and not takes(images)
            by_tensors = reconstructor(images)
    assert is_used() and takes(images)
    assert (by_code.status == by_tensors.status).all()
    torch.testing.assert_close(by_code.vertices, by_tensors.vertices, rtol=0, atol=2e-3)


@pytest.mark.parametrize("few, by_code", [(50, False), (3, True), (1, True)])
def test_a_job_is_solved_in_one_way_from_its_first_frame_to_its_last(
    small_sensor, small_images, tmp_path, monkeypatch, capsys, few, by_code
):
    """The way is chosen before the first frame, by the number of frames, and said where code is not compiled yet."""
    asked = []
    monkeypatch.setattr(local, "FEW_FRAMES", few)
    monkeypatch.setattr(tm.ForceBalance, "must_compile", property(lambda self: not asked))  # compiled after the first frame
    monkeypatch.setattr(machine_code, "is_used", lambda: asked.append(is_used()) or asked[-1])
    assert (
        main(
            ["reconstruct", str(small_sensor / "sensor.toml"), *map(str, small_images), "--out", str(tmp_path), "--batch", "1"]
        )
        == 0
    )
    assert set(asked) == {by_code}
    said = (
        f"torchmembrane: 3 frames are solved by tensor operations; the first job of {few} frames or more compiles machine code"
    )
    assert (said in capsys.readouterr().err) is not by_code
