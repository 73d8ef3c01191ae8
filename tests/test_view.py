"""Figures show where, how deep and in which unit."""

import subprocess
import sys
from itertools import combinations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from matplotlib.transforms import Bbox
from PIL import Image

from torchmembrane.camera.model import Camera
from torchmembrane.cli.film import FrameImages
from torchmembrane.plot import frames as view
from torchmembrane.plot.files import save
from torchmembrane.plot.sensor import sensor_figure
from torchmembrane.results.status import Status
from torchmembrane.results.store import Mesh
from torchmembrane.sensor.parts import Cavity, Markers, Material
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.surface.shapes import ellipsoid_cap, spherical_cap

GRID = (15, 15)
DENT = 7 * 15 + 10
SIZE = (640, 480)


def cap_mesh(camera: Camera, marker_count=150, force_unit="N") -> Mesh:
    membrane = spherical_cap(12.0, 9.0, 8.0, grid=GRID)
    vertex_pixels = camera.point_to_pixel(membrane.rest).numpy()
    rng = np.random.default_rng(1)
    weights = rng.dirichlet(np.ones(3), marker_count)
    triangles = membrane.triangles.numpy()
    corners = vertex_pixels[triangles[rng.integers(len(triangles), size=marker_count)]]
    rest_pixels = (corners * weights[..., None]).sum(1)
    return Mesh(
        membrane.rest.numpy(), membrane.rest_normals.numpy(), triangles, membrane.fixed.numpy(), np.array(GRID),
        vertex_pixels, rest_pixels, np.array(SIZE), "mm", force_unit, "cap", "f", "minimum-energy", "harmonic",
        "triangle", "npz",
    )  # fmt: skip


def pressed(mesh: Mesh, depth=1.5, flow=4.0) -> dict[str, np.ndarray]:
    """A dent about vertex `DENT`, markers moved by `flow` px to the right, two of them lost."""
    near = np.exp(-(((mesh.rest_vertices - mesh.rest_vertices[DENT]) ** 2).sum(-1)) / 8)
    displacement = -depth * near[:, None] * mesh.rest_normals
    pixels = mesh.rest_pixels + [flow, 0.0]
    pixels[:2] = np.nan
    return {
        "vertices": mesh.rest_vertices + displacement, "displacement": displacement, "pixels": pixels,
        "confidence": np.isfinite(pixels[:, 0]).astype(np.float32), "pressure_change": np.float32(0.0123),
        "contact_points": np.full((4, 3), np.nan, np.float32), "traction": np.zeros_like(displacement),
        "normals": mesh.rest_normals, "force": np.zeros(3, np.float32),
        "residual": np.float32(0.25), "status": np.int32(Status.OK),
    }  # fmt: skip


@pytest.fixture
def mesh() -> Mesh:
    return cap_mesh(Camera("fisheye", SIZE, (220, 220), (320, 240)))


def texts(drawing) -> str:
    found = [text.get_text() for text in drawing.findobj(match=lambda artist: hasattr(artist, "get_text"))]
    return "\n".join(found)


def arrows(axes) -> Quiver:
    return next(artist for artist in axes.get_children() if isinstance(artist, Quiver))


