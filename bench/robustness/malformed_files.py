"""Damaged and malformed files as hypothesis generates them: sensor files, images, result folders, readings, videos.

A case is what stands in a folder: content by file name, or a word of `ODD` for what is no regular file.
"""

import io
import json
import os
import re
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from PIL import Image

EXAMPLES = Path(__file__).parents[2] / "examples"
SENSOR = ("sensor.toml", "rest_grid.npz", "dots.csv", "rest.png")
ODD: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "folder": os.mkdir,
    "endless": lambda path: os.symlink("/dev/zero", path),
    "loop": lambda path: os.symlink(path, path),
    "dangling": lambda path: os.symlink(path.with_name("nothing"), path),
}
VALUES = """
0 -1 1e-300 1e300 1e308 inf -inf nan 1e5 0.5 1e-12 true "" "x" [] [1] [[1]] {} 1979-05-27 10 200 17 2 1e-3 [33,9] [5,5]
[640.0,480.0] [1000000,1000000] [2000,2000] "grid" "../rest.png" "/etc/passwd" "*" "." "a\\u0000" "\\n"
""".split()
VALUES += ["9" * 400, "9" * 5000, "0x" + "f" * 4000, "[" * 3000, "[" * 90 + "]" * 90]
LINES = """
grid = [9, 9]
grid = [33, 5]
crop = [0, 0, 64, 64]
binning = 2
prestretch = 5.0
volume = 1.0
pressure = 1013
c2_ratio = 0.2
[camera.medium]
index = 1.33
[[camera.ports]]
distance = 1.0
thickness = 0.5
[tool]
a.b.c.d.e.f.g.h.i.j = 1
"\\n" = 1
x = 1
""".splitlines()
DRESSES: list[Callable[[str], bytes]] = [
    *(lambda text: text.replace(",", ";").encode(), lambda text: re.sub(r"([0-9])\.([0-9])", r"\1,\2", text).encode()),
    *(lambda text: text.replace("\n", "\r\n").encode("utf-8-sig"), lambda text: text.encode("utf-16")),
    *(lambda text: text.partition("\n")[2].encode(), lambda text: text.replace("\n", ",\n").encode()),
    *(lambda text: re.sub("[^,\n]+", r'"\g<0>"', text).encode(), lambda text: f"# by hand\n{text}\n\n".encode()),
    lambda text: "\n".join(",".join(reversed(line.split(","))) for line in text.splitlines()).encode(),
]
"""How else a table may be written: some of these mean the same, some are refused."""
CELLS = ["small", "large", "1_0", "٣", "1e-5", '"', "", *VALUES]
Case = dict[str, bytes | str]


def put(case: Case, folder: Path) -> None:
    """Make a case's files."""
    for name, content in case.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, str):
            ODD[content](path)
        else:
            path.write_bytes(content)


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """Bytes flipped anywhere or in head or tail, cut off, overwritten, left out, doubled, or with more behind them."""
    way = draw(st.sampled_from(["flip", "head", "tail", "cut", "zeros", "noise", "hole", "twice", "more"]))
    first, last = {"head": (0, 128), "tail": (-256, None)}.get(way, (0, None))
    places = range(len(data))[first:last]
    at, length = draw(st.sampled_from(places)), 1 + draw(st.sampled_from(range(len(data)))) // 20
    noise = np.random.default_rng(draw(st.integers(0, 2**32 - 1))).bytes(length)
    if way in ("flip", "head", "tail"):
        changed = bytearray(data)
        for place, bit in draw(st.lists(st.tuples(st.sampled_from(places), st.integers(0, 7)), min_size=1, max_size=11)):
            changed[place] ^= 1 << bit
        return bytes(changed)
    between = {"cut": b"", "zeros": bytes(length), "noise": noise, "hole": b"", "twice": data[at : at + length] * 2}
    behind = b"" if way == "cut" else data[at + length :]
    return data + noise if way == "more" else data[:at] + between[way] + behind


def toml_values() -> st.SearchStrategy[str]:
    """Values as TOML writes them: extreme ones, wrong types, any number, text and nesting."""
    numbers = st.one_of(st.integers().map(str), st.floats().map(repr))
    words = st.text(max_size=8).map(lambda text: json.dumps(text, ensure_ascii=False))
    nested = st.recursive(numbers | words, lambda inner: st.lists(inner, max_size=4).map(lambda row: f"[{', '.join(row)}]"))
    return st.one_of(st.sampled_from(VALUES), nested)


