"""No command overwrites a user's file unless told to."""

import ast
import errno
import io
import os
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from torchmembrane.calibrate.layout import FabricationLayout, write_layout, write_svg
from torchmembrane.calibrate.report import Report
from torchmembrane.cli.main import main
from torchmembrane.errors import MembraneError
from torchmembrane.files.atomic import make_folder, make_subfolder, whole_file, write_text
from torchmembrane.files.images import write_as_taken, write_image
from torchmembrane.files.targets import refuse_overwriting
from torchmembrane.interruption import remove_unfinished, unfinished
from torchmembrane.plot.files import save
from torchmembrane.plot.film import write_film
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.results.frame_shapes import SHAPES, shape_of
from torchmembrane.results.npz import save_frame
from torchmembrane.results.point_cloud import save_contact_cloud
from torchmembrane.results.reconstruction import Reconstruction
from torchmembrane.results.store import Mesh, Settings
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate.frames import video_file

EXAMPLES = Path(__file__).parents[1] / "examples"
FRAME = Reconstruction(*torch.ones(26, 1, 2, 3)).frame(0)
NOISE = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)


@pytest.fixture
def folder(tmp_path):
    """A sensor file with all its companions, and a file of the user's."""
    made = tmp_path / "mine"
    Sensor.from_file(EXAMPLES / "sensor.toml").to_file(made)
    (made / "notes.txt").write_text("of a long night")
    (made / "read.gif").write_text("a film")
    return made


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def refused(capsys, *arguments) -> str:
    """What a command says that refuses."""
    assert main([str(argument) for argument in arguments]) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return said


KINDS = {
    "file": lambda path, read: path.write_text("a"),
    "empty": lambda path, read: path.touch(),
    "link to another": lambda path, read: path.symlink_to(write_elsewhere(path)),
    "link to nothing": lambda path, read: path.symlink_to("nowhere"),
    "link to itself": lambda path, read: path.symlink_to(path),
}
INPUTS = {
    "the same": lambda path, read: shutil.move(path.parent / "read.png", path),
    "link": lambda path, read: path.symlink_to(read),
    "link to a link": lambda path, read: (path.with_name("l").symlink_to(read), path.symlink_to("l")),
    "second name": lambda path, read: os.link(read, path),
}
OTHERS = {"folder": lambda path, read: path.mkdir(), "pipe": lambda path, read: os.mkfifo(path)}


def write_elsewhere(path: Path) -> Path:
    (path.parent / "elsewhere").write_text("b")
    return path.parent / "elsewhere"


@pytest.mark.parametrize("make", KINDS.values(), ids=KINDS)
def test_what_is_there_is_written_over_with_force_alone(make, tmp_path):
    path, read = tmp_path / "target.png", tmp_path / "read.png"
    read.write_text("input")
    make(path, read)
    with pytest.raises(MembraneError, match=r"export: .*target\.png is there already; .*--force"):
        refuse_overwriting("export", [path], [read])
    refuse_overwriting("export", [path], [read], force=True)
    refuse_overwriting("export", [path], [read], is_own=lambda found: found == path)


@pytest.mark.parametrize("make", INPUTS.values(), ids=INPUTS)
def test_what_is_read_is_never_written_over(make, tmp_path):
    path, read = tmp_path / "target.png", tmp_path / "read.png"
    read.write_text("input")
    make(path, read)
    with pytest.raises(MembraneError, match=r"would write over .*target\.png, which it reads"):
        refuse_overwriting("export", [path], [read if read.exists() else path], force=True, is_own=lambda found: True)


@pytest.mark.parametrize("kind, make", OTHERS.items(), ids=OTHERS)
def test_no_file_takes_the_place_of_something_else(kind, make, tmp_path):
    path = tmp_path / "target.png"
    make(path, None)
    for write in (lambda: refuse_overwriting("export", [path], force=True), lambda: write_text(path, "a")):
        with pytest.raises(MembraneError, match=rf"target\.png: is a {kind}; expected the name of a file"):
            write()


def test_a_device_stays_what_it_is(tmp_path):
    with pytest.raises(MembraneError, match="/dev/full: is a device"):
        write_text("/dev/full", "a")
    assert not Path("/dev/full").is_file()


