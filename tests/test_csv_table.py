"""A table is read correctly, or refused with its line and remedy."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from torchmembrane import MembraneError
from torchmembrane.calibrate.layout import read_pixels
from torchmembrane.camera.model import Camera
from torchmembrane.cli.calibrate.files import read_forces, read_motions
from torchmembrane.files.csv_table import Columns, read_table
from torchmembrane.files.timestamps import time_in
from torchmembrane.jobs.inputs import Inputs
from torchmembrane.jobs.pressure import read_pressures
from torchmembrane.presets.dot_list import read_drafted_dots
from torchmembrane.presets.draft import drafted_surface
from torchmembrane.sensor.toml import _read_dots

IMAGES = Inputs([Path("a.png"), Path("b.png"), Path("c.png")], [])
MM = SimpleNamespace(length_unit="mm")
SURFACE, CAMERA = drafted_surface("dome", {"radius": 12.0}, 20.0), Camera("pinhole", (640, 480), (400, 400), (320, 240))


def pressures(path):
    found = read_pressures(path, IMAGES, MM)
    return [found.since_rest, *(1e4 * found.values.get(name, np.nan) for name in "abc")]


SPOTS = [(-4, "large"), (0, "small"), (4, "small")]
READERS = {
    "motions": (read_motions, ["x,y,z,turn_x,turn_y,turn_z", "0,0,0,0,0,0", "1.5,-0.25,1e-3,0,-4,0.5", "0,1.5,0,4,+2,0"]),
    "forces": (lambda path: read_forces(path, IMAGES), ["image,fx,fy,fz", "a.png,0.5,-1.25,3e-1", "c.png,1,2,-3.5"]),
    "magnitudes": (lambda path: read_forces(path, IMAGES), ["image,force", "b.png,2.5", "c.png,1e-1"]),
    "gauge": (pressures, ["name,pressure", "a.png,10.5", "b,-3e-1", "c,"]),
    "changes": (pressures, ["name,pressure_change", "a,1.5", "b.png,+2.25"]),
    "pixels": (read_pixels, ["u,v,size", "320.5,240,large", "360,241.25,small"]),
    "dots": (_read_dots, ["x,y,z,size", "0.5,-1.25,26,small", "3,2e-1,25,large"]),
    "draft": (
        lambda path: read_drafted_dots(path, SURFACE, CAMERA),
        ["x,y,h,size", *(f"{x}.5,{y},7.25,{size}" for x in (-4, 0, 4) for y, size in SPOTS)],
    ),
}  # fmt: skip
"""Every reader of a table that a user gives, and a table for it."""

every_reader = pytest.mark.parametrize("kind", READERS)


def read(kind, tmp_path, content):
    path = tmp_path / "table.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    found = READERS[kind][0](path)
    return found if isinstance(found, tuple) else (found,)


def same(one, other):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def refused(kind, tmp_path, content):
    with pytest.raises(MembraneError) as caught:
        read(kind, tmp_path, content)
    message = str(caught.value)
    assert str(tmp_path / "table.csv") in message and "; expected " in message and message.isprintable()
    return message


def turned(lines):
    """The columns in the other order."""
    return [",".join(reversed(line.split(","))) for line in lines]


WRITTEN = {
    "another order": turned,
    "capitals and blanks": lambda lines: [" " + lines[0].upper().replace(",", " , ").replace("_", " "), *lines[1:]],
    "blank lines": lambda lines: ["", *(part for line in lines for part in (line, "  ")), ""],
    "lines of commas": lambda lines: [*lines, "," * lines[0].count(",")],
    "commas at the ends": lambda lines: [f"{line},," for line in lines],
    "blanks": lambda lines: [line.replace(",", " ,\t") for line in lines],
    "quotes": lambda lines: [", ".join(f'"{cell}"' for cell in line.split(",")) for line in lines],
    "comments": lambda lines: ["# of Monday, by hand", lines[0], '# a "quick one, 1,2', *lines[1:], "#"],
    "numpy's header": lambda lines: [f"# {lines[0]}", *lines[1:]],
    "a minus sign": lambda lines: [line.replace("-", "\N{MINUS SIGN}") if "e-" not in line else line for line in lines],
}


@every_reader
@pytest.mark.parametrize("how", WRITTEN)
def test_a_table_says_the_same_however_it_is_written(kind, how, tmp_path):
    lines = READERS[kind][1]
    written = "\n".join(WRITTEN[how](lines))
    plain, found = read(kind, tmp_path, "\n".join(lines)), read(kind, tmp_path, written)
    same([part for part in plain if not where(part)], [part for part in found if not where(part)])


def where(part):
    """Whether it names lines of the file, which blank ones move."""
    return isinstance(part, list) and "table.csv, line" in str(part[0])


@every_reader
@pytest.mark.parametrize("ends", ["\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_line_ends_and_a_byte_order_mark_are_passed_over(kind, ends, encoding, tmp_path):
    lines = READERS[kind][1]
    same(read(kind, tmp_path, "\n".join(lines)), read(kind, tmp_path, ends.join(lines).encode(encoding)))


def decimal_commas(lines):
    return [lines[0], *(line.replace(".png", "_png").replace(".", ",").replace("_png", ".png") for line in lines[1:])]


def semicolons(lines):
    return [line.replace(",", ";") for line in lines]


CHANGED = {
    "no header": (lambda lines: lines[1:], "line 1: the header is"),
    "another header": (lambda lines: ["a,b,c", *lines[1:]], "line 1: the header is 'a,b,c'"),
    "a unit in the header": (lambda lines: [lines[0].replace(",", " [cm],", 1), *lines[1:]], "[cm]"),
    "semicolons": (semicolons, "commas between them"),
    "semicolons and decimal commas": (lambda lines: semicolons(decimal_commas(lines)), "the header is"),
    "semicolons below the header": (lambda lines: [lines[0], *semicolons(lines[1:])], "line 2: "),
    "tabs": (lambda lines: [line.replace(",", "\t") for line in lines], "line 1: the header is"),
    "decimal commas": (decimal_commas, "commas only between columns, numbers with a decimal point"),
    "a column less": (lambda lines: [line.partition(",")[2] for line in lines], "line 1: the header is"),
    "a column too many": (lambda lines: [f"{line},{'note' if k == 0 else k}" for k, line in enumerate(lines)], "the header is"),
    "a cell too many": (lambda lines: [*lines[:-1], f"{lines[-1]},1"], "values, "),
    "a cell less": (lambda lines: [*lines[:-1], lines[-1].rpartition(",")[0]], "values, "),
    "nothing but a header": (lambda lines: lines[:1], "a line for each"),
    "nothing": (lambda lines: [], "line 1: the header is 'nothing'"),
    "a quote that is not closed": (lambda lines: [*lines[:-1], f'"{lines[-1]}'], "not readable as CSV"),
}


@every_reader
@pytest.mark.parametrize("how", CHANGED)
def test_a_table_that_may_mean_another_thing_is_refused(kind, how, tmp_path):
    change, words = CHANGED[how]
    assert words in refused(kind, tmp_path, "\n".join(change(READERS[kind][1])))


@every_reader
@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "latin-1"])
def test_other_encodings_are_refused_with_the_one_to_use(kind, encoding, tmp_path):
    content = "\n".join([*READERS[kind][1], "# \u00e4"]).encode(encoding)
    assert "saved as UTF-8" in refused(kind, tmp_path, content)


@every_reader
def test_a_column_twice_is_named(kind, tmp_path):
    name = READERS[kind][1][0].rpartition(",")[2]
    doubled = [f"{line},{line.rpartition(',')[2]}" for line in READERS[kind][1]]
    assert f"line 1: the header names {name} twice" in refused(kind, tmp_path, "\n".join(doubled))


WRONG = ["nan", "inf", "-Infinity", "1_0", "\u0661", "1 000", "1'000", "1\u00a0000", '"1,000"', '"1,5"', "1.000.5", "5-", "- 5",
         "(5)", "5 mm", "0x10", "1e", "1e999", "=1", "#N/A", "--", "1/2", "three", "5%", '"5'"'"'"', "\ufeff1"]  # fmt: skip
"""Cells that are no number, or may be one or another."""


@every_reader
@pytest.mark.parametrize("cell", WRONG)
def test_a_cell_that_is_no_one_number_is_named_with_its_line_and_column(kind, cell, tmp_path):
    lines = READERS[kind][1]
    names, last = lines[0].split(","), lines[-1].split(",")
    column = names.index(next(name for name in reversed(names) if name not in ("size", "image", "name")))
    last[column] = cell
    if cell == "nan" and kind in ("gauge", "changes"):  # there is no reading
        assert np.isnan(read(kind, tmp_path, "\n".join([*lines[:-1], ",".join(last)]))[0][-1])
        return
    said = refused(kind, tmp_path, "\n".join([*lines[:-1], ",".join(last)]))
    assert f"line {len(lines)}: {names[column]} = " in said
    assert re.search("expected a (number such as 12 or 1.5, with a point and not a comma|finite number)", said)


@every_reader
def test_an_empty_cell_is_named_where_it_must_be_known(kind, tmp_path):
    lines = [line if line != "c," else "c,1" for line in READERS[kind][1]]
    cells = lines[-1].split(",")
    for k, name in enumerate(lines[0].split(",")):
        table = "\n".join([*lines[:-1], ",".join([*cells[:k], "", *cells[k + 1 :]])])
        if name in ("pressure", "pressure_change"):
            assert np.isnan(read(kind, tmp_path, table)[0][-1])
        else:
            assert f"line {len(lines)}: " in refused(kind, tmp_path, table)


@pytest.mark.parametrize("kind", ["forces", "magnitudes", "gauge", "changes"])
def test_a_name_twice_or_of_no_image_is_named(kind, tmp_path):
    lines = READERS[kind][1]
    assert f"line {len(lines) + 1}: " in (said := refused(kind, tmp_path, "\n".join([*lines, lines[1]]))) and "twice" in said
    name, _, values = lines[1].partition(",")
    rest = [] if kind in ("gauge", "changes") else lines[1:]  # a gauge's log may have further readings
    assert "'z.png' is none of the" in refused(kind, tmp_path, "\n".join([lines[0], *rest, f"z.png,{values}"]))
    other = name.removesuffix(".png") if name.endswith(".png") else f"{name}.png"
    assert "also in line 2" in refused(kind, tmp_path, "\n".join([*lines[:2], f"{other},{values}"]))


def test_forces_are_of_images_by_either_name_in_any_order(tmp_path):
    forces, deviations = read("magnitudes", tmp_path, "force,image\n3,c\n1,a.png\n")
    np.testing.assert_array_equal(forces, [[1.0], [np.nan], [3.0]])
    assert deviations is None


def test_a_force_of_zero_is_refused(tmp_path):
    assert "line 2: fz = 0; expected a force that is not zero" in refused("forces", tmp_path, "image,fx,fy,fz\na,0,0,0\n")
    assert "line 3: force = 0.0; expected" in refused("magnitudes", tmp_path, "image,force\na,1\nb,0.0\n")


@pytest.mark.parametrize("size", ["Large", "LARGE", " large "])
def test_sizes_are_words_in_capitals_or_not(size, tmp_path):
    assert read("pixels", tmp_path, f"u,v,size\n1,2,{size}\n")[1] == ["large"]
    assert "line 2: size = 'big'; expected small or large" in refused("pixels", tmp_path, "u,v,size\n1,2,big\n")


def test_the_first_motion_is_none(tmp_path):
    lines = READERS["motions"][1]
    said = refused("motions", tmp_path, "\n".join([lines[0], *lines[2:]]))
    assert "line 2: x = 1.5; expected 0: the first image is the sensor's own" in said


@pytest.mark.parametrize(
    ("column", "value", "words"), [(0, "2e6", "a coordinate up to 1e+06"), (4, "400", "an angle up to 360")]
)
def test_motions_beyond_this_world_are_refused(column, value, words, tmp_path):
    cells = ["0"] * 6
    cells[column] = value
    assert words in refused("motions", tmp_path, "\n".join([*READERS["motions"][1], ",".join(cells)]))


@pytest.mark.parametrize("lines, words", [(1, "no dots"), (4, "4 dots; expected 5 to 7"), (8, "8 dots; expected 5 to 7")])
def test_too_few_and_too_many_lines_are_counted(lines, words, tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("x\n" + "1\n" * (lines if lines > 1 else 0))
    with pytest.raises(MembraneError, match=words):
        read_table(path, Columns([("x",)], "dot", least=1 if lines == 1 else 5, most=7), 1000)


def test_a_line_within_quotes_is_counted_to_its_end(tmp_path):
    assert "line 3: " in refused("forces", tmp_path, 'image,fx,fy,fz\n"a\n.png",1,2,3\n')


def test_readings_of_a_gauge_s_log_that_are_of_no_frame_are_counted(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("name,pressure\nz0,1\nb,2\nz1.png,3\nz2,\n")
    found = read_pressures(path, IMAGES, MM)
    assert found.unused == 2 and found.at("b", np.nan) == pytest.approx(2e-4) and np.isnan(found.at("a", np.nan))


TAKEN = Inputs([Path(f"p_20260927T1138{second}.png") for second in ("29", "29.5", "31", "50")] + [Path("untimed.png")], [])
BEGUN = 1790509109.0
CLOCKS = {
    "seconds": lambda t: f"{BEGUN + t:.3f}",
    "dates": lambda t: f"2026-09-27T11:38:{29 + t:06.3f}",
    "dates with blanks": lambda t: f"2026-09-27 11:38:{29 + t:06.3f}",
}


@pytest.mark.parametrize("clock", CLOCKS)
def test_readings_by_time_are_taken_between_their_neighbours(clock, tmp_path):
    path, clock = tmp_path / "log.csv", CLOCKS[clock]
    times = [1.0, -20.0, 0.0, 3.0]  # in any order
    path.write_text("time,pressure_change\n" + "".join(f"{clock(t)},{10 * t}\n" for t in times))
    found = read_pressures(path, TAKEN, MM)
    assert found.since_rest and found.unused == 1 and found.reach == 3.0
    readings = [1e4 * found.at(path.stem, time_in(path.stem)) for path in TAKEN.images]
    assert readings == pytest.approx([0.0, 5.0, 20.0, np.nan, np.nan], abs=1e-3, nan_ok=True)
    assert 1e4 * found.plus(1e-4).at("", BEGUN) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    "inputs, rows, said",
    [
        (TAKEN, "100,1\n200,2\n", "no reading is within 150 s of an image: readings from 100.000 to 200.000, images"),
        (IMAGES, "100,1\n200,2\n", "no image's name says when it was taken"),
        (TAKEN, "5,1\n5.0,2\n", "line 3: time = 5.0; expected each time once; line 2 has it as well"),
        (TAKEN, "today,1\n", "line 2: time = 'today'; expected a number"),
    ],
)
def test_a_log_by_time_that_fits_no_image_is_refused(inputs, rows, said, tmp_path):
    (tmp_path / "log.csv").write_text(f"time,pressure\n{rows}")
    with pytest.raises(MembraneError) as refusal:
        read_pressures(tmp_path / "log.csv", inputs, MM)
    assert said in str(refusal.value)


def test_a_reading_is_used_up_to_its_reach_before_and_after_a_frame(tmp_path):
    """Readings every 2 s: half as long again."""
    (tmp_path / "log.csv").write_text("time,pressure_change\n" + "".join(f"{1790509109 + t},{10 * t}\n" for t in (0, 2, 4)))
    found = read_pressures(tmp_path / "log.csv", TAKEN, MM)
    assert found.reach == 3.0
    near, far = ([1e4 * found.at("", BEGUN + t) for t in times] for times in ((-3.0, 7.0), (-3.25, 7.25)))
    assert near == pytest.approx([0.0, 40.0]) and np.isnan(far).all()
