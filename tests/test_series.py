"""Plots of a folder show force, moment and pressure over time."""

import csv
import shutil

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.patches import Rectangle
from PIL import Image
from test_batch import Denting, grey_image, reconstruct

from torchmembrane.cli.main import main
from torchmembrane.files.order import evenly
from torchmembrane.plot.film import write_film
from torchmembrane.plot.series import series_figure
from torchmembrane.plot.sheet import sheet_figure
from torchmembrane.results.read import read_results
from torchmembrane.results.summary import read_summary
from torchmembrane.results.summary_row import NAMES

STATUSES = (0, 0, 7, 7, 0, 4)


def table(times=True):
    """Six rows: force along z grows, two frames are unexplained, the last one is blank."""
    rows = []
    for k, status in enumerate(STATUSES):
        row = dict.fromkeys(NAMES, "") | {"name": f"f{k}", "status": str(status), "length_unit": "mm", "force_unit": "N"}
        if times:
            row["time"] = str(100 + 0.5 * k)
        if status != 4:
            row |= {"force_z": str(-k), "force": str(k), "force_x": "0.5", "force_deviation_z": "0.25", "moment_y": str(2 * k)}
            row["pressure_change_hpa"] = str(3 * k)
        rows.append(row)
    return rows


def line(axes, label):
    (found,) = (line for line in axes.get_lines() if line.get_label() == label)
    return np.stack(found.get_data())


def test_lines_are_the_table_s_columns_over_its_times():
    force, moment, pressure = series_figure({"day": table()}).axes
    np.testing.assert_array_equal(line(force, "z"), [[0, 0.5, 1, 1.5, 2, 2.5], [0, -1, -2, -3, -4, np.nan]])
    np.testing.assert_array_equal(line(moment, "y")[1], [0, 2, 4, 6, 8, np.nan])
    np.testing.assert_array_equal(pressure.get_lines()[0].get_ydata(), [0, 3, 6, 9, 12, np.nan])
    assert pressure.get_ylabel() == "pressure change [hPa]" and pressure.get_xlabel() == "time [s]"


def test_a_gauge_s_readings_stand_beside_the_pressure_found():
    """Readings are across the membrane, what is drawn since rest: 700 hPa are across it at rest."""
    rows = table()
    for k in (1, 3):
        rows[k] |= {"pressure_hpa": str(700 + 3 * k), "gauge_pressure_hpa": str(700 + 4 * k)}
    pressure = series_figure({"day": rows}).axes[2]
    np.testing.assert_allclose(line(pressure, "read by a gauge")[1], [np.nan, 4, np.nan, 12, np.nan, np.nan])


def test_the_axis_says_when_a_recording_began():
    rows = [row | {"time": str(1790509109.25 + k)} for k, row in enumerate(table())]
    assert series_figure({"day": rows}).axes[2].get_xlabel() == "time [s] since 2026-09-27 11:38:29 UTC"


def test_without_times_frames_are_numbered():
    axes = series_figure({"day": table(times=False)}).axes
    assert axes[2].get_xlabel() == "frame" and line(axes[0], "z")[0].tolist() == [0, 1, 2, 3, 4, 5]


def test_an_interval_is_one_standard_deviation():
    force = series_figure({"day": table()}).axes[0]
    bands = [band for band in force.collections if isinstance(band, PolyCollection)]
    corners = np.concatenate([path.vertices for path in bands[2].get_paths()])
    at = corners[np.isclose(corners[:, 0], 1.0), 1]
    assert sorted(set(np.round(at, 9))) == [-2.25, -1.75]


def test_frames_that_are_not_ok_are_shaded_by_status():
    drawing = series_figure({"day": table()})
    spans = [(patch.get_x(), patch.get_width()) for patch in drawing.axes[0].patches if isinstance(patch, Rectangle)]
    np.testing.assert_allclose(spans, [(0.75, 1.0), (2.25, 0.5)])
    words = [text.get_text() for text in drawing.legends[0].get_texts()]
    assert (
        "status 7: the markers move as no surface of this sensor does" in words
        and "status 4: blank or saturated image" in words
    )


def test_runs_stand_side_by_side_with_one_scale():
    drawing = series_figure({"one": table(), "two": [row | {"force_z": "-9"} for row in table()[:2]]})
    assert [axes.get_title() for axes in drawing.axes[:2]] == ["one", "two"]
    assert drawing.axes[0].get_ylim() == drawing.axes[1].get_ylim() and drawing.axes[0].get_ylim()[0] < -9


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("recording")
    paths = [grey_image(out / f"i{k}.png", 30 * k) for k in range(4)]
    reconstruct(paths, out / "results", reconstructor=Denting())
    return out / "results"


