"""Damaged and hostile files: each must be refused in one line that names it and says what was expected, or be answered.

python bench/fuzz.py [--sensors 1000] [--images 700] [--hours H] [--seed 0] [--json FILE]

Sensors: the example's sensor.toml, rest_grid.npz and dots.csv, mutated; what is accepted is built and reconstructs a frame.
Images: a press as PNG, JPEG, TIFF and WebP, mutated; what is accepted is reconstructed and compared with the whole file's
surface. Bounds on every one: `SLOWEST` seconds of the processor, `LARGEST` bytes above what the process holds before; an alarm
and RLIMIT_AS hold it as well. Printed: counts, and each that broke a rule with its number, which `--only` runs again. With
--hours the numbers go on until then. Exit code 1 if one broke a rule.
"""

import argparse
import io
import os
import re
import resource
import shutil
import signal
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from record import write

import torchmembrane as tm

EXAMPLES = Path(__file__).parents[1] / "examples"
SLOWEST, LARGEST = 5.0, 2**30
HANGS = 120
"""Seconds after which a case is ended."""
MOST_LINES, MOST_DOTS = 33, 300
"""Larger sensors, where accepted, are not held to the bounds: they are read, not built."""
SILENT = "answered, OK, WRONG"
WRONG = 0.25
"""Of the press: error of a surface that is wrong."""
NUMBERS = (
    """0 -1 1e-300 1e300 1e308 inf -inf nan 1e5 0.5 1e-12 true "" "x" [] [1] [[1]] {} 1979-05-27 10 200 17 2 1e-3""".split()
)
NUMBERS += ["9" * 400, "9" * 5000, "0x" + "f" * 4000, "[" * 3000, "[" * 90 + "]" * 90, "[1000000, 1000000]", "[2000, 2000]"]
NUMBERS += [
    "[33, 9]",
    "[5, 5]",
    "[640.0, 480.0]",
    '"grid"',
    '"../rest.png"',
    '"/etc/passwd"',
    '"*"',
    '"."',
    '"a\\u0000"',
    '"\\n"',
]
KEYS = """
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
""".split("\n")


class Outcome(NamedTuple):
    """What came of a case."""

    kind: str
    message: str
    seconds: float
    bytes: int


class Hang(BaseException):
    """A case took too long."""


def flipped(data: bytes, rng: np.random.Generator, most: int = 12) -> bytes:
    """Bytes with some bits turned over."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, most)):
        changed[rng.integers(len(changed))] ^= 1 << rng.integers(8)
    return bytes(changed)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes flipped, overwritten, left out, doubled, cut off, or changed in the header."""
    at, length = (int(rng.integers(len(data))) for _ in range(2))
    length = 1 + length // 20
    ways: list[Callable[[], bytes]] = [
        lambda: flipped(data, rng),
        lambda: flipped(data[:128], rng) + data[128:],
        lambda: data[:-256] + flipped(data[-256:], rng),
        lambda: data[:at],
        lambda: data[:at] + bytes(length) + data[at + length :],
        lambda: data[:at] + rng.bytes(length) + data[at + length :],
        lambda: data[:at] + data[at + length :],
        lambda: data[:at] + data[at : at + length] * 2 + data[at + length :],
        lambda: data + rng.bytes(length),
    ]
    return ways[rng.integers(len(ways))]()


