"""Compare the edge package on an emulated aarch64 system with this machine: every output of every image.

python export/arm/test.py FOLDER MODEL.onnx IMAGE...

FOLDER receives the system: Debian's Python 3.13 for arm64, its libraries, and the aarch64 wheels of numpy and onnxruntime in
the versions installed here; qemu's user mode runs it, as the Cortex-A76 of a Raspberry Pi 5.
"""

import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import numpy as np
from PIL import Image

RUN = Path(__file__).resolve().with_name("run.py")
EDGE = RUN.parents[1]
DEBIAN = EDGE / "debian.sh"
SYSTEMS = [f"manylinux_2_{minor}_aarch64" for minor in (28, 27, 17)]
LARGEST = 1e-3  # of an output's own largest value: float32 sums in another order, through a solve
SMALLEST = 1e-3  # largest value below which that bound is of this


def main(folder: Path, model: str, *images: str) -> None:
    root, qemu = folder / "root", folder / "qemu"
    if not (root / "site").is_dir():
        set_up(folder, root, qemu)
    np.save(folder / "images.npy", np.stack([np.asarray(Image.open(image).convert("L")) for image in images]))
    run = [str(RUN), str(EDGE), model, str(folder / "images.npy")]
    emulated = [
        str(qemu / "usr/bin/qemu-aarch64"),
        "-cpu",
        "cortex-a76",
        "-L",
        str(root),
        str(root / "usr/bin/python3.13"),
        "-IS",
    ]
    subprocess.run([*emulated, *run, str(folder / "arm.npz"), str(root / "site")], check=True)
    subprocess.run([sys.executable, *run, str(folder / "here.npz")], check=True)
    there, here = np.load(folder / "arm.npz"), np.load(folder / "here.npz")
    assert set(there) == set(here)
    np.testing.assert_array_equal(there["status"], here["status"])
    for name in here:
        np.testing.assert_array_equal(np.isnan(there[name]), np.isnan(here[name]), name)
        scale = max(float(np.nanmax(np.abs(here[name]), initial=0)), SMALLEST)
        error = np.nanmax(np.abs(there[name] - here[name]), initial=0) / scale
        print(f"{name}: {error:.0e} of {scale:.3g}")
        assert error < LARGEST, name


def set_up(folder: Path, root: Path, qemu: Path) -> None:
    debian = subprocess.run(["dpkg", "--print-architecture"], capture_output=True, text=True, check=True).stdout.strip()
    subprocess.run([DEBIAN, root, "arm64", "python3.13", "libstdc++6"], check=True)
    subprocess.run([DEBIAN, qemu, debian, "-n", "qemu-user"], check=True)
    wheels = [f"{name}=={version(name)}" for name in ("numpy", "onnxruntime")]
    plain = [f"--platform={system}" for system in SYSTEMS] + ["--python-version=3.13", "--only-binary=:all:", "--no-deps"]
    subprocess.run(
        [sys.executable, "-m", "pip", "download", "--quiet", *plain, "--dest", folder / "wheels", *wheels], check=True
    )
    for wheel in (folder / "wheels").glob("*.whl"):
        zipfile.ZipFile(wheel).extractall(root / "site")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), *sys.argv[2:])
