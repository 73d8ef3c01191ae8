"""What `fuzz.py` does with a case of each kind, and what an answer is worth: right, or wrong."""

import contextlib
import io
import multiprocessing
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import torchmembrane as tm
from bench.robustness.malformed_files import (
    EXAMPLES,
    SENSOR,
    Case,
    damaged,
    files_of,
    folders,
    images,
    put,
    sensors,
    singles,
    table,
)
from torchmembrane.cli.calibrate.files import read_forces, read_motions
from torchmembrane.files.folder_lock import WHOLE
from torchmembrane.forming.formed import film
from torchmembrane.forming.outline import rectangle
from torchmembrane.jobs.decode import decoded, sources
from torchmembrane.jobs.inputs import find_inputs
from torchmembrane.jobs.local import reconstruct_files
from torchmembrane.jobs.pressure import read_pressures
from torchmembrane.jobs.result_folder import ResultFolder
from torchmembrane.plot.film import write_film
from torchmembrane.presets.dot_list import read_drafted_dots
from torchmembrane.results.read import read_frame
from torchmembrane.results.reconstruction import Reconstruction
from torchmembrane.results.store import Mesh, Settings
from torchmembrane.sensor.inflated import read_rim, rim_lines

MOST_LINES, MOST_DOTS = 33, 300
"""Larger sensors, where accepted, are not held to the bounds: they are read, not built."""
WRONG = 0.25
"""Of the press: error of a surface that is wrong."""
MOTIONS = "\n".join(["x,y,z,turn_x,turn_y,turn_z", "0,0,0,0,0,0", "1.5,0,0,0,-4.0,0", "0,1.5,0,4.0,0,0"])
RIM = rim_lines(np.insert(rectangle((50.0, 36.0), 10.0)[::12], 2, 40.0, axis=1))
RIM_LINES = 9  # of the grid in a rim
PATIENCE = 60
"""Seconds after which a model that runs in a process of its own is ended."""


class Kind(NamedTuple):
    """How cases are made, and what is done with the folder of one."""

    cases: st.SearchStrategy[Case]
    use: Callable[[Path], str]


