"""Every column of summary.csv agrees with the frames' arrays."""

import csv
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from test_batch import Denting, grey_image, reconstruct, summary_of, write_video

from torchmembrane.files import timestamps
from torchmembrane.files.provenance import SourceFile
from torchmembrane.files.timestamps import time_in
from torchmembrane.integrations.rosbag import StampedMessage
from torchmembrane.results import summary_row
from torchmembrane.results.read import read_results
from torchmembrane.results.summary import read_summary
from torchmembrane.results.summary_row import METRE, NAMES
from torchmembrane.sensor import units

EDGE = Path(__file__).parents[1] / "export" / "torchmembrane_edge"
HEADER = (
    "name,file,status,status_text,time,markers_found,markers_total,coverage,residual_px,pressure,pressure_change,"
    "pressure_hpa,pressure_change_hpa,force,force_x,force_y,force_z,force_deviation_x,force_deviation_y,force_deviation_z,"
    "moment_x,moment_y,moment_z,contacts,"
    + "".join(
        f"contact_{k}_x,contact_{k}_y,contact_{k}_z,contact_{k}_force,contact_{k}_force_x,contact_{k}_force_y,"
        f"contact_{k}_force_z,contact_{k}_area,"
        for k in (1, 2, 3, 4)
    )
    + "deepest,deepest_x,deepest_y,deepest_z,depth_deviation,volume_error,seconds,content_hash,length_unit,force_unit,"
    "gauge_pressure_hpa,contact_1_at_rim,contact_2_at_rim,contact_3_at_rim,contact_4_at_rim"
)
"""What programs that read the table rely on: a column is never renamed or moved."""
AFTER = ("gauge_pressure_hpa", "contact_1_at_rim", "contact_2_at_rim", "contact_3_at_rim", "contact_4_at_rim")
"""Those that came after the first version of the table."""