def mutated_text(text: str, rng: np.random.Generator) -> bytes:
    """A sensor file with values replaced, keys removed, doubled or added, lines exchanged, or damaged as bytes."""
    lines = text.splitlines()
    for _ in range(rng.choice([1, 2, 3], p=[0.7, 0.2, 0.1])):
        i = int(rng.integers(len(lines)))
        key, equals, value = lines[i].partition(" = ")
        way = rng.integers(10)
        if way < 2 and equals:
            lines[i] = f"{key} = {rng.choice(NUMBERS)}"
        elif way in (2, 3, 4, 7) and '"' not in value and (numbers := re.findall(r"[-\d.]+", value)):
            number = str(rng.choice(numbers))
            scale = 10.0 ** rng.uniform(-9, 9) if way == 2 else 10.0 ** rng.normal(scale=0.1)
            other = float(number or 1) * scale if number.strip("-.").replace(".", "", 1).isdigit() else scale
            lines[i] = f"{key} = {value.replace(number, str(round(other) if number.isdigit() else other), 1)}"
        elif way == 5:
            del lines[i]
        elif way == 6:
            lines.insert(int(rng.integers(len(lines))), lines[i])
        elif way == 8:
            lines.insert(i, str(rng.choice(KEYS)))
        elif way == 9 and rng.integers(2):
            return damaged("\n".join(lines).encode(), rng)
    return "\n".join(lines).encode("utf-8", "replace")


def mutated_arrays(data: bytes, rng: np.random.Generator) -> bytes:
    """An .npz damaged, or whole with other arrays, or a bomb."""
    if rng.integers(2):
        return damaged(data, rng)
    with np.load(io.BytesIO(data)) as file:
        X, fixed = file["vertices"], file["fixed"]
    noise = rng.normal(size=X.shape) * 10.0 ** rng.uniform(-6, 1)
    others = [
        X,
        X + noise,
        X + noise / 100,
        X * rng.uniform(0.8, 1.2),
        X + rng.normal(size=3),
        X * 10.0 ** rng.uniform(-9, 9),
        X[::-1],
        X.astype(np.float16),
        X[:3, :3],
        X[..., :2],
        X[::4, ::4],
    ]
    others += [np.where(rng.random(X.shape) < 0.01, bad, X) for bad in (np.nan, np.inf, 1e300, 0.0)]
    others += [
        X.astype(object),
        X.astype("U4"),
        X.astype(complex),
        np.zeros((600, 600, 3)),
        X[:0],
        np.float64(1),
        X.swapaxes(0, 1),
    ]
    fixes = [fixed, ~fixed, fixed[:5], np.ones_like(fixed), fixed | (rng.random(fixed.shape) < 0.3), fixed.astype(float)]
    out = io.BytesIO()
    if not rng.integers(8):
        with (
            zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file,
            file.open("vertices.npy", "w", force_zip64=True) as member,
        ):
            np.lib.format.write_array_header_1_0(member, dict(descr="<f8", fortran_order=False, shape=(8000, 8000, 3)))
            for _ in range(100):
                member.write(bytes(2**20))
    else:
        chosen, kept = others[rng.integers(len(others))], fixes[rng.integers(len(fixes)) if rng.integers(2) else 0]
        if rng.integers(2) and chosen.ndim > 1:
            kept = np.ones(chosen.shape[:2], bool)
            kept[1:-1, 1:-1] = False
        np.savez_compressed(out, vertices=chosen, fixed=kept)
    return out.getvalue()


def mutated_dots(text: str, rng: np.random.Generator) -> bytes:
    """A list of dots with lines removed, doubled or moved, cells replaced, or damaged as bytes."""
    header, *lines = text.splitlines()
    i, j = rng.integers(len(lines), size=2)
    cells = lines[i].split(",")
    cells[rng.integers(4)] = str(rng.choice([*NUMBERS, "small", "large", "1_0", "٣", "1e-5", '"']))
    ways: list[Callable[[], list[str]]] = [
        lambda: [*lines, lines[i]],
        lambda: lines[: rng.integers(1, 12)],
        lambda: [line for line in lines if rng.random() < 0.8],
        lambda: [line.replace("small", str(rng.choice(["small", "large"]))) for line in lines],
        lambda: [*lines[:i], *lines[i + 1 :]],
        lambda: [*lines[:i], ",".join(cells), *lines[i + 1 :]],
        lambda: [line.replace("small", "large") for line in lines],
        lambda: [lines[0]] * 10000,
        lambda: lines[:: rng.integers(2, 9)],
        lambda: [line for line in lines if line.startswith("-")],
        lambda: [*lines[:j], "\ufeff" + lines[j], *lines[j + 1 :]],
        lambda: rng.permutation(lines).tolist(),
        lambda: [
            ",".join([*(f"{float(v) + rng.normal() * 10.0 ** rng.uniform(-3, 0):.4f}" for v in line.split(",")[:3]), "small"])
            for line in lines
        ],
    ]
    if not rng.integers(6):
        return damaged(text.encode(), rng)
    return "\n".join([header, *ways[rng.integers(len(ways))]()]).encode()