@st.composite
def sensor_text(draw: st.DrawFn, text: str) -> bytes:
    """A sensor file with values replaced or scaled, keys missing, doubled, moved or unknown; some damaged as bytes as well."""
    lines = text.splitlines()
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        i = draw(st.sampled_from([i for i, line in enumerate(lines) if line.strip()]))
        key, equals, value = lines[i].partition(" = ")
        numbers = [] if '"' in value else re.findall(r"\d+\.?\d*", value)
        way = draw(st.sampled_from(["scaled", "scaled", "far", "value", "missing", "doubled", "moved", "unknown"]))
        if way in ("scaled", "far") and numbers:
            number, size = draw(st.sampled_from(numbers)), 0.3 if way == "scaled" else 9.0
            other = float(number) * 10.0 ** draw(st.floats(-size, size))
            lines[i] = f"{key} = {value.replace(number, str(round(other) if number.isdigit() else other), 1)}"
        elif way == "value" and equals:
            lines[i] = f"{key} = {draw(toml_values())}"
        elif way in ("missing", "moved"):
            line = lines.pop(i)
            if way == "moved":
                lines.insert(draw(st.integers(0, len(lines))), line)
        else:
            lines.insert(draw(st.integers(0, len(lines))), lines[i] if way == "doubled" else draw(st.sampled_from(LINES)))
    changed = "\n".join(lines).encode("utf-8", "replace")
    return draw(damaged(changed)) if draw(st.integers(0, 19)) == 19 else changed


@st.composite
def arrays(draw: st.DrawFn, data: bytes) -> bytes:
    """An .npz damaged, or whole with arrays of other types, shapes and values, with one missing, or a bomb."""
    way = draw(st.sampled_from(["damaged", "damaged", "changed", "changed", "bomb"]))
    if way == "damaged":
        return draw(damaged(data))
    if way == "bomb":
        return bomb()
    out = io.BytesIO()
    with np.load(io.BytesIO(data)) as file:
        held = dict(file)
    for name in draw(st.lists(st.sampled_from(sorted(held)), min_size=1, max_size=2, unique=True)):
        held[name] = draw(changed(held[name]))
    if draw(st.integers(0, 9)) == 9:
        del held[draw(st.sampled_from(sorted(held)))]
    np.savez_compressed(out, **held)
    return out.getvalue()


@cache
def bomb() -> bytes:
    """An .npz of 100 kB that unpacks to 100 MB of zeros."""
    out = io.BytesIO()
    with (
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file,
        file.open("vertices.npy", "w", force_zip64=True) as member,
    ):
        np.lib.format.write_array_header_1_0(member, dict(descr="<f8", fortran_order=False, shape=(8000, 8000, 3)))
        for _ in range(100):
            member.write(bytes(2**20))
    return out.getvalue()