@pytest.mark.parametrize("name, words", [("a" * 300, "a shorter name"), ("notes.txt/a.png", "a folder that exists")])
def test_names_that_cannot_be_are_refused_before_the_work(name, words, folder):
    with pytest.raises(MembraneError, match=rf"not written \(.*\); expected {words}"):
        refuse_overwriting("check", [folder / name])
    with pytest.raises(MembraneError, match=rf"not written \(.*\); expected {words}"):
        write_text(folder / name, "a")


CODES = {
    "ENOSPC": "room on the disk",
    "EDQUOT": "room on the disk",
    "EFBIG": "a limit of files' size",
    "EACCES": "this user may write",
    "EPERM": "this user may write",
    "EROFS": "this user may write",
    "EIO": "this user may write",
}


@pytest.mark.parametrize("call", ["open", "write", "replace"])
@pytest.mark.parametrize("code, words", CODES.items())
def test_an_error_of_the_disk_names_the_file_and_leaves_the_old_one(code, words, call, tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    path.write_text("before")
    number = getattr(errno, code)

    def fail(*arguments, **named):
        name = str(arguments[0]) if call != "write" and arguments else None
        raise OSError(number, os.strerror(number), name)

    with pytest.raises(MembraneError, match=rf"a\.npz: not written \({os.strerror(number)}\); expected .*{words}"):
        with monkeypatch.context() as patched:
            if call == "open":
                patched.setattr(os, "open", fail)
            elif call == "replace":
                patched.setattr(Path, "replace", fail)
            with whole_file(path) as partial:
                if call == "write":
                    fail()
                partial.write_bytes(b"after")
    assert content(tmp_path) == {"a.npz": b"before"}


def test_an_error_of_another_file_is_left_to_it(tmp_path):
    with pytest.raises(FileNotFoundError, match="input"):
        with whole_file(tmp_path / "a.npz"):
            (tmp_path / "input").read_bytes()


def test_a_folder_that_cannot_be_made_is_named(folder):
    with pytest.raises(MembraneError, match=r"notes\.txt: is a file; expected a folder"):
        make_folder(folder / "notes.txt")
    with pytest.raises(MembraneError, match=r"notes\.txt/a/b: folder not made \(Not a directory\)"):
        make_folder(folder / "notes.txt" / "a" / "b")


def test_a_folder_of_results_leads_nowhere_else(tmp_path):
    (tmp_path / "frames").symlink_to("/tmp")
    with pytest.raises(MembraneError, match=r"frames: is a symbolic link to /tmp"):
        make_subfolder(tmp_path / "frames")


def test_what_is_begun_can_be_taken_away(tmp_path):
    work = tmp_path / "work"
    with pytest.raises(MembraneError, match="a: not written"), whole_file(tmp_path / "a"), unfinished(work):
        work.mkdir()
        (work / "part").write_text("half")
        remove_unfinished()
        assert list(tmp_path.iterdir()) == []


def write_a_video(path):
    with video_file(path) as add:
        for image in NOISE.transpose(2, 0, 1):
            add(np.ascontiguousarray(image))


def write_a_report(path):
    Report.without_parameters("a", ["b" * 5000]).write(path.parent)


def write_a_layout(path):
    sensor = Sensor.from_file(EXAMPLES / "sensor.toml")
    x, n = sensor.membrane.rest[:99].numpy(), np.tile([0.0, 0.0, 1.0], (99, 1))
    dots = FabricationLayout(x, n, np.full(99, 0.3), ["large"] * 99, np.zeros((99, 2)))
    (write_svg if path.suffix == ".svg" else write_layout)(path, sensor, dots)


def write_a_sensor(path):
    Sensor.from_file(EXAMPLES / "sensor.toml").to_file(path.parent)


WRITERS = {
    "press.npz": lambda path: save_frame(path, FRAME | {"vertices": np.zeros((999, 3))}),
    "press.ply": lambda path: save_contact_cloud(path, {key: np.ones((99, 3)) for key in FRAME} | {"contact": np.ones(99)}),
    "grey8.png": lambda path: write_image(path.with_suffix(""), NOISE[..., 0] / np.float32(255)),
    "grey16.png": lambda path: write_image(path.with_suffix(""), NOISE[..., 0] / np.float32(65535)),
    "grey.tiff": lambda path: write_image(path.with_suffix(""), np.full((64, 64), 0.1234567, np.float32)),
    "taken.png": lambda path: write_as_taken(path.with_suffix(""), NOISE),
    "figure.png": lambda path: save(Figure(), path),
    "film.gif": lambda path: write_film(path, [NOISE, NOISE], 5.0),
    "film.mp4": lambda path: write_film(path, [NOISE] * 30, 5.0),
    "film.mkv": lambda path: write_film(path, [NOISE] * 30, 5.0),
    "simulated.mp4": write_a_video,
    "report.json": write_a_report,
    "layout.csv": write_a_layout,
    "layout.svg": write_a_layout,
    "sensor.toml": write_a_sensor,
    "sensor_dots.csv": write_a_sensor,
    "sensor_grid.npz": write_a_sensor,
    "sensor_rest.png": write_a_sensor,
}


@pytest.mark.parametrize("name, write", WRITERS.items(), ids=WRITERS)
def test_every_writer_replaces_a_link_and_does_not_write_through_it(name, write, tmp_path):
    path, other = tmp_path / "out" / name, tmp_path / "other"
    path.parent.mkdir()
    other.write_text("of somebody")
    path.symlink_to(other)
    write(path)
    assert other.read_text() == "of somebody" and not path.is_symlink() and path.stat().st_size > 0
    assert not list(path.parent.glob(".*"))


@pytest.mark.parametrize("name, write", WRITERS.items(), ids=WRITERS)
def test_every_writer_names_its_file_on_a_full_disk_and_leaves_the_old_one(name, write, tmp_path):
    """A limit of the files' size stands for the disk's end."""
    path = tmp_path / "out" / name
    path.parent.mkdir()
    path.write_text("before")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(MembraneError) as refusal:
            write(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert str(refusal.value).startswith(f"{path.parent}/") and "not written (" in str(refusal.value)
    assert path.read_text() == "before" and [found.name for found in path.parent.iterdir()] == [name]


def stored_results(folder: Path) -> Path:
    """A folder with one frame, as `reconstruct` leaves it."""
    sensor = Sensor.from_file(EXAMPLES / "sensor.toml")
    reconstructor = Reconstructor(sensor, check_rest=False)
    folder.mkdir()
    Mesh.from_reconstructor(reconstructor, Settings.from_reconstructor(reconstructor, "npz")).save(folder / "mesh.npz")
    V, D = len(sensor.membrane.rest), len(reconstructor.rest_pixels)
    frame = {key: np.zeros(shape_of(key, {"V": V, "D": D, "P": 4})) for key in SHAPES}
    save_frame(folder / "press.npz", frame | {"status": np.int32(0)})
    return folder


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return stored_results(tmp_path_factory.mktemp("results") / "r")


SINGLE = {
    "check": ("check", "SENSOR", "--out"),
    "export": ("export", "SENSOR", "-o"),
    "view": ("view", "RESULTS", "--out"),
    "view --ply": ("view", "RESULTS", "--ply"),
    "view --video-out": ("view", "RESULTS", "--video-out"),
    "reconstruct --video-out": ("reconstruct", "SENSOR", "FILM", "--out", "OUT", "--video-out"),
    "live --save": ("live", "SENSOR", "--images", "IMAGES", "--rerun", "--save"),
}


def called(command, folder, results, target):
    names = {
        "SENSOR": folder / "sensor.toml",
        "RESULTS": results,
        "OUT": folder.parent / "out",
        "FILM": folder / "read.gif",
        "IMAGES": EXAMPLES,
    }
    return [names.get(part, part) for part in command] + [target]


@pytest.mark.parametrize("command", SINGLE.values(), ids=SINGLE)
def test_a_command_asks_before_it_writes_over_a_file(command, folder, results, capsys):
    target = folder / ("film.gif" if "--video-out" in command else "notes.txt")
    target.write_text("of a long night")
    before = content(folder)
    assert f"{target} is there already" in refused(capsys, *called(command, folder, results, target))
    assert content(folder) == before


@pytest.mark.parametrize("command", SINGLE.values(), ids=SINGLE)
def test_a_command_never_writes_over_what_it_reads(command, folder, results, capsys):
    target = (
        results / "press.npz" if "RESULTS" in command else folder / ("read.gif" if "FILM" in command else "sensor_rest.png")
    )
    before = content(folder), content(results)
    assert f"{target}, which it reads" in refused(capsys, *called(command, folder, results, target), "--force")
    assert (content(folder), content(results)) == before


def test_a_figure_is_drawn_anew_by_the_command_that_drew_it_and_no_other(folder, results, capsys):
    target = folder / "drawn.png"
    for _ in range(2):
        assert main(["check", str(folder / "sensor.toml"), "--out", str(target)]) == 0
    before = target.read_bytes()
    assert f"{target} is there already" in refused(capsys, "view", results, "--out", target)
    assert target.read_bytes() == before
    Image.open(target).save(target)  # says no more who drew it
    assert "is there already" in refused(capsys, "check", folder / "sensor.toml", "--out", target)
    assert main(["check", str(folder / "sensor.toml"), "--out", str(target), "--force"]) == 0


def test_a_view_without_a_display_is_drawn_anew_but_not_over_a_file_of_that_name(results, monkeypatch, tmp_path, capsys):
    folder = shutil.copytree(results, tmp_path / "r")
    monkeypatch.setattr("torchmembrane.cli.view._has_display", lambda: False)
    for _ in range(2):
        assert main(["view", str(folder / "press.npz")]) == 0
    (folder / "press_view.png").write_text("of somebody")
    assert "is there already" in refused(capsys, "view", folder / "press.npz")


STEPS = {
    "camera": ("I.png", "--corners", "4,3", "--square", "2"),
    "ports": ("--air", "I.png", "--dots", "9,7", "--pitch", "2"),
    "rest": ("I.png",),
    "views": ("I.png", "--motions", "M.csv"),
    "depth": ("D.npy", "--image", "I.png"),
    "material": ("I.png",),
    "layout": ("--pitch", "30"),
}


@pytest.mark.parametrize("step, options", STEPS.items(), ids=STEPS)
def test_a_calibration_is_not_written_into_the_folder_of_its_sensor(step, options, folder, capsys):
    given = {"I.png": folder / "sensor_rest.png", "M.csv": folder / "notes.txt", "D.npy": folder / "notes.txt"}
    before = content(folder)
    call = ["calibrate", step, folder / "sensor.toml", *(given.get(option, option) for option in options), "--out", folder]
    for force in ((), ("--force",)):
        said = refused(capsys, *call, *force)
        assert f"calibrate {step} --out {folder}: would write over {folder}/sensor.toml, which it reads" in said
    assert content(folder) == before


@pytest.mark.parametrize("name", ["report.json", "report.png", "sensor_dots.csv", "sensor.toml", "sensor_rest.tiff"])
def test_a_calibration_asks_before_it_writes_into_a_folder_that_holds_such_files(name, folder, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_text("of somebody")
    call = ("calibrate", "rest", folder / "sensor.toml", folder / "sensor_rest.png", "--out", out)
    assert f"{out / name} is there already" in refused(capsys, *call)
    assert content(out) == {name: b"of somebody"}


def test_a_report_of_a_calibration_is_not_written_over_an_image_that_it_reads(folder, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    shutil.copy(EXAMPLES / "rest.png", out / "report.png")
    call = ("calibrate", "rest", folder / "sensor.toml", out / "report.png", "--out", out, "--force")
    assert "report.png, which it reads" in refused(capsys, *call)


SPHERE = ("--indenter", "sphere", "--radius", "4", "--depth", "0.1")


@pytest.mark.parametrize(
    "name, options",
    [
        ("press.png", SPHERE),
        ("press_truth.npz", SPHERE),
        ("a.png", (*SPHERE, "--name", "a")),
        ("press_000001.png", (*SPHERE, "--path", "push", "--frames", "2")),
        ("press.mp4", (*SPHERE, "--path", "push", "--frames", "2", "--video")),
        ("simulation.json", SPHERE),
        ("sensor_rest.png", SPHERE),
        ("sensor_dots.csv", ("--random", "2")),
        ("s0_000001.png", ("--random", "2")),
    ],
)
def test_a_simulation_asks_before_it_writes_over_files(name, options, folder, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_text("{}" if name == "simulation.json" else "of somebody")
    before = content(out)
    said = refused(capsys, "simulate", folder / "sensor.toml", *options, "--out", out)
    assert f"{out / name}" in said and content(out) == before


def test_a_simulation_never_writes_over_its_indenter_or_its_sensor(folder, tmp_path, capsys):
    shutil.move(folder / "sensor.toml", folder / "mine.toml")
    said = refused(capsys, "simulate", folder / "mine.toml", *SPHERE, "--out", folder, "--force")
    assert f"{folder}/sensor_grid.npz, which it reads" in said


@pytest.fixture
def images(tmp_path):
    made = tmp_path / "images"
    made.mkdir()
    shutil.copy(EXAMPLES / "press_on_axis.png", made / "press.png")
    return made


def reconstructed(folder, images, out, *options):
    return main(["reconstruct", str(folder / "sensor.toml"), str(images), "--out", str(out), *map(str, options)])


@pytest.fixture
def quick(monkeypatch):
    """Frames are computed on few vertices."""
    read = Sensor.from_file.__func__

    def on_few(cls, path):
        sensor = read(cls, path)
        return replace(sensor, membrane=sensor.surface.membrane((9, 9)))

    monkeypatch.setattr(Sensor, "from_file", classmethod(on_few))


def test_figures_are_not_drawn_over_images_that_are_read(folder, images, capsys):
    before = content(images)
    for force in ((), ("--force",)):
        assert reconstructed(folder, images, images, "--figures", *force) == 2
        assert "press.png, which it reads" in capsys.readouterr().err
    assert content(images) == before


def test_a_job_goes_on_in_its_folder_but_spares_the_user_s_images_and_tables_there(folder, images, tmp_path, quick, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "summary.csv").write_text("my,own,table\n")
    assert reconstructed(folder, images, out) == 2 and "summary.csv is there already" in capsys.readouterr().err
    assert reconstructed(folder, images, out, "--force") == 0
    shutil.copy(images / "press.png", out / "press.png")  # beside its result, as people do
    before = (out / "press.png").read_bytes()
    assert reconstructed(folder, images, out, "--figures") == 2
    assert "press.png is there already" in capsys.readouterr().err and (out / "press.png").read_bytes() == before
    (out / "press.png").unlink()
    assert reconstructed(folder, images, out, "--figures") == 0
    (out / "press.npz").write_text("damaged")
    assert reconstructed(folder, images, out, "--figures") == 0  # draws its own figure anew
    assert (out / "press.damaged").read_text() == "damaged" and (out / "press.npz").stat().st_size > 1000


def test_a_full_standard_output_is_named(monkeypatch, capsys):
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr("sys.stdout", Full())
        assert main(["check", str(EXAMPLES / "sensor.toml")]) == 2
    assert "error: standard output: [Errno 28] No space left" in capsys.readouterr().err


WRITES = {"savefig", "write_table", "mkdir", "touch", "savetxt"}
WITHIN = {
    "files/atomic.py": "the one place",
    "plot/files.py": "within whole_file",
    "plot/film.py": "within whole_file",
    "results/data_set.py": "a folder of its own, renamed when it is whole",
    "results/frame_table.py": "within whole_file",
    "results/summary.py": "within whole_file",
    "simulate/frames.py": "within whole_file",
    "integrations/rosbag.py": "a folder of its own, renamed when it is whole",
    "live/recording.py": "a list that grows line by line, in a new folder",
    "processes.py": "a file of its own, for its workers",
    "machine_code.py": "a mark in the cache of machine code",
}
"""Modules that write files themselves, and how these are whole."""


def test_files_are_written_in_one_place():
    """Every call of a writer in the package, but of `write_text` and `write_bytes` as functions of atomic."""
    package, found = Path(__file__).parents[1] / "torchmembrane", set()
    for path in package.rglob("*.py"):
        for node in (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)):
            method, function = getattr(node.func, "attr", ""), getattr(node.func, "id", "")
            given = [
                part.value for part in (*node.args, *(key.value for key in node.keywords)) if isinstance(part, ast.Constant)
            ]
            mode = any(isinstance(value, str) and value.strip("bt+") in ("w", "x", "a") for value in given)
            if method in WRITES | {"write_text", "write_bytes"} or ("open" in (method, function) and mode):
                found.add(path.relative_to(package).as_posix())
    assert found == WITHIN.keys(), found ^ WITHIN.keys()
