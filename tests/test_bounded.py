"""Untrusted files are refused in one line before memory is taken."""

import ast
import io
import os
import struct
import subprocess
import sys
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from torchmembrane.errors import MembraneError
from torchmembrane.files import safe_read
from torchmembrane.files.safe_read import lies_within, read_array, read_arrays, read_bytes, read_text

NAMES = ("vertices", "fixed")


def npz(**arrays) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return out.getvalue()


def npy(header: str, content: bytes = b"", version: int = 1) -> bytes:
    size = struct.pack("<H" if version == 1 else "<I", len(header))
    return b"\x93NUMPY" + bytes([version, 0]) + size + header.encode() + content


def refusal(read, *arguments) -> str:
    """The message, which takes no time and no memory."""
    start = time.perf_counter()
    tracemalloc.start()
    with pytest.raises(MembraneError) as caught:
        read(*arguments)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    message = str(caught.value)
    assert message.isprintable() and str(arguments[0]) in message and "expected" in message and len(message) < 500
    assert time.perf_counter() - start < 1 and most < 2e7
    return message


def test_arrays_are_read_as_numpy_reads_them(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "vertices": np.asfortranarray(rng.random((4, 5, 3))),
        "fixed": rng.random((4, 5)) < 0.5,
        "halves": rng.random(3).astype(">f2"),
        "one": np.float32(2.5),
        "none": np.zeros((0, 3)),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        read = read_arrays(tmp_path / "a.npz", list(arrays))
        for name, array in arrays.items():
            assert read[name].dtype == array.dtype and np.array_equal(read[name], array)
    np.save(tmp_path / "b.npy", arrays["vertices"])
    assert np.array_equal(read_array(tmp_path / "b.npy"), arrays["vertices"])


HEADER = "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3), }\n"
DAMAGED = {
    "empty": b"",
    "no zip": b"vertices",
    "lacks one": npz(vertices=np.ones(3)),
    "objects": zipped({"vertices.npy": npy(HEADER.replace("<f8", "|O"), b"." * 48), "fixed.npy": b""}),
    "text": npz(vertices=np.array(["a"]), fixed=np.ones(3)),
    "records": npz(vertices=np.zeros(2, [("a", "f8")]), fixed=np.ones(3)),
    "too short": zipped({"vertices.npy": npy(HEADER, bytes(47)), "fixed.npy": b""}),
    "too long": zipped({"vertices.npy": npy(HEADER, bytes(49)), "fixed.npy": b""}),
    "huge shape": zipped({"vertices.npy": npy(HEADER.replace("2, 3", f"{2**62}, {2**62}")), "fixed.npy": b""}),
    "negative shape": zipped({"vertices.npy": npy(HEADER.replace("2, 3", "-2, -3"), bytes(48)), "fixed.npy": b""}),
    "no header": zipped({"vertices.npy": b"\x93NUMPY\x01\x00\xff\xff", "fixed.npy": b""}),
    "unclosed header": zipped({"vertices.npy": npy("{'descr': '<f8', (((" + "(" * 3000), "fixed.npy": b""}),
    "code in header": zipped({"vertices.npy": npy("__import__('os').abort()\n"), "fixed.npy": b""}),
    "long header": zipped({"vertices.npy": npy("[" * 2**20, version=2), "fixed.npy": b""}),
    "of version 9": zipped({"vertices.npy": npy(HEADER, bytes(48), version=9), "fixed.npy": b""}),
    "many members": zipped({f"{i}.npy": b"" for i in range(100)}),
    "another packing": zipped({"vertices.npy": npy(HEADER, bytes(48)), "fixed.npy": b""}, zipfile.ZIP_LZMA),
    "odd names": zipped({"a\nb\x1b[2J.npy": b""}),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_file_of_arrays_is_refused_in_one_line(tmp_path, kind):
    path = tmp_path / "a.npz"
    path.write_bytes(DAMAGED[kind])
    refusal(read_arrays, path, NAMES)


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    """48 MB of zeros in 48 kB where 1 MB is the bound, said by the directory or hidden from it."""
    monkeypatch.setattr(safe_read, "MOST_ARRAY_BYTES", 2**20)
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file, file.open("vertices.npy", "w", force_zip64=True) as member:
        header = "{'descr': '<f8', 'fortran_order': False, 'shape': (2000, 1000, 3), }"
        member.write(npy(header + " " * (117 - len(header)) + "\n"))
        for _ in range(48):
            member.write(bytes(10**6))
    assert path.stat().st_size < 6e4 and "its arrays take 48000128 bytes" in refusal(read_arrays, path, ["vertices"])
    with zipfile.ZipFile(path) as file:
        true = struct.pack("<I", file.getinfo("vertices.npy").file_size)
    content = path.read_bytes()
    path.write_bytes(content.replace(true, struct.pack("<I", 128)))
    with zipfile.ZipFile(path) as file:
        assert file.getinfo("vertices.npy").file_size == 128
    refusal(read_arrays, path, ["vertices"])


def test_every_byte_flip_of_a_file_of_arrays_is_noticed_or_harmless(tmp_path):
    whole = npz(vertices=np.arange(24.0).reshape(2, 4, 3), fixed=np.ones((2, 4), bool))
    path = tmp_path / "a.npz"
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x11]) + whole[at + 1 :])
        try:
            arrays = read_arrays(path, NAMES)
        except MembraneError as error:
            assert str(error).isprintable() and str(path) in str(error)
        else:
            assert np.array_equal(arrays["vertices"].ravel(), np.arange(24.0)) and arrays["fixed"].all()


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "missing", "loop", "large"])
def test_only_regular_files_of_bounded_size_are_opened(tmp_path, kind):
    path = tmp_path / "file"
    made = {
        "pipe": lambda: os.mkfifo(path),
        "device": lambda: path.symlink_to("/dev/zero"),
        "folder": path.mkdir,
        "missing": lambda: None,
        "loop": lambda: path.symlink_to(path),
        "large": lambda: os.truncate(os.open(path, os.O_CREAT | os.O_RDWR), 2**40),
    }
    made[kind]()
    words = {"pipe": "a pipe", "device": "a device", "folder": "a folder", "missing": "no such", "large": str(2**40)}
    assert words.get(kind, "not readable") in refusal(read_bytes, path, 2**20, "a test")