def labels(axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_three_panels_with_units_and_a_title(mesh):
    drawing = view.figure(pressed(mesh), mesh, np.full((480, 640), 0.5), "press_7")
    flow, side, map_ = drawing.axes
    assert (flow.get_xlabel(), flow.get_ylabel()) == (map_.get_xlabel(), map_.get_ylabel()) == ("u [px]", "v [px]")
    assert "[mm]" in side.get_xlabel() and "[mm]" in side.get_ylabel()
    assert len(flow.images) == 1 and side.collections and map_.collections
    title = drawing.get_suptitle()
    assert all(part in title for part in ("press_7", "ok", "+123 hPa", "0.25 px"))


@pytest.mark.parametrize(
    "force, length, said", [("N", "mm", "+250 hPa"), ("N", "m", "+0.00025 hPa"), ("relative", "mm", "+0.025 relative/mm²")]
)
def test_a_pressure_is_said_in_hpa_where_forces_have_a_unit(mesh, force, length, said):
    assert mesh._replace(force_unit=force, length_unit=length).pressure_in_words(0.025) == said


def test_of_views_that_share_an_image_the_first_ones_region_is_drawn(mesh, tmp_path):
    """Of files; an image that is that region already stays, and so does any of a sensor whose views share none."""
    grey = np.arange(480 * 900).reshape(480, 900) % 251
    Image.fromarray(grey.astype(np.uint8)).save(tmp_path / "a.png")
    shared = mesh._replace(image_part=np.array([200, 0, 900, 480]))
    drawn = FrameImages({"a": tmp_path / "a.png"}, shared).named("a")
    np.testing.assert_allclose(255 * drawn, grey[:, 200:840], atol=1e-4)
    assert shared.file_size == (900, 480) and shared.first_region(drawn) is drawn
    assert mesh.file_size == SIZE and mesh.first_region(grey) is grey
    shared.save(tmp_path / "mesh.npz")
    assert Mesh.load(tmp_path / "mesh.npz").image_part.tolist() == [200, 0, 900, 480]


def test_the_deepest_point_is_marked_with_its_value(mesh):
    map_ = view.figure(pressed(mesh), mesh).axes[2]
    note = next(text for text in map_.texts if "mm" in text.get_text())
    assert note.get_text() == "-1.5 mm"
    assert note.xy == pytest.approx(mesh.vertex_pixels[DENT])
    x, y, z = mesh.rest_vertices[DENT] - 1.5 * mesh.rest_normals[DENT]
    assert map_.get_title() == f"Deepest at x, y, z = {x:.2f}, {y:.2f}, {z:.2f} mm"


def test_where_nothing_is_pressed_nothing_is_marked(mesh):
    map_ = view.figure(pressed(mesh, depth=0.01), mesh).axes[2]
    assert not map_.texts and map_.get_title() == "Not pressed in by 0.05 mm anywhere"


def test_the_colour_scale_is_symmetric_and_does_not_blow_up_noise(mesh):
    for depth, limit in ((1.5, 1.5), (1e-6, view.LEAST_SCALE * 24)):
        shades = view.figure(pressed(mesh, depth), mesh).axes[2].collections[0]
        assert shades.norm.vmin == pytest.approx(-shades.norm.vmax)
        assert shades.norm.vmax == pytest.approx(limit, rel=0.02)


def test_arrows_lead_from_rest_to_now_as_long_as_the_legend_says(mesh):
    flow = view.figure(pressed(mesh, flow=4.0), mesh).axes[0]
    drawn = arrows(flow)
    assert drawn.U == pytest.approx(np.full(148, 40.0)) and drawn.V == pytest.approx(np.zeros(148), abs=1e-9)
    assert np.allclose(drawn.XY, mesh.rest_pixels[2:])
    assert any("10 times" in label for label in labels(flow)) and "lost (2)" in labels(flow)
    assert arrows(view.figure(pressed(mesh, flow=30.0), mesh).axes[0]).U == pytest.approx(np.full(148, 30.0))


def test_arrows_are_thinned_where_there_are_many():
    mesh = cap_mesh(Camera("fisheye", SIZE, (220, 220), (320, 240)), marker_count=1400)
    flow = view.figure(pressed(mesh), mesh).axes[0]
    count = len(arrows(flow).U)
    assert 100 < count < 350
    assert f"at rest (1398, {count} drawn)" in labels(flow)


@pytest.mark.parametrize("vertex, letter", [(7 * 15 + 1, "y"), (1 * 15 + 7, "x")])
def test_the_side_view_shows_the_dent_in_profile(mesh, vertex, letter):
    farther = "xy"[int(np.abs(mesh.rest_vertices[vertex][:2]).argmax())]
    frame = pressed(mesh)
    frame["displacement"] = np.zeros_like(mesh.rest_vertices)
    frame["displacement"][vertex] = -mesh.rest_normals[vertex]
    side = view.figure(frame, mesh).axes[1]
    assert farther == letter and side.get_xlabel().startswith(letter)


@pytest.mark.parametrize("status", [Status.TOO_FEW_MARKERS, Status.UNLIKE_REST, Status.BLANK, Status.BAD_VALUES])
def test_a_failed_frame_says_so_in_words(mesh, status):
    frame = pressed(mesh)
    nothing = ("vertices", "displacement", "pressure_change", "pixels")
    frame |= {key: np.full_like(frame[key], np.nan) for key in nothing}
    frame |= {"status": np.int32(status), "confidence": np.zeros(150)}
    drawing = view.figure(frame, mesh, np.zeros((480, 640)), "dark")
    words = texts(drawing)
    assert "no surface for this frame" in words and "0 of 150 markers found" in words
    assert Status(status).text.partition(":")[0] in words and "NOT OK" in drawing.get_suptitle()
    assert "nan" not in words


def test_an_answer_without_convergence_is_drawn_and_named(mesh):
    frame = pressed(mesh) | {"status": np.int32(Status.NOT_CONVERGED)}
    drawing = view.figure(frame, mesh)
    assert len(drawing.axes) == 3 and "NOT OK: the solve has not converged" in drawing.get_suptitle()


def test_relative_forces_are_called_relative():
    mesh = cap_mesh(Camera("fisheye", SIZE, (220, 220), (320, 240)), force_unit="relative")
    assert "relative/mm²" in view.figure(pressed(mesh), mesh).get_suptitle()


def test_a_fourth_panel_shows_where_and_how_hard_something_pushes(mesh):
    frame = pressed(mesh)
    near = np.exp(-(((mesh.rest_vertices - mesh.rest_vertices[DENT]) ** 2).sum(-1)) / 8)
    frame |= {"traction": -2.0 * near[:, None] * mesh.rest_normals, "force": np.array([3.0, 0.0, -4.0])}
    frame["contact_points"][0] = mesh.rest_vertices[DENT]
    drawing = view.figure(frame, mesh)
    (panel,) = drawing.axes[3:4]
    assert len(view.figure(pressed(mesh), mesh).axes) < len(drawing.axes)
    assert panel.get_title() == "Force 5.00 N (3.00, 0.00, -4.00)"
    assert panel.child_axes[0].get_xlabel() == "compressive normal traction [N/mm²]"
    (mark,) = (line for line in panel.get_lines() if line.get_marker() == "x")
    np.testing.assert_allclose(np.ravel(mark.get_data()), mesh.vertex_pixels[DENT])
    (arrow,) = (text for text in panel.texts if text.arrow_patch is not None)
    step = (
        np.subtract(arrow.xyann, arrow.xy)
        if np.allclose(arrow.xy, mesh.vertex_pixels[DENT])
        else np.subtract(arrow.xy, arrow.xyann)
    )
    assert step[0] > 0 and abs(step[1]) < 1e-6


def test_saved_as_png_1600_wide_whole_or_not_at_all(mesh, tmp_path):

    save(view.figure(pressed(mesh), mesh), tmp_path / "a.png")
    assert Image.open(tmp_path / "a.png").size == (1600, 600)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_a_sensor_is_drawn_with_rays_that_bend_at_ports():
    camera = Camera("pinhole", SIZE, (240, 240), (320, 240), ports=[(2, 3, 1.49)], medium_index=1.33)
    membrane = spherical_cap(12.0, 6.0, 20.0, grid=(9, 9))
    markers = Markers("dots", positions=membrane.rest[membrane.free_vertices].numpy())
    sensor = Sensor("cap", "mm", camera, membrane, Material("harmonic", 1.2), Cavity("liquid"), markers)
    side, space, image = sensor_figure(sensor).axes
    assert "[mm]" in side.get_xlabel() and "[mm]" in space.get_zlabel() and image.get_xlabel() == "u [px]"
    assert {"camera", "port", "viewing rays", "rest surface"} <= set(labels(side))
    rays = next(c for c in side.collections if c.get_segments() and len(c.get_segments()[0]) == 3).get_segments()
    for start, kink, end in rays:
        assert start == pytest.approx([0, 0]) and kink[1] == pytest.approx(5)
        before, after = np.array(kink) - start, np.array(end) - kink
        sines = [abs(step[0]) / np.linalg.norm(step) for step in (before, after)]
        assert sines[0] >= sines[1] - 1e-12
    assert max(abs(kink[0] / kink[1] - end[0] / end[1]) for _, kink, end in rays) > 0.05
    assert "markers (49)" in texts(space)
    rim = next(line for line in image.lines if "rim" in line.get_label()).get_xydata()
    expected = camera.point_to_pixel(membrane.rest[membrane.fixed]).numpy()
    assert np.allclose(np.unique(rim.round(6), axis=0), np.unique(expected.round(6), axis=0))


def test_figures_belong_to_no_window(mesh):
    assert view.figure(pressed(mesh), mesh).canvas.manager is None


def test_contacts_are_marked_where_they_are(mesh):
    frame = pressed(mesh)
    axes = Figure().add_subplot()
    view.draw_displacement(axes, frame, mesh)
    unmarked = len(axes.lines)
    frame["contact_points"][0] = frame["vertices"][DENT]
    axes = Figure().add_subplot()
    view.draw_displacement(axes, frame, mesh)
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    assert len(axes.lines) == unmarked + 1 and len(crosses) == 1
    np.testing.assert_allclose(crosses[0].get_xydata()[0], mesh.vertex_pixels[DENT])


def test_matplotlib_is_loaded_only_to_draw():
    code = (
        "import sys, torchmembrane.cli.main; sys.exit(int('matplotlib' in sys.modules or 'torchmembrane.plot' in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize("size", [(640, 480), (480, 480), (360, 640)])
def test_colour_bars_are_whole_and_below_their_axes_whatever_the_image_s_shape(monkeypatch, size):
    monkeypatch.setattr(sys.modules[__name__], "SIZE", size)
    mesh = cap_mesh(Camera("fisheye", size, (180, 180), (size[0] / 2, size[1] / 2)))
    frame = pressed(mesh)
    frame["traction"] = -np.abs(frame["displacement"].sum(-1, keepdims=True)) * mesh.rest_normals
    drawing = view.figure(frame, mesh)
    FigureCanvasAgg(drawing).draw()
    for axes in drawing.axes[2:4]:
        (bar,) = axes.child_axes
        assert bar.get_tightbbox().y0 >= 0 and bar.get_tightbbox().y1 < axes.xaxis.label.get_window_extent().y0


def boxes(drawing) -> dict[str, Bbox]:
    """Where the words of a figure lie: headline, titles, axes' labels, legends, colour bars, remarks."""
    canvas = FigureCanvasAgg(drawing)
    canvas.draw()
    renderer = canvas.get_renderer()
    found = {"headline": drawing._suptitle.get_window_extent(renderer)}
    for i, axes in enumerate(drawing.axes):
        remarks = {f"{k}": text for k, text in enumerate(axes.texts) if text.get_text()}
        parts = {"title": axes.title, "legend": axes.get_legend(), **remarks}
        found |= {f"{i} {name}": part.get_window_extent(renderer) for name, part in parts.items() if part is not None}
        found |= {f"{i} bar": bar.get_tightbbox(renderer) for bar in axes.child_axes}
        found |= {f"{i} {name}": getattr(axes, name).get_tightbbox(renderer) for name in ("xaxis", "yaxis") if axes.axison}
    return {name: box for name, box in found.items() if box is not None}


def overlap(a: Bbox, b: Bbox) -> float:
    """px, the less of the two directions."""
    return min(min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0))


SIZES = [(640, 480), (256, 256), (200, 900), (1200, 200), (64, 48), (1920, 1080), (4000, 3000)]


SHORT = ("press", "N", Status.OK)
LONG = ("a_recording_of_the_left_hand_2026-11-24_frame_000123", "relative", Status.HIDDEN)


@pytest.mark.parametrize(
    ("size", "name", "unit", "status"),
    [
        *(pytest.param(size, *LONG, marks=pytest.mark.full if size == SIZES[-1] else ()) for size in SIZES),
        *(pytest.param(size, *SHORT, marks=() if size == SIZES[0] else pytest.mark.full) for size in SIZES),
    ],
)
def test_no_words_are_clipped_or_on_one_another_whatever_the_image_s_shape(monkeypatch, size, name, unit, status):
    monkeypatch.setattr(sys.modules[__name__], "SIZE", size)
    mesh = cap_mesh(Camera("fisheye", size, (0.36 * min(size),) * 2, (size[0] / 2, size[1] / 2)), force_unit=unit)
    frame = pressed(mesh, flow=4 * size[0] / 640) | {"status": np.int32(status)}
    for traction in (0.0, 1.2345e-3):
        frame |= {"traction": -traction * mesh.rest_normals, "force": np.array([-0.0123, -10.1, -123.4])}
        drawing = view.figure(frame, mesh, np.zeros(size[::-1]), name)
        found = boxes(drawing)
        for part, box in found.items():
            assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= drawing.bbox.width and box.y1 <= drawing.bbox.height, part
        for (one, a), (other, b) in combinations(found.items(), 2):
            of_one_axes = "axis" in one and "axis" in other and one[0] == other[0]
            assert of_one_axes or overlap(a, b) < 3, (one, other)


@pytest.mark.parametrize("size", [(200, 900), (1200, 200), (4000, 3000)])
def test_no_words_of_a_sensor_s_figure_are_clipped(size):
    for height in (2.0, 12.0, 40.0):
        membrane = ellipsoid_cap((12.0, 12.0, height), 20.0, grid=(9, 9))
        markers = Markers("dots", positions=membrane.rest[membrane.free_vertices].numpy())
        camera = Camera("fisheye", size, (0.3 * min(size),) * 2, (size[0] / 2, size[1] / 2))
        drawing = sensor_figure(Sensor("a" * 40, "mm", camera, membrane, Material("harmonic", 1.2), Cavity("liquid"), markers))
        for part, box in boxes(drawing).items():
            assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= drawing.bbox.width and box.y1 <= drawing.bbox.height, part