class Uses:
    """What is done with a case's folder, by kind.

    Args:
        work: a folder for what stays whole.
        lines: number of lines of the example's grid, that of its file if none are given.
    """

    def __init__(self, work: Path, lines: int | None):
        self.example = {name: (EXAMPLES / name).read_bytes() for name in SENSOR}
        if lines is not None:
            grid = f"[membrane]\ngrid = [{lines}, {lines}]".encode()
            self.example["sensor.toml"] = self.example["sensor.toml"].replace(b"[membrane]", grid)
        put(dict(self.example), work / "example")
        self.image = np.asarray(Image.open(EXAMPLES / "press_on_axis.png").convert("L"))
        self.reconstructor = tm.Reconstructor.from_file(work / "example" / "sensor.toml")
        self.reconstructor.double()(self.image)  # compiles machine code for both precisions before anything is timed
        self.reconstructor.float()(self.image)
        self.dome = tm.preset("fingertip")
        self.presses = find_inputs([EXAMPLES / f"{name}.png" for name in ("press_on_axis", "two_contacts", "flat_plate")])
        self.forms, self.whole = files_of(self.image), {}
        for name, data in self.forms.items():
            (work / name).write_bytes(data)
            self.whole[name] = self.reconstructor(self.reconstructor.read(work / name))
        self.by_size = {Path(name).suffix: name for name in sorted(self.forms)}
        for settings in map(self.settings, ("npz", "parquet")):
            reconstruct_files(self.reconstructor, self.presses, work / settings.format, settings, workers=1)
        write_film(work / "film.mp4", [np.stack([self.image] * 3, -1)] * 5, 25.0)
        write_bag(work / "run", self.forms["grey.png"], 3)
        self.work = work

    def kind(self, name: str) -> Kind:
        """The kind of this name."""
        stored = _files(self.work / name) if name in ("npz", "parquet") else {}
        names = [image.stem for image in self.presses.images]
        readings = "\n".join(["name,pressure", *(f"{name},{10.5 + k}" for k, name in enumerate(names))])
        forces = "\n".join(["image,fx,fy,fz", *(f"{name}.png,0.1,{k},-2.5" for k, name in enumerate(names))])
        kinds: dict[str, Callable[[], Kind]] = {
            "sensors": lambda: Kind(sensors(self.example), self.sensor),
            "images": lambda: Kind(images(self.forms), self.picture),
            "npz": lambda: Kind(folders(stored), lambda folder: self.results(folder, "npz")),
            "parquet": lambda: Kind(folders(stored), lambda folder: self.results(folder, "parquet")),
            "readings": lambda: Kind(singles("p.csv", table(readings)), self.readings),
            "dots": lambda: Kind(singles("d.csv", table((EXAMPLES / "dots.csv").read_text())), self.dots),
            "motions": lambda: Kind(
                singles("m.csv", table(MOTIONS)), lambda folder: self.tabled(read_motions, folder / "m.csv")
            ),
            "rims": lambda: Kind(singles("r.csv", table(RIM)), self.rim),
            "forces": lambda: Kind(
                singles("f.csv", table(forces)), lambda folder: self.tabled(read_forces, folder / "f.csv", self.presses)
            ),
            "videos": lambda: Kind(singles("v.mp4", damaged((self.work / "film.mp4").read_bytes())), self.video),
            "bags": lambda: Kind(folders(_files(self.work / "run")), self.bag),
            "models": lambda: Kind(singles("m.onnx", damaged(self.exported())), self.model),
        }
        return kinds[name]()

    def settings(self, form: str) -> Settings:
        return Settings.from_reconstructor(self.reconstructor, form)

    def sensor(self, folder: Path) -> str:
        """Read a sensor, and where it is accepted reconstruct a frame with it."""
        path = folder / "sensor.toml"
        sensor = tm.Sensor.from_file(path)
        dots = 0 if sensor.markers.positions is None else len(sensor.markers.positions)
        if max(sensor.membrane.grid) > MOST_LINES or dots > MOST_DOTS:
            return "accepted, larger"
        reconstructor = tm.Reconstructor.from_file(path)
        if sensor.camera.image_size != self.image.shape[::-1]:
            return "accepted, another size"
        status = tm.Status(int(reconstructor(self.image).status[0]))
        return f"answered, {status.name}"

    def picture(self, folder: Path) -> str:
        """Whether the surface from a damaged image is right."""
        (path,) = folder.iterdir()
        name = path.name if path.name in self.whole else self.by_size[path.suffix]
        return self.judged(self.reconstructor(self.reconstructor.read(path)), self.whole[name])

    def judged(self, result: Reconstruction, whole: Reconstruction) -> str:
        """What the result of a frame `[1, ...]` is worth beside that of the undamaged one."""
        status = tm.Status(int(result.status[0]))
        error = float((result.vertices - whole.vertices).norm() / whole.displacement.norm())
        if error > WRONG and status == tm.Status.OK:
            return "WRONG WITH STATUS OK"
        return f"answered, {status.name}, {'no surface' if error != error else 'wrong' if error > WRONG else 'right'}"

    def results(self, folder: Path, form: str) -> str:
        """Read results in every way, then open them to go on with."""
        refused = []

        def tried(use: Callable[[], object]) -> None:
            try:
                use()
            except tm.MembraneError as error:
                refused.append(error)

        def read() -> None:
            results = tm.read_results(folder)
            for _ in results:
                pass
            results.batch(), results.to_pandas(), results[results.names[0]]

        def go_on() -> None:
            mesh = Mesh.from_reconstructor(self.reconstructor, self.settings(form))
            with ResultFolder(folder, mesh, self.presses, WHOLE, False, lambda line: None):
                pass

        paths = [folder, *folder.glob("[!m]*.npz"), *folder.glob("frames/*.parquet")]
        for use in (read, *(lambda path=path: read_frame(path) for path in paths), go_on):
            tried(use)
        if refused:
            raise refused[0]
        return "read"

    def readings(self, folder: Path) -> str:
        read_pressures(folder / "p.csv", self.presses, self.reconstructor.sensor)
        return "read"

    def dots(self, folder: Path) -> str:
        read_drafted_dots(folder / "d.csv", self.dome.surface, self.dome.camera)
        return "read"

    def rim(self, folder: Path) -> str:
        """Read a rim, and where it is accepted find the film in it."""
        rim = read_rim(folder / "r.csv")
        try:
            film(rim if rim.shape[1] == 3 else np.insert(rim, 2, 0.0, axis=1), RIM_LINES)
        except tm.MembraneError:  # the sensor's file is named where it is read
            return "read, no sheet in it"
        return "read"

    def tabled(self, read: Callable[..., object], *arguments: object) -> str:
        read(*arguments)
        return "read"

    def video(self, folder: Path) -> str:
        """Decode as much as there is: what cannot be is a frame with a reason."""
        frames = [
            decoded(source, self.reconstructor) for source in sources(find_inputs([folder / "v.mp4"]), self.reconstructor)
        ]
        return f"decoded{', in part' if any(frame.reason for frame in frames) else ''}"

    def bag(self, folder: Path) -> str:
        """Reconstruct the pictures of a bag."""
        worst = "no frames"
        for source in sources(find_inputs([folder]), self.reconstructor):
            frame = decoded(source, self.reconstructor)
            if frame.image is None:
                worst = "a frame refused"
                continue
            said = self.judged(self.reconstructor(frame.image), self.whole["grey.png"])
            if said[0].isupper():
                return said
            worst = said if worst == "no frames" else worst
        return worst

    def exported(self) -> bytes:
        """A model of a small grid."""
        text = (EXAMPLES / "sensor.toml").read_text().replace("[membrane]", "[membrane]\ngrid = [11, 11]")
        put(self.example | {"sensor.toml": text.encode()}, self.work / "small")
        path = self.work / "whole.onnx"
        tm.export(tm.Reconstructor.from_file(self.work / "small" / "sensor.toml"), path)
        self.modelled = self.run(path)
        return path.read_bytes()

    def run(self, path: Path) -> dict[str, np.ndarray]:
        """Results of the edge package."""
        from torchmembrane_edge.session import Session

        found: dict[str, np.ndarray] = Session(path).run(self.image)
        return found

    def model(self, folder: Path) -> str:
        """Run a damaged model in a process of its own, which onnxruntime may take down."""
        path, answer = folder / "m.onnx", multiprocessing.get_context("fork").SimpleQueue()

        def tried() -> None:
            from torchmembrane_edge.session import EdgeError

            with contextlib.redirect_stderr(io.StringIO()):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.__stderr__.fileno())
                try:
                    answer.put(self.run(path))
                except EdgeError as error:
                    answer.put(str(error))

        process = multiprocessing.get_context("fork").Process(target=tried)
        process.start()
        process.join(PATIENCE)
        if process.is_alive():
            process.kill()
            return "HANGS"
        if answer.empty():
            return f"ENDS WITH EXIT CODE {process.exitcode}"
        found = answer.get()
        if isinstance(found, str):
            raise tm.MembraneError(found)
        error = np.linalg.norm(found["vertices"] - self.modelled["vertices"]) / np.linalg.norm(self.modelled["displacement"])
        wrong = error > WRONG and found["status"][0] == 0
        return "WRONG WITH STATUS OK" if wrong else f"answered, {tm.Status(int(found['status'][0])).name}"


def write_bag(path: Path, png: bytes, count: int) -> None:
    """A bag of one picture, so many times."""
    store, kind = get_typestore(Stores.ROS2_HUMBLE), "sensor_msgs/msg/CompressedImage"
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/camera/image_raw/compressed", kind, typestore=store)
        for number in range(count):
            header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](number, 0), "camera")
            message = store.types[kind](header, "png", np.frombuffer(png, np.uint8))
            writer.write(connection, number * 10**8, store.serialize_cdr(message, kind))


def _files(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
