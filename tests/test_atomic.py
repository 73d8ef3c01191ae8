"""A file is written whole or not at all."""

import sys

import pytest

from torchmembrane.errors import MembraneError
from torchmembrane.files import optional
from torchmembrane.files.atomic import whole_file


def test_a_failing_block_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "results.csv"
    path.write_text("before")
    with pytest.raises(KeyboardInterrupt), whole_file(path) as partial:
        partial.write_text("half of what comes af")
        raise KeyboardInterrupt
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]


def test_the_new_file_appears_at_the_end_and_is_hidden_before(tmp_path):
    path = tmp_path / "results.csv"
    with whole_file(str(path)) as partial:
        partial.write_text("after")
        assert not path.exists() and partial.parent == tmp_path and partial.name.startswith(".")
    assert path.read_text() == "after" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "module, load, extra",
    [
        ("pyarrow", optional.load_pyarrow, "parquet"),
        ("av", optional.load_pyav, "video"),
        ("cv2", optional.load_opencv, "calibrate"),
        ("pandas", optional.load_pandas, "pandas"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(monkeypatch, module, load, extra):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MembraneError, match=rf"torchmembrane\[{extra}\]"):
        load()