@st.composite
def changed(draw: st.DrawFn, A: np.ndarray) -> np.ndarray:
    """An array of another type or shape, or with other values."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    bad = draw(st.sampled_from([np.nan, np.inf, 1e300, 0.0, -1.0]))
    others: list[Callable[[], np.ndarray]] = [
        *(lambda kind=kind: A.astype(kind) for kind in ("f2", ">f8", "i2", "c16", "U4", "O", "bool")),
        *(lambda: np.float64(bad), lambda: A[:0], lambda: A[..., None], lambda: A.ravel(), lambda: A[:5], lambda: A.T),
        *(lambda: np.zeros((600, 600, 3)), lambda: A[::-1], lambda: np.concatenate([A, A])),
    ]
    if A.dtype.kind == "f" and A.size:
        noise, scale = rng.normal(size=A.shape), 10.0 ** draw(st.floats(-9, 9))
        others += [lambda: A + scale * noise, lambda: A * scale, lambda: np.where(rng.random(A.shape) < 0.01, bad, A)] * 4
    if A.dtype.kind in "bi":
        others += [lambda: ~A, lambda: np.ones_like(A), lambda: A * 10**6, lambda: A | (rng.random(A.shape) < 0.3)]
    if A.dtype.kind == "U":
        others += [lambda: np.array(draw(st.text(max_size=2000))), lambda: np.array(["npz"])]
    try:
        return others[draw(st.integers(0, len(others) - 1))]()
    except (ValueError, TypeError, IndexError, OverflowError):
        return A[()]


@st.composite
def table(draw: st.DrawFn, text: str) -> bytes:
    """A CSV file with lines removed, doubled or moved, cells replaced, ten thousand lines alike; or damaged as bytes. One in
    three is written otherwise, with semicolons, decimal commas, quotes and the like."""
    header, *lines = text.splitlines()
    i, j = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
    cells = lines[i].split(",")
    cells[draw(st.integers(0, len(cells) - 1))] = draw(st.sampled_from(CELLS))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    ways: list[Callable[[], list[str]]] = [
        *(lambda: [*lines, lines[i]], lambda: lines[: 1 + i % 11], lambda: [*lines[:i], *lines[i + 1 :]], lambda: []),
        *(lambda: [line for line in lines if rng.random() < 0.8], lambda: lines[:: 2 + i % 7], lambda: [lines[0]] * 10000),
        *(lambda: [*lines[:i], ",".join(cells), *lines[i + 1 :]],) * 3,
        *(lambda: [*lines[:j], "\ufeff" + lines[j], *lines[j + 1 :]], lambda: rng.permutation(lines).tolist()),
        *(lambda: [line.replace("small", "large") for line in lines], lambda: [line + ",0" for line in lines]),
        *(lambda: [re.sub(r"\d\.\d+", lambda number: f"{float(number[0]) + rng.normal():.4f}", line) for line in lines],),
    ]
    way = draw(st.integers(0, len(ways)))
    if way == len(ways):
        return draw(damaged(text.encode()))
    dress = draw(st.sampled_from([*[str.encode] * 2 * len(DRESSES), *DRESSES]))
    return dress("\n".join([header, *ways[way]()]))


@st.composite
def with_odd(draw: st.DrawFn, case: Case) -> Case:
    """One in fifty with a file that is no regular one."""
    if draw(st.integers(0, 49)) == 49:
        case[draw(st.sampled_from(sorted(case)))] = draw(st.sampled_from(sorted(ODD)))
    return case


@st.composite
def sensors(draw: st.DrawFn, files: dict[str, bytes]) -> Case:
    """A sensor's `files`, of the names `SENSOR`, with one or two changed."""
    case: Case = dict(files)
    mutations = {"sensor.toml": lambda data: sensor_text(data.decode()), "rest_grid.npz": arrays, "rest.png": damaged}
    mutations["dots.csv"] = lambda data: table(data.decode())
    often = ["sensor.toml"] * 10 + ["dots.csv"] * 5 + ["rest_grid.npz"] * 4 + ["rest.png"]
    for name in draw(st.lists(st.sampled_from(often), min_size=1, max_size=2, unique=True)):
        case[name] = draw(mutations[name](files[name]))
    return draw(with_odd(case))


@st.composite
def images(draw: st.DrawFn, files: dict[str, bytes]) -> Case:
    """A damaged image; one in ten is called as another format."""
    name = draw(st.sampled_from(sorted(files)))
    content = draw(damaged(files[name]))
    return {draw(st.sampled_from([name] * 18 + ["a.png", "a.jpg"])): content}


@st.composite
def folders(draw: st.DrawFn, files: dict[str, bytes]) -> Case:
    """A folder of results with one or two files changed."""
    case: Case = dict(files)
    for name in draw(st.lists(st.sampled_from(sorted(files)), min_size=1, max_size=2, unique=True)):
        how = {".npz": arrays, ".csv": lambda data: table(data.decode())}.get(Path(name).suffix, damaged)
        case[name] = draw(how(files[name]))
    return draw(with_odd(case))


def singles(name: str, strategy: st.SearchStrategy[bytes]) -> st.SearchStrategy[Case]:
    """A folder with one file."""
    return strategy.map(lambda content: {name: content}).flatmap(with_odd)


def files_of(image: np.ndarray) -> dict[str, bytes]:
    """A grey image in every format that is read."""
    grey, colour = Image.fromarray(image), Image.fromarray(image).convert("RGB")
    options = {
        "grey.png": (grey, {}),
        "colour.png": (colour, {}),
        "grey.jpg": (grey, dict(quality=92)),
        "colour.jpg": (colour, dict(quality=90, progressive=True)),
        "raw.tiff": (grey, {}),
        "packed.tiff": (grey, dict(compression="tiff_lzw")),
        "deflated.tiff": (colour, dict(compression="tiff_adobe_deflate")),
        "lossy.webp": (colour, dict(quality=92)),
        "exact.webp": (grey.convert("RGB"), dict(lossless=True)),
    }
    written = {}
    for name, (picture, how) in options.items():
        out = io.BytesIO()
        picture.save(out, {"jpg": "JPEG", "png": "PNG", "tiff": "TIFF", "webp": "WEBP"}[name.partition(".")[2]], **how)
        written[name] = out.getvalue()
    return written