class Scattering(Denting):
    """Every number of a result is another one; three contact patches of four."""

    def __call__(self, batch, pressure=None):
        found = super().__call__(batch)
        draw = torch.Generator().manual_seed(3)
        plain = {
            key: value if key in ("status", "confidence") else value + torch.rand(value.shape, generator=draw)
            for key, value in found._asdict().items()
        }
        for key in ("contact_points", "contact_force", "contact_area", "contact_at_rim"):
            plain[key][:, 3] = torch.nan
        return type(found)(**plain)


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Row and frame of an image with a time in its name, a row of a broken file, and the folder."""
    folder = tmp_path_factory.mktemp("summary")
    image = grey_image(folder / "press_20260927T113829.250.png", 120)
    (folder / "broken.png").write_bytes(b"no image")
    gauge = {image.stem: 0.00125}  # N/mm^2
    reconstruct([image, folder / "broken.png"], folder / "out", reconstructor=Scattering(), pressure=gauge)
    rows = summary_of(folder / "out")
    return rows[image.stem], read_results(folder / "out")[image.stem], rows["broken"], folder


def test_the_columns_are_stable(table):
    assert (table[-1] / "out" / "summary.csv").read_text().splitlines()[0] == HEADER


def test_each_column_holds_what_the_frame_s_arrays_say(table):
    row, frame, _, folder = table
    image, mesh = folder / f"{row['name']}.png", read_results(folder / "out").mesh
    lowest = (frame["displacement"] * mesh.rest_normals).sum(-1)
    expected = {
        "status": 0,
        "time": 1790509109.25,
        "markers_found": 7,
        "markers_total": 7,
        "coverage": frame["coverage"],
        "residual_px": frame["residual"],
        "pressure": frame["pressure"],
        "pressure_change": frame["pressure_change"],
        "pressure_hpa": frame["pressure"] * 1e4,  # 1 N/mm^2 is 1e6 Pa
        "pressure_change_hpa": frame["pressure_change"] * 1e4,
        "gauge_pressure_hpa": 12.5,
        "force": np.sqrt((frame["force"] ** 2).sum()),
        "contacts": 3,
        "deepest": lowest.min(),
        "depth_deviation": frame["depth_deviation"],
        "volume_error": frame["volume_error"],
    }
    triples = {"force": frame["force"], "force_deviation": frame["force_deviation"], "moment": frame["wrench"][3:]}
    triples["deepest"] = frame["vertices"][lowest.argmin()]
    for k in range(4):
        place, force, area = (frame[f"contact_{key}"][k] for key in ("points", "force", "area"))
        triples |= {f"contact_{k + 1}": place, f"contact_{k + 1}_force": force}
        expected[f"contact_{k + 1}_at_rim"] = frame["contact_at_rim"][k]
        expected |= {f"contact_{k + 1}_force": np.sqrt((force**2).sum()), f"contact_{k + 1}_area": area}
    expected |= {f"{key}_{axis}": value for key, values in triples.items() for axis, value in zip("xyz", values, strict=True)}
    for key, value in expected.items():
        assert row[key] == "" if np.isnan(value) else float(row[key]) == pytest.approx(float(value), rel=2e-5), key
    texts = {"name": image.stem, "file": str(image), "status_text": "ok", "length_unit": "mm", "force_unit": "N"}
    texts["content_hash"] = SourceFile.from_files(image).content_hash
    assert {key: row[key] for key in texts} == texts and float(row["seconds"]) > 0
    assert set(expected) | set(texts) | {"seconds"} == set(NAMES)


def test_a_file_without_an_image_has_its_reason_and_no_numbers(table):
    row, folder = table[2], table[-1]
    said = {key: cell for key, cell in row.items() if cell}
    assert said.pop("status_text").startswith("unreadable: not readable")
    assert said == {
        "name": "broken",
        "file": str(folder / "broken.png"),
        "status": "-1",
        "length_unit": "mm",
        "force_unit": "N",
    }


def test_the_dictionary_beside_the_table_has_every_column_with_the_sensor_s_units(table):
    with open(table[-1] / "out" / "summary_columns.csv", newline="") as file:
        columns = {row["name"]: row for row in csv.DictReader(file)}
    assert list(columns) == HEADER.split(",") and all(column["meaning"] for column in columns.values())
    units = {key: columns[key]["unit"] for key in ("force", "moment_x", "contact_2_area", "pressure", "pressure_hpa", "time")}
    assert list(units.values()) == ["N", "N mm", "mm^2", "N/mm^2", "hPa", "s"]


def test_rows_of_a_table_without_the_last_columns_are_kept(table, tmp_path):
    """As of a folder that was written before these came."""
    before = [name for name in NAMES if name not in AFTER]
    with open(tmp_path / "summary.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, before, extrasaction="ignore")
        writer.writeheader()
        writer.writerow(table[0])
    (row,) = read_summary(tmp_path)
    assert {name: row[name] for name in before} == {name: table[0][name] for name in before}
    assert {row[name] for name in AFTER} == {""}


DAMAGE = {
    "a cell less": lambda cells: cells[:-1],
    "a cell more": lambda cells: [*cells, "7"],
    "cut off": lambda cells: cells[:9],
    "a word for a number": lambda cells: ["much" if name == "force" else cell for name, cell in zip(NAMES, cells, strict=True)],
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_row_is_left_out_and_the_others_are_kept(table, damage, tmp_path):
    rows = [[table[0][name] for name in NAMES], [table[2][name] for name in NAMES]]
    with open(tmp_path / "summary.csv", "w", newline="") as file:
        csv.writer(file).writerows([NAMES, rows[0], DAMAGE[damage](rows[0]), rows[1]])
    assert [[row[name] for name in NAMES] for row in read_summary(tmp_path)] == rows


def test_relative_pressures_are_not_given_in_hectopascals():
    frame = {"pressure": np.float32(2.0), "pressure_change": np.float32(1.0)}
    normals = np.zeros((0, 3))
    assert summary_row.numbers(frame, normals, "m", "N")["pressure_hpa"] == pytest.approx(0.02)
    assert np.isnan(summary_row.numbers(frame, normals, "m", "relative")["pressure_hpa"])
    assert METRE == units.METRE


TIMES = {
    "press_20260927_113829": 1790509109,
    "IMG_20260927_113829123": 1790509109.123,
    "2026-09-27T11-38-29.5_left": 1790509109.5,
    "2026-09-27 11:38:29": 1790509109,
    "20260927113829": 1790509109,
    "1790509109.25": 1790509109.25,
    "frame1790509109250": 1790509109.25,
    "1790509109250000": 1790509109.25,
    "1790509109250000000": 1790509109.25,
    "1790509109_250000000": 1790509109.25,
    "20260927_113829_000012": 1790509109,
}


@pytest.mark.parametrize("name", TIMES)
def test_a_name_s_time_is_found_as_cameras_write_it(name):
    assert time_in(name) == pytest.approx(TIMES[name], abs=1e-6)


@pytest.mark.parametrize(
    "name", ["press", "000012", "20269927_113829", "20260231_113829", "0000000012", "12345678", "press_2026"]
)
def test_a_name_without_a_time_gives_none(name):
    assert np.isnan(time_in(name))


@pytest.mark.parametrize("stem, begun", [("press", 0.0), ("press_20260927_113829", 1790509109.0)])
def test_pictures_of_a_video_are_of_the_time_after_its_beginning(stem, begun, tmp_path):
    reconstruct([write_video(tmp_path / f"{stem}.mkv", [100, 110, 120])], tmp_path / "out")
    times = [float(row["time"]) - begun for row in summary_of(tmp_path / "out").values()]
    assert times == pytest.approx([0, 0.1, 0.2], abs=2e-3)  # Matroska counts milliseconds


def test_an_image_of_a_bag_is_of_its_header_s_time_or_of_its_reception():
    of = lambda sec, nanosec: SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec)))  # noqa: E731
    assert StampedMessage(9_000_000_000, of(7, 500_000_000)).time == 7.5
    assert StampedMessage(9_000_000_000, of(0, 0)).time == 9.0


@pytest.mark.parametrize("module", [summary_row, timestamps], ids=["summary_row", "timestamps"])
def test_torchmembrane_edge_has_the_same_columns_and_times(module):
    path = Path(module.__file__)
    assert path.read_bytes() == (EDGE / path.name).read_bytes(), f"copy {path} to {EDGE}"