@pytest.mark.parametrize("content", [b"a\xff", b"a\0b", b"\xff\xfea\0"])
def test_what_is_no_text_is_refused(tmp_path, content):
    (tmp_path / "a").write_bytes(content)
    assert "UTF-8" in refusal(read_text, tmp_path / "a", 100, "text")


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path):
    (tmp_path / "a").write_bytes("\ufeffformat = 1\r\n".encode())
    assert read_text(tmp_path / "a", 100, "text") == "format = 1\r\n"


READERS = {"open", "read_text", "read_bytes", "read_table", "read_metadata", "ParquetFile", "fromfile"}
LOADERS = {"np", "json", "tomllib", "pickle", "trimesh"}
OTHERS_FILES = {
    "files/safe_read.py": "the one place",
    "files/decoder.py": "Image.open, of bytes or of a regular file of bounded size",
    "files/images.py": "open, of such a file, whose pages are read one by one",
    "files/parquet.py": "PyArrow reads itself, of what was looked at before",
    "results/frame_table.py": "JSON of a table's metadata, through io.parquet",
    "live/peaks.py": "JSON of a text that is read with a bound",
    "results/summary.py": "line by line, as long as it likes, of a regular file",
    "files/provenance.py": "hashed piece by piece, of a regular file",
    "sensor/table.py": "tomllib, of text",
    "plot/files.py": "Image.open, of a PNG's text alone",
    "cli/calibrate/files.py": "np.loadtxt, of text",
    "simulate/frames.py": "JSON, of text, and of a table's metadata",
    "accuracy/finished.py": "JSON, of text",
    "files/video.py": "PyAV reads videos itself",
    "files/video_end.py": "heads of boxes, some bytes each, of a regular file",
}
"""Modules that call a reader themselves, and why that is within bounds."""
OWN_FILES = {
    "processes.py": "what its parent process wrote",
    "jobs/workers.py": "the container's bound of memory",
    "presets/annotate.py": "what Sensor.to_file wrote just now",
    "plot/film.py": "written",
    "live/recording.py": "written",
    "integrations/rosbag.py": "written",
    "simulate/mesh_indenter.py": "load_mesh, of bytes",
    "machine_code.py": "this package's own source",
    "files/atomic.py": "written",
}


def test_untrusted_files_are_opened_in_one_place():
    """Every call of a reader in the package, but of `read_text`, `read_bytes` and `read_table` as functions of io."""
    package, found = Path(__file__).parents[1] / "torchmembrane", set()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                called, owner = node.func, getattr(getattr(node.func, "value", None), "id", "")
                name = getattr(called, "attr", "") or (called.id if getattr(called, "id", "") == "open" else "")
                if name in READERS or (name.startswith("load") and owner in LOADERS):
                    found.add(path.relative_to(package).as_posix())
    assert found <= OTHERS_FILES.keys() | OWN_FILES.keys(), found - OTHERS_FILES.keys() - OWN_FILES.keys()


@pytest.mark.parametrize("name", ["..", "a/../../b", "/a", "\\a", "c:\\a", "C:a", "\\\\host\\a", "a\0", "..\\a"])
def test_names_that_lead_out_of_the_folder_are_known(name):
    assert not lies_within(name) and lies_within("a/b.c") and lies_within("..a") and lies_within("a b")


def test_the_bounds_hold_where_memory_is_short(tmp_path):
    """The limit is the process's, set in a child that has no memory to spare."""
    path = tmp_path / "a.npz"
    np.savez(path, vertices=np.zeros((1000, 1000, 3)), fixed=np.ones(3, bool))
    code = f"""if True:
        import resource
        from pathlib import Path
        from torchmembrane.files.safe_read import read_arrays
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * 4096
        resource.setrlimit(resource.RLIMIT_AS, (taken + 2**23,) * 2)
        read_arrays(Path({str(path)!r}), {NAMES!r})
    """
    refused = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "not readable" in refused.stderr.splitlines()[-1]