def test_the_command_draws_a_plot_and_a_sheet(folder, tmp_path, capsys):
    assert main(["view", str(folder), "--plot", str(tmp_path / "forces.png"), "--sheet", str(tmp_path / "sheet.png")]) == 0
    said = capsys.readouterr().out
    assert f"4 frames of {folder} drawn" in said and "4 of 4 frames" in said
    assert main(["view", str(folder), str(folder), "--plot", str(tmp_path / "forces.png")]) == 0  # its own may be drawn anew
    assert min(Image.open(tmp_path / "forces.png").size) > 1000
    for more in ([], ["--plot", str(tmp_path / "forces.png"), "--sheet", str(tmp_path / "sheet.png")]):
        assert main(["view", str(folder), str(folder), *more]) == 2
        assert "2 results; expected one, or --plot FILE.png alone" in capsys.readouterr().err


def test_a_plot_of_folders_with_other_units_names_each_with_its_units(folder, tmp_path, capsys):
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    rows = read_summary(other)
    with (other / "summary.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows({**row, "length_unit": "m"} for row in rows)
    assert main(["view", str(folder), str(other), "--plot", str(tmp_path / "forces.png")]) == 2
    said, (unit, length) = capsys.readouterr().err, (rows[0][f"{of}_unit"] for of in ("force", "length"))
    assert f"{folder}: {unit} (force), {length} (length); {other}: {unit} (force), m (length); expected the same units" in said


def test_a_plot_spares_the_tables_of_all_folders(folder, tmp_path, capsys):
    other = shutil.copytree(folder, tmp_path / "other")
    table = other / "summary.csv"
    before = table.read_bytes()
    assert main(["view", str(folder), str(other), "--plot", str(table), "--force"]) == 2
    assert str(table) in capsys.readouterr().err and table.read_bytes() == before


def test_a_folder_without_a_table_of_this_version_is_refused(folder, tmp_path, capsys):
    (tmp_path / "summary.csv").write_text("name,file,status\na,a.png,0\n")
    assert main(["view", str(tmp_path), "--plot", str(tmp_path / "forces.png")]) == 2
    assert "no rows with this version's columns" in capsys.readouterr().err
    with open(folder / "summary.csv", newline="") as file:
        assert read_summary(folder) == list(csv.DictReader(file))


def test_a_sheet_has_every_frame_with_its_name_force_and_status(folder):
    results = read_results(folder)
    drawing = sheet_figure({name: (frame, None) for name, frame in zip(results.names, results, strict=True)}, results.mesh)
    titles = [axes.get_title() for axes in drawing.axes[:4]]
    assert titles[0] == "i0\nno surface, status 4" and titles[3].startswith("i3\n") and titles[3].endswith(" N")
    assert len({axes.get_position().bounds for axes in drawing.axes}) == 5


@pytest.mark.parametrize("hardest, said", [(0.01234, "0.0123"), (1.234, "1.23"), (123.4, "123"), (12340.0, "12340")])
def test_forces_on_a_sheet_have_three_digits_of_the_hardest(folder, hardest, said):
    results = read_results(folder)
    frame = results["i3"] | {"force": np.array([0.0, 0.0, -hardest])}
    light = results["i2"] | {"force": np.array([0.0, 0.0, -hardest / 10])}
    drawing = sheet_figure({"light": (light, None), "hard": (frame, None)}, results.mesh)
    one, other = (axes.get_title().partition("\n")[2] for axes in drawing.axes[:2])
    assert other == f"{said} N" and len(one.partition(".")[2]) == len(other.partition(".")[2])


def test_frames_of_a_long_recording_are_chosen_evenly():
    assert evenly(range(1001), 101) == list(range(0, 1001, 10)) and evenly([1], 5) == [1]


def test_the_colours_of_a_map_survive_a_gif(tmp_path):
    """Of forty shades of each map, black lines and a picture's greys; by 64 colours some were off by 40 of 255."""
    from matplotlib import colormaps

    shades = np.concatenate([colormaps[name](np.linspace(0, 1, 41))[:, :3] for name in ("RdBu", "Oranges")])
    blocks = np.rint(255 * shades).astype(np.uint8).repeat(8, 0)
    picture = np.stack([blocks] * 64)
    picture[32:] = np.linspace(0, 255, picture.shape[1]).astype(np.uint8)[None, :, None]
    write_film(tmp_path / "film.gif", [picture, picture], 10)
    shown = np.asarray(Image.open(tmp_path / "film.gif").convert("RGB")).astype(int)
    assert np.abs(shown - picture).max() <= 8