def sensor_case(folder: Path, rng: np.random.Generator) -> Path:
    """The example's sensor with one or two files mutated."""
    for name in ("sensor.toml", "rest_grid.npz", "dots.csv", "rest.png"):
        shutil.copyfile(EXAMPLES / name, folder / name)
    for which in rng.choice(4, rng.choice([1, 2], p=[0.8, 0.2]), replace=False, p=[0.5, 0.2, 0.25, 0.05]):
        path = folder / ("sensor.toml", "rest_grid.npz", "dots.csv", "rest.png")[which]
        if which == 1:
            path.write_bytes(mutated_arrays(path.read_bytes(), rng))
        elif which == 3:
            path.write_bytes(damaged(path.read_bytes(), rng))
        else:
            path.write_bytes((mutated_text, mutated_dots)[which // 2](path.read_text(), rng))
    if not rng.integers(50):
        odd = folder / str(rng.choice(["sensor.toml", "dots.csv", "rest_grid.npz", "rest.png"]))
        odd.unlink()
        (os.mkfifo, os.mkdir, lambda path: os.symlink("/dev/zero", path))[rng.integers(3)](odd)
    return folder / "sensor.toml"


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


def peak() -> int:
    """Most memory held since the last `clear`, bytes."""
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) * 1024


def measured(case: Callable[[], str], folder: Path) -> Outcome:
    """What comes of a case: a kind, or how it broke the rules."""
    Path("/proc/self/clear_refs").write_text("5")
    before, start, message = peak(), time.process_time(), ""
    signal.alarm(HANGS)
    try:
        kind = case()
    except tm.MembraneError as error:
        kind, message = "refused", str(error)
        bare = message.replace(str(folder), "")
        told = str(folder) in message and re.search("expected|add it|correct that line|remove it", message)
        if "\n" in message or len(bare) > 700 or "MemoryError" in message or not bare.isprintable() or not told:
            kind = "BAD MESSAGE"
    except Hang:
        kind = "HANGS"
    except Exception:
        kind, message = "EXCEPTION", "".join(traceback.format_exc().splitlines(True)[-6:])
    finally:
        signal.alarm(0)
    seconds, held = time.process_time() - start, peak() - before
    if kind[0].islower() and "larger" not in kind:
        kind = f"SLOW: {kind}" if seconds > SLOWEST else f"LARGE: {kind}" if held > LARGEST else kind
    return Outcome(kind, message, seconds, held)


def use(path: Path, image: np.ndarray) -> str:
    """Read a sensor, and where it is accepted reconstruct a frame with it."""
    sensor = tm.Sensor.from_file(path)
    dots = 0 if sensor.markers.positions is None else len(sensor.markers.positions)
    if max(sensor.membrane.grid) > MOST_LINES or dots > MOST_DOTS:
        return "accepted, larger"
    reconstructor = tm.Reconstructor.from_file(path)
    if sensor.camera.image_size != image.shape[::-1]:
        return "accepted, another size"
    status = tm.Status(int(reconstructor(image).status[0]))
    return f"answered, {status.name}"


class Judge:
    """Whether a surface from a damaged image is right."""

    def __init__(self, reconstructor: tm.Reconstructor, files: dict[str, bytes], folder: Path):
        self.reconstructor, self.whole = reconstructor, {}
        for name, data in files.items():
            (folder / name).write_bytes(data)
            self.whole[name] = reconstructor(reconstructor.read(folder / name))

    def __call__(self, path: Path, name: str) -> str:
        result, whole = self.reconstructor(self.reconstructor.read(path)), self.whole[name]
        status = tm.Status(int(result.status[0]))
        error = float((result.vertices - whole.vertices).norm() / whole.displacement.norm())
        return f"answered, {status.name}, " + ("no surface" if error != error else "WRONG" if error > WRONG else "right")


def cases(count: int, seed: int, hours: float, only: int | None) -> Iterator[int]:
    """Numbers of cases, each the seed of one."""
    end, number = time.monotonic() + 3600 * hours, seed
    while number < seed + count or time.monotonic() < end:
        if only is None or number == only:
            yield number
        number += 1


def fuzz(sensors: int, images: int, seed: int = 0, hours: float = 0.0, only: int | None = None) -> dict:
    """Run cases; returns the counts, what broke a rule, the slowest and the largest."""
    signal.signal(signal.SIGALRM, _hang)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    image = np.asarray(Image.open(EXAMPLES / "press_on_axis.png").convert("L"))
    found: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as name, torch.no_grad():
        folder, files = Path(name), files_of(image)
        judge = Judge(tm.Reconstructor.from_file(EXAMPLES / "sensor.toml"), files, folder)
        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + 2 * LARGEST, resource.RLIM_INFINITY))

        def of_sensor(rng: np.random.Generator, place: Path) -> Callable[[], str]:
            path = sensor_case(place, rng)
            return lambda: use(path, image)

        def of_image(rng: np.random.Generator, place: Path) -> Callable[[], str]:
            which = str(rng.choice(list(files)))
            path = place / str(rng.choice([which, "a.png", "a.jpg"], p=[0.9, 0.05, 0.05]))
            path.write_bytes(damaged(files[which], rng))
            return lambda: judge(path, which)

        for what, count, make in (("sensors", sensors, of_sensor), ("images", images, of_image)):
            found[what] = _run(make, cases(count, seed, hours / 2 if count else 0, only), folder)
    return found


