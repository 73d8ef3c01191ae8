"""Untrusted results are refused in one line or made anew."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from test_batch import NPZ, PARQUET, grey_image, reconstruct

from torchmembrane.cli.main import main
from torchmembrane.errors import MembraneError
from torchmembrane.files import parquet
from torchmembrane.jobs.inputs import find_inputs
from torchmembrane.jobs.pressure import read_pressures
from torchmembrane.live.recording import times_of
from torchmembrane.results import frame_table
from torchmembrane.results.read import read_frame, read_results

FRAMES = 4


@pytest.fixture
def images(tmp_path) -> list[Path]:
    (tmp_path / "images").mkdir()
    return [grey_image(tmp_path / "images" / f"i{k}.png", 40 + 30 * k) for k in range(FRAMES)]


def refused(use, *arguments) -> str:
    with pytest.raises(MembraneError) as caught:
        use(*arguments)
    message = str(caught.value)
    assert message.isprintable() and len(message) < 700
    return message


def changed(path: Path, **arrays) -> None:
    with np.load(path) as file:
        held = dict(file)
    np.savez(path, **(held | arrays))


@pytest.mark.parametrize(
    "change",
    [
        {"vertices": np.zeros((9, 3), np.float32)},
        {"force": np.array(["a", "b", "c"])},
        {"contact_points": np.float32(1)},
        {"status": np.zeros(2, np.int32)},
        {"pixels": np.zeros((7, 2), complex)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_result_of_other_shapes_is_refused_by_name_and_done_again(images, tmp_path, change):
    reconstruct(images, tmp_path / "out")
    changed(tmp_path / "out" / "i1.npz", **change)
    if "status" not in change:
        assert f"{tmp_path / 'out'}" in refused(lambda: read_results(tmp_path / "out")["i1"])
        assert "i1" in refused(lambda: list(read_results(tmp_path / "out")))
    outcome, lines, _ = reconstruct(images, tmp_path / "out")
    assert outcome.reconstructed == 1 and lines == [f"{tmp_path / 'out' / 'i1.npz'}: damaged, done again"]
    assert len(read_results(tmp_path / "out").batch().status) == FRAMES


@pytest.mark.parametrize(
    "change",
    [
        {"element": np.array("\x1b[2J")},
        {"name": np.array("\x07" * 5000), "sensor": np.array("\n")},
        {"rest_normals": np.zeros((25, 2), np.float32)},
        {"triangles": np.full((32, 3), 25)},
        {"triangles": np.full((32, 3), -1)},
        {"grid": np.array([5.5, np.nan])},
        {"smoothing": np.array("text")},
        {"camera_in_tool": np.float32(3)},
        {"format": np.array("zip")},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_mesh_of_others_is_refused_in_one_printable_line(images, tmp_path, change):
    reconstruct(images, tmp_path / "out")
    changed(tmp_path / "out" / "mesh.npz", **change)
    assert str(tmp_path / "out") in refused(reconstruct, images, tmp_path / "out")


@pytest.mark.parametrize("place", ["i1.npz", "mesh.npz", "summary.csv"])
def test_a_pipe_among_results_is_not_waited_for(images, tmp_path, place):
    reconstruct(images, tmp_path / "out")
    (tmp_path / "out" / place).unlink()
    os.mkfifo(tmp_path / "out" / place)
    if place == "i1.npz":
        assert reconstruct(images, tmp_path / "out")[0].reconstructed == 1
    else:
        assert "a pipe" in refused(reconstruct, images, tmp_path / "out")


def part_of(images, out) -> Path:
    reconstruct(images, out, PARQUET)
    return out / "frames" / "part-00000.parquet"


def test_parts_that_lead_nowhere_are_refused_when_read_and_set_aside_when_gone_on_with(images, tmp_path):
    part = part_of(images, tmp_path / "out")
    for target in (part.name, "nothing"):
        part.unlink()
        part.symlink_to(target)
        assert str(part) in refused(read_results, tmp_path / "out")
        assert reconstruct(images, tmp_path / "out", PARQUET)[0].reconstructed == FRAMES
        assert part.with_suffix(".damaged").is_symlink()
    (part.parent / "part-of-something.parquet").write_bytes(b"else")
    assert len(read_results(tmp_path / "out")) == FRAMES


def test_parts_whose_columns_or_shapes_are_others_are_refused(images, tmp_path):
    part = part_of(images, tmp_path / "out")
    whole = pq.read_table(part)
    shapes = b'{"vertices": [3, 25], "force": [-1, 99]}'
    spoiled = [
        whole.set_column(0, "name", pa.array(range(FRAMES))),
        whole.drop(["force"]),
        whole.replace_schema_metadata({}),
        whole.replace_schema_metadata({b"shapes": b"[" * 100_000}),
        whole.replace_schema_metadata({b"shapes": shapes}),
        whole.set_column(whole.column_names.index("pressure"), "pressure", pa.array(["a"] * FRAMES)),
    ]
    for number, table in enumerate(spoiled):
        pq.write_table(table, part)
        assert str(tmp_path / "out") in refused(lambda: list(read_results(tmp_path / "out"))), number
        assert reconstruct(images, tmp_path / "out", PARQUET)[0].reconstructed == FRAMES, number


def test_a_damaged_footer_ends_no_process(images, tmp_path):
    """Footers have no checksum; PyArrow ends the process where it is asked what a damaged one says of a column."""
    part = part_of(images, tmp_path / "out")
    script = """
