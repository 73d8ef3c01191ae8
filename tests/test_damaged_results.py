"""Damaged results in a folder: named, never left out."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from test_batch import PARQUET, grey_image, reconstruct

from torchmembrane.cli.main import main
from torchmembrane.errors import MembraneError
from torchmembrane.results.read import read_results


@pytest.fixture
def images(tmp_path) -> list[Path]:
    (tmp_path / "images").mkdir()
    return [grey_image(tmp_path / "images" / f"i{k}.png", 40 + 30 * k) for k in range(5)]


DAMAGES = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("no result"),
    "status": lambda path: rewritten(path, status=np.array(42, np.int32)),
    "no number": lambda path: rewritten(path, status=np.array(np.nan)),
}


def rewritten(path: Path, **arrays) -> None:
    with np.load(path) as stored:
        arrays = {**stored, **arrays}
    np.savez(path, **arrays)


@pytest.mark.filterwarnings("ignore:.*damaged, and refused when read")
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_result_is_named_and_never_left_out(images, tmp_path, capsys, damage):
    reconstruct(images, tmp_path / "out")
    path = tmp_path / "out" / "i3.npz"
    DAMAGES[damage](path)
    results = read_results(tmp_path / "out")
    assert results.names == [image.stem for image in images] and int(results["i2"]["status"]) == 0
    for read in (lambda: results["i3"], lambda: list(results), results.batch, results.to_pandas):
        with pytest.raises(MembraneError, match=r"out/i3.npz: not (readable|a result of torchmembrane) "):
            read()
    for command in ([str(path)], [str(tmp_path / "out"), "--video-out", str(tmp_path / "a.gif")]):
        assert main(["view", *command]) == 2
        assert f"error: {path}: not " in capsys.readouterr().err
    assert not (tmp_path / "a.gif").exists()
    outcome, lines, _ = reconstruct(images, tmp_path / "out")
    assert outcome[0] == 1 and lines == [f"{path}: damaged, done again"]


def test_damaged_results_are_said_when_a_folder_is_opened(images, tmp_path):
    reconstruct(images, tmp_path / "out")
    np.savez(tmp_path / "out" / "of_somebody.npz", values=np.ones(3))  # no result, and none that is damaged
    for name in ("i1", "i4"):
        (tmp_path / "out" / f"{name}.npz").write_bytes(b"PK")
    words = r"out/i1.npz and 1 more: damaged, and refused when read; run the same reconstruct"
    with pytest.warns(UserWarning, match=words) as said:
        assert len(read_results(tmp_path / "out")) == 5
    assert said[0].filename == __file__  # the line of the caller


def test_a_dataset_with_a_status_of_a_later_version_is_refused_by_its_part(images, tmp_path):
    reconstruct(images, tmp_path / "out", PARQUET)
    part = tmp_path / "out" / "frames" / "part-00000.parquet"
    table = pq.read_table(part)
    column = table.column_names.index("status")
    pq.write_table(table.set_column(column, "status", pa.array([0, 42, 0, 0, 0], pa.int32())), part)
    with pytest.raises(MembraneError, match=r"part-00000.parquet: .*status is 42; expected one from 0 to"):
        read_results(tmp_path / "out").batch()