def _run(make: Callable, numbers: Iterator[int], folder: Path) -> dict:
    kinds: Counter[str] = Counter()
    broken, silent, slowest, largest = [], [], (0.0, -1), (0, -1)
    for number in numbers:
        place = folder / "case"
        place.mkdir()
        outcome = measured(make(np.random.default_rng(number), place), place)
        shutil.rmtree(place)
        kinds[outcome.kind] += 1
        slowest = max(slowest, (round(outcome.seconds, 2), number))
        largest = max(largest, (outcome.bytes, number))
        if outcome.kind == SILENT:
            silent.append((number, outcome.message))
        if outcome.kind[0].isupper():
            broken.append(dict(number=number, **outcome._asdict()))
            print(
                f"case {number}: {outcome.kind}, {outcome.seconds:.1f} s, {outcome.bytes >> 20} MB: {outcome.message}",
                flush=True,
            )
    bounds = dict(slowest=slowest, largest_MB=(largest[0] >> 20, largest[1]))
    return dict(kinds=dict(sorted(kinds.items())), broken=broken, silent=silent, **bounds)


def _hang(*_: object) -> None:
    raise Hang


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=1000)
    parser.add_argument("--images", type=int, default=700)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hours", type=float, default=0.0)
    parser.add_argument("--only", type=int, help="the number of one case")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found = fuzz(arguments.sensors, arguments.images, arguments.seed, arguments.hours, arguments.only)
    for what, of_this in found.items():
        print(what, *(f"  {kind}: {count}" for kind, count in of_this["kinds"].items()), sep="\n")
        print(f"  wrong and not said to be: {[number for number, _ in of_this['silent']]}")
        print(f"  slowest {of_this['slowest'][0]} s (case {of_this['slowest'][1]}), largest {of_this['largest_MB'][0]} MB")
    write(arguments.json, found)
    return 1 if any(of_this["broken"] for of_this in found.values()) else 0


if __name__ == "__main__":
    raise SystemExit(main())