import sys, random
from pathlib import Path
from torchmembrane.errors import MembraneError
from torchmembrane.files.parquet import read_table
part = Path(sys.argv[1])
whole, draw, refused = part.read_bytes(), random.Random(0), 0
begin = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
for _ in range(400):
    content = bytearray(whole)
    content[draw.randrange(begin, len(whole))] ^= 1 << draw.randrange(8)
    part.write_bytes(content)
    try:
        read_table(part, "a part", "one")
    except MembraneError:
        refused += 1
print(refused)
"""
    done = subprocess.run([sys.executable, "-c", script, str(part)], capture_output=True, text=True)
    assert done.returncode == 0 and int(done.stdout) > 100, done.stderr[-500:]


def test_a_part_that_unpacks_to_more_than_the_bound_is_refused_before(images, tmp_path, monkeypatch):
    """The same number a hundred million times takes a few kilobytes as a file."""
    part = part_of(images, tmp_path / "out")
    run = pa.DictionaryArray.from_arrays(pa.array(np.zeros(10**7, np.int8)), pa.array([1.0]))
    pq.write_table(pa.table({"name": pa.chunked_array([run] * 15).cast(pa.float64())}), part)
    assert part.stat().st_size < 2e6 and "more than" in refused(read_frame, part)
    monkeypatch.setattr(parquet, "MOST_BYTES", 10)
    assert "at most 10 bytes" in refused(read_frame, part)


def test_of_large_surfaces_a_part_holds_fewer_frames(images, tmp_path, monkeypatch):
    monkeypatch.setattr(frame_table, "PART_BYTES", 5000)
    part_of(images, tmp_path / "out")
    assert [pq.read_metadata(part).num_rows for part in sorted((tmp_path / "out" / "frames").iterdir())] == [2, 2]
    assert len(read_results(tmp_path / "out").batch().status) == FRAMES


@pytest.mark.parametrize(
    "content",
    [b"", b"\xff\xfe", b"a\0b", b"name,pressure\n" + b"x" * 200_000, b'name,pressure\n"i0', b"name,pressure\ni0,1e999\n"]
    + [b"n" * 5000 + b"\n1\n", b"name,pressure\n\x1b[2J,1\n", b"name,pressure\ni0,1,2\n", b"name,pressure\n"],
    ids=range(10),
)
def test_readings_of_others_are_refused_in_one_printable_line(images, tmp_path, content):
    (tmp_path / "p.csv").write_bytes(content)
    sensor = SimpleNamespace(length_unit="mm")
    assert str(tmp_path / "p.csv") in refused(read_pressures, tmp_path / "p.csv", find_inputs(images), sensor)


def test_a_pipe_of_readings_is_not_waited_for(images, tmp_path):
    os.mkfifo(tmp_path / "p.csv")
    assert "a pipe" in refused(read_pressures, tmp_path / "p.csv", find_inputs(images), None)


@pytest.mark.parametrize("content", [b"name,time,latency\na,b,c\n", b"\xff", b'"' + b"x" * 200_000])
def test_damaged_times_of_a_recording_are_refused(tmp_path, content):
    (tmp_path / "times.csv").write_bytes(content)
    assert "times.csv" in refused(times_of, tmp_path)


def test_a_mesh_of_another_sensor_is_no_mesh_of_a_frame(images, tmp_path, capsys):
    reconstruct(images, tmp_path / "out")
    changed(tmp_path / "out" / "mesh.npz", rest_pixels=np.zeros((9, 2), np.float32))
    assert main(["view", str(tmp_path / "out" / "i0.npz"), "--out", str(tmp_path / "i0.png")]) == 2
    assert "markers is" in capsys.readouterr().err


def test_simulations_of_others_are_refused(small_sensor, tmp_path, capsys):
    given = ["--indenter", "sphere", "--radius", "2", "--depth", "1"]
    command = ["simulate", str(small_sensor / "sensor.toml"), *given, "--out", str(tmp_path / "out")]
    (tmp_path / "out").mkdir()
    for content in (b"[" * 100_000, b"[1]", b"\xff", b""):
        (tmp_path / "out" / "simulation.json").write_bytes(content)
        assert main(command) == 2
        said = capsys.readouterr().err.strip()
        assert "simulation.json: not readable" in said and said.isprintable()


def test_results_without_a_status_are_no_results(images, tmp_path):
    reconstruct(images, tmp_path / "out", NPZ)
    np.savez(tmp_path / "out" / "other.npz", vertices=np.zeros(3))
    (tmp_path / "out" / "link.npz").symlink_to("/dev/zero")
    assert read_results(tmp_path / "out").names == [path.stem for path in images]
