"""Inflated sheets agree with closed forms, meshes and solvers."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from torchmembrane import MembraneError, Sensor
from torchmembrane.cli.main import main
from torchmembrane.forming import outline_grid as outline_grid_module
from torchmembrane.forming.formed import LINES, SheetMaterial, film, formed_surface
from torchmembrane.forming.outline import ellipse, outline_of, rectangle
from torchmembrane.forming.sheet_energy import SheetEnergy
from torchmembrane.mechanics.cavity import rest_balance
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.presets.blown_up import Stated, _distance, blown_up
from torchmembrane.sensor.factories import elastic_energy
from torchmembrane.sensor.inflated import InflatedSurface
from torchmembrane.surface.membrane import Membrane
from torchmembrane.surface.shapes import spherical_cap

ANGLE = 2 * np.pi * np.arange(360) / 360
DENSITIES = {  # energy per area of the sheet, of principal stretches a, b over the sheet that is stretched by c; modulus 1
    "harmonic": lambda a, b, c: c**2 * (a**2 + b**2) / 2,
    "neo_hookean": lambda a, b, c: (c**2 * (a**2 + b**2) + (c**2 * a * b) ** -2) / 2,
    "mooney_rivlin": lambda a, b, c: (
        (c**2 * (a**2 + b**2) + (c**2 * a * b) ** -2) / 2.2 + 0.1 * ((c**2 * a * b) ** 2 + (a**-2 + b**-2) / c**2) / 2.2
    ),
}


SHORTLY = "rectangle", "triangle", "bean"  # of the rims


def full(value):
    return pytest.param(value, marks=pytest.mark.full)


def around(radius):
    return np.stack([radius * np.cos(ANGLE), radius * np.sin(ANGLE)], -1)


def smoothed(corners, radius):
    """A polygon whose corners are rounded by a moving average along it."""
    closed = np.array([*corners, corners[0]], float)
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    even = np.stack([np.interp(np.arange(720) / 720 * at[-1], at, c) for c in closed.T], -1)
    width = round(radius / at[-1] * 720)
    return sum(np.roll(even, k, 0) for k in range(-width, width + 1)) / (2 * width + 1)


RIMS = {
    "circle": ellipse((40.0, 40.0)),
    "ellipse": ellipse((50.0, 36.0)),
    "rectangle": rectangle((50.0, 36.0), 4.0),
    "sharp rectangle": rectangle((50.0, 36.0)),
    "triangle": smoothed([(-25, -18), (25, -18), (0, 25)], 4.0),
    "bean": around(18 + 7 * np.cos(2 * ANGLE) + 2 * np.cos(3 * ANGLE)),
    "L": smoothed([(-20, -20), (20, -20), (20, 2), (2, 2), (2, 20), (-20, 20)], 3.0),
}


def raised(rim, z=40.0):
    return np.insert(rim, 2, z, axis=1)


def formed(rim, model="neo_hookean", prestretch=1.1, **goal):
    c2 = 0.1 if model == "mooney_rivlin" else 0.0
    return formed_surface(raised(RIMS[rim]) if isinstance(rim, str) else rim, SheetMaterial(model, prestretch, c2), **goal)


@pytest.mark.parametrize("name", [name if name in SHORTLY else full(name) for name in RIMS])
def test_every_cell_of_the_grid_within_a_rim_has_an_area_and_the_border_lies_on_the_rim(name):
    found = formed(name, height=5.0)
    Membrane(found.sheet), Membrane(found.vertices)  # refuse folds
    assert found.cells.angle > 2 and found.height == pytest.approx(5.0)
    rim = outline_of(raised(RIMS[name]))
    border = found.cells.vertices[~np.isnan(found.cells.places)]
    dense = rim.sampled(20000)[:, :2]
    assert max(np.linalg.norm(dense - b, axis=1).min() for b in border) < 0.01
    x, y = found.cells.vertices[..., 0], found.cells.vertices[..., 1]
    area = 0.5 * abs(
        ((x[1:, 1:] - x[:-1, :-1]) * (y[:-1, 1:] - y[1:, :-1]) - (x[:-1, 1:] - x[1:, :-1]) * (y[1:, 1:] - y[:-1, :-1])).sum()
    )
    p, q = rim.points, np.roll(rim.points, -1, 0)
    assert area == pytest.approx(0.5 * (p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]).sum(), rel=5e-3)


@pytest.mark.parametrize("model", [full("harmonic"), "neo_hookean", "mooney_rivlin"])
def test_a_round_sheet_is_that_of_an_axisymmetric_solver(model):
    """One unknown profile, energy in principal stretches, minimised at the pressure found: it is as high and holds as much."""
    found = formed("circle", model, prestretch=1.15, height=9.0)
    s = torch.linspace(0, 20, 41, dtype=torch.float64)

    def potential(free):
        r, z = torch.cat([s[:1], free[:39], s[-1:]]), torch.cat([free[39:], s[:1]])
        a, b = torch.hypot(r.diff(), z.diff()) / s.diff(), (r[1:] + r[:-1]) / (s[1:] + s[:-1])
        volume = (torch.pi / 3 * (r[1:] ** 2 + r[1:] * r[:-1] + r[:-1] ** 2) * -z.diff()).sum()
        return (torch.pi * (s[1:] ** 2 - s[:-1] ** 2) * DENSITIES[model](a, b, 1.15)).sum() - found.pressure * volume

    free, size = torch.cat([s[1:-1], 9 * (1 - (s[:-1] / 20) ** 2)]), 1.0
    while size > 1e-9:
        step = -torch.linalg.solve(torch.func.hessian(potential)(free), torch.func.grad(potential)(free))
        size = float(step.abs().max())
        free = free + step * min(1.0, 0.5 / size)
    assert float(free[39]) == pytest.approx(9.0, rel=4e-3)


@pytest.mark.parametrize("prestretch", [1.0, 1.3])
def test_at_the_pole_the_tension_is_half_the_pressure_times_the_radius_and_that_of_equal_stretches(prestretch):
    """`T = p R / 2`, and `T = mu t (l^2 - l^-4)`, t the thickness at the pole: that of the sheet over `(l / prestretch)^2`."""
    found = formed("circle", prestretch=prestretch, height=8.0)
    x, y, z = (found.vertices[LINES // 2 - 5 : LINES // 2 + 6, LINES // 2 - 5 : LINES // 2 + 6].reshape(-1, 3) - [0, 0, 40.0]).T
    r2 = x**2 + y**2
    radius = -0.5 / np.linalg.lstsq(np.stack([np.ones_like(r2), r2, r2**2], -1), z, rcond=None)[0][1]
    membrane = Membrane(found.vertices)
    energy = SheetEnergy(membrane, torch.from_numpy(found.sheet.reshape(-1, 3).copy()), "neo_hookean", prestretch)
    cell = (LINES // 2) * (LINES - 1) + LINES // 2
    stretch = prestretch * float(energy.principal_stretches(membrane.rest)[2 * cell].mean())
    tension = (prestretch / stretch) ** 2 * (stretch**2 - stretch**-4)
    assert found.pressure * radius / 2 == pytest.approx(tension, rel=0.01)


def test_an_unstructured_mesh_with_another_solver_is_blown_up_as_high():
    found = formed("rectangle", prestretch=1.07, height=6.0)
    rim = outline_of(raised(RIMS["rectangle"])).sampled(160)[:, :2]
    i, j = np.meshgrid(np.arange(-20, 21), np.arange(-20, 21))
    inner = np.stack([i + 0.5 * (j % 2), j * 0.866], -1).reshape(-1, 2) * 1.3
    far = (np.abs(inner) < [24.3, 17.3]).all(1) & (np.linalg.norm((np.abs(inner) - [21, 14]).clip(0), axis=1) < 3.3)
    flat = np.concatenate([rim, inner[far]])
    triangles = torch.from_numpy(Delaunay(flat).simplices.astype(np.int64))
    X = torch.from_numpy(flat)

    def edges(x):
        p = x[triangles]
        return torch.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]], -1)

    inverse, area = torch.linalg.inv(edges(X)), torch.linalg.det(edges(X)).abs() / 2
    kept = area > 1e-6 * area.max()
    inverse, area, triangles = inverse[kept], area[kept], triangles[kept]
    sign = torch.linalg.det(edges(X)).sign()

    def value(free):
        unknown = torch.from_numpy(free).requires_grad_()
        x = torch.cat([torch.nn.functional.pad(X[:160], (0, 1)), unknown.reshape(-1, 3)])
        F = edges(x) @ inverse
        C = F.mT @ F
        first, det = C.diagonal(dim1=1, dim2=2).sum(1), torch.linalg.det(C)
        energy = (area * (1.07**2 * first + 1 / (1.07**4 * det)) / 2).sum()
        volume = (sign * torch.linalg.det(x[triangles])).sum() / 6
        total = energy - found.pressure * volume
        return float(total.detach()), torch.autograd.grad(total, unknown)[0].numpy()

    a, b = np.abs(flat[160:]).T / np.array([[25], [18]])
    start = np.column_stack([flat[160:], 6 * (1 - a**2) * (1 - b**2)])
    best = minimize(value, start.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 900, "maxcor": 40})
    assert best.x.reshape(-1, 3)[:, 2].max() == pytest.approx(6.0, rel=0.01)


def test_blown_up_by_the_pressure_of_a_height_it_has_that_height():
    found = formed("bean", height=5.0)
    assert formed("bean", pressure=found.pressure).height == pytest.approx(5.0, rel=1e-6)


def test_a_turned_or_larger_rim_has_the_turned_or_larger_surface():
    found, turn = formed("bean", height=5.0), Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    turned = formed(raised(RIMS["bean"]) @ turn.T, height=5.0)
    assert np.abs(turned.vertices - found.vertices @ turn.T).max() < 0.02  # the grid may slide within the surface
    assert turned.pressure == pytest.approx(found.pressure, rel=1e-3)
    larger = formed(3 * raised(RIMS["bean"]), height=15.0)
    assert 3 * larger.pressure == pytest.approx(found.pressure, rel=1e-4)


def test_without_pressure_a_bent_rim_holds_a_minimal_surface():
    """Scherk's surface `z = log(cos x / cos y)`: the film within its rim is the surface; blown up, it stands out from it."""
    rim = outline_of(raised(rectangle((2.2, 2.2)), 30.0)).sampled(800)
    rim[:, 2] = 30 + np.log(np.cos(rim[:, 0]) / np.cos(rim[:, 1]))
    found = formed_surface(rim, SheetMaterial("neo_hookean", 1.2), height=1.2)
    x, y, z = found.sheet.reshape(-1, 3).T
    assert np.abs(z - 30 - np.log(np.cos(x) / np.cos(y))).max() < 2e-3
    assert found.vertices[LINES // 2, LINES // 2, 2] > found.sheet[LINES // 2, LINES // 2, 2] + 0.5


@pytest.mark.parametrize("model", DENSITIES)
def test_a_membrane_that_is_its_own_sheet_has_the_energy_of_a_uniform_prestretch(model):
    cap = spherical_cap(12.0, 7.0, 15.0, (9, 9))
    numbers = (model, 1.2, 0.7, 0.1 if model == "mooney_rivlin" else 0.0)
    own, uniform = SheetEnergy(cap, cap.rest, *numbers), ElasticEnergy(cap, *numbers)
    u = 0.3 * torch.randn(81, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    for name in ("gradient_of_displaced", "one_ring"):
        for one, other in zip(getattr(own, name)(u[None]), getattr(uniform, name)(u[None]), strict=True):
            torch.testing.assert_close(one, other)
    assert float(own.tension) == pytest.approx(float(uniform.tension))


def test_the_forces_of_a_sheet_are_the_derivative_of_its_energy():
    found = formed("triangle", height=5.0)
    membrane, sheet = Membrane(found.vertices[::4, ::4]), torch.from_numpy(found.sheet[::4, ::4].reshape(-1, 3).copy())
    energy = SheetEnergy(membrane, sheet, "neo_hookean", 1.1, 0.3)
    u = 0.1 * torch.randn(81, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    x = (membrane.rest + u).requires_grad_()
    (forces,) = torch.autograd.grad(energy.energy(x), x)
    inner = membrane.free_vertices
    torch.testing.assert_close(energy.gradient_of_displaced(u)[inner], forces[inner])
    fine = SheetEnergy(Membrane(found.vertices), torch.from_numpy(found.sheet.reshape(-1, 3).copy()), "neo_hookean", 1.1, 0.3)
    coarse = fine.for_membrane(Membrane(found.vertices[::2, ::2])).for_membrane(membrane)
    torch.testing.assert_close(coarse.gradient(x.detach())[inner], forces[inner])


@pytest.mark.parametrize(
    ("rim", "said"),
    [
        ([[0, 0, 9], [1, 1, 9], [1, 0, 9], [0, 1, 9]], "hardly any area"),
        ([[0, 0, 9], [4, 0, 9], [4, 3, 9], [1, -1, 9], [0, 3, 9]], "crosses itself"),
        ([[0, 0, 9], [4, 0, 9], [4, 0, 9], [4, 3, 9]], "coincide"),
        ([[0, 0, 9], [4, 0, 9]], "at least 3"),
        ([[0, 0, 9], [4, math.nan, 9], [3, 3, 3]], "finite"),
    ],
)
def test_a_rim_that_is_none_is_refused(rim, said):
    with pytest.raises(MembraneError, match=said):
        outline_of(rim)


def test_heights_and_pressures_without_an_equilibrium_are_refused():
    with pytest.raises(MembraneError, match="expected more than 0"):
        formed("circle", height=-1.0)
    with pytest.raises(MembraneError, match="holds at most"):
        formed("circle", pressure=5.0)


WINDOW = "--shape rectangle --size 50,36 --corner 4 --distance 40 --image-size 320,240 --focal 250".split()


def drafted(path, *more):
    assert main(["init", str(path), "--force", *WINDOW, *more]) == 0
    return Sensor.from_file(path)


def test_a_drafted_window_is_at_rest_under_the_pressure_stated_and_is_written_as_it_was_read(tmp_path, capsys):
    sensor = drafted(tmp_path / "a.toml", *"--height 6mm --overpressure 12hPa --prestretch 1.07 --thickness 0.2".split())
    assert "shear modulus" in capsys.readouterr().out and sensor.force_unit == "N"
    p0, load = rest_balance(sensor.membrane, elastic_energy(sensor, sensor.membrane))
    assert float(p0) == pytest.approx(12e-4, rel=1e-6) and float(load.norm(dim=1).max()) < 1e-6 * float(p0) * 1800
    again = Sensor.from_file(sensor.to_file(tmp_path / "b.toml"))
    assert again.fingerprint == sensor.fingerprint and torch.equal(again.membrane.rest, sensor.membrane.rest)
    by_pressure = drafted(
        tmp_path / "c.toml",
        *"--overpressure 12hPa --prestretch 1.07 --thickness 0.2".split(),
        "--shear-modulus",
        str(sensor.material.shear_modulus),
    )
    assert by_pressure.surface.formed.height == pytest.approx(6.0, rel=1e-4)


def test_a_rim_given_by_points_is_the_rim_given_by_numbers(tmp_path):
    by_numbers = drafted(tmp_path / "a.toml", "--height", "6")
    rim = tmp_path / "rim.csv"
    rim.write_text("x,y\n" + "\n".join(f"{x!r},{y!r}" for x, y in RIMS["rectangle"].tolist()))
    numbers = "--height 0.6cm --distance 40 --image-size 320,240 --focal 250".split()
    assert main(["init", str(tmp_path / "b.toml"), "--outline", str(rim), *numbers]) == 0
    by_points = Sensor.from_file(tmp_path / "b.toml")
    torch.testing.assert_close(by_points.membrane.rest, by_numbers.membrane.rest)
    assert isinstance(by_points.surface, InflatedSurface) and (tmp_path / "b_rim.csv").exists()


def test_another_prestretch_gives_another_rest_shape_and_another_modulus_the_same():
    found = blown_up({"outline": "ellipse", "size": [50.0, 36.0], "base_z": 40.0}, "mm", Stated(8.0, 20.0, 1.05, None, 0.2))
    stretched = found.surface.made_of(replace(found.material, prestretch=1.5), "mm")
    stiffer = found.surface.made_of(replace(found.material, shear_modulus=9.0), "mm")
    X, Y, Z = (surface.membrane((17, 17)).rest for surface in (found.surface, stretched, stiffer))
    assert torch.equal(X, Z) and 0.02 < float((X - Y).norm(dim=1).max()) < 1.0


def test_of_four_numbers_of_a_sheet_three_give_the_fourth_and_four_are_compared():
    rim = {"outline": "rectangle", "size": [50.0, 36.0], "corner": 4.0, "base_z": 40.0}
    found = blown_up(rim, "mm", Stated(6.0, 12.0, 1.07, None, 0.2))
    modulus = found.material.shear_modulus
    assert blown_up(rim, "mm", Stated(6.0, 12.0, None, modulus, 0.2)).material.prestretch == pytest.approx(1.07, rel=1e-3)
    assert blown_up(rim, "mm", Stated(6.0, None, 1.07, modulus, 0.2)).overpressure == pytest.approx(12.0, rel=1e-3)
    assert not [s for s in blown_up(rim, "mm", Stated(6.0, 12.0, 1.07, modulus, 0.2)).said if "disagree" in s]
    (said,) = [s for s in blown_up(rim, "mm", Stated(6.0, 15.0, 1.07, modulus, 0.2)).said if "disagree" in s]
    assert "holds 12 hPa" in said and "stated is 15 hPa" in said
    with pytest.raises(MembraneError, match="contradict"):
        blown_up(rim, "mm", Stated(6.0, 1.0, None, modulus, 0.2))


def test_a_press_on_a_drafted_window_is_found_with_its_force(tmp_path):
    drafted(tmp_path / "a.toml", *"--height 6 --overpressure 12hPa --prestretch 1.07 --thickness 0.2".split())
    press = "--indenter sphere --radius 8 --depth 3 --noise 40 --out".split()
    assert main(["simulate", str(tmp_path / "a.toml"), *press, str(tmp_path / "press")]) == 0
    truth = np.load(tmp_path / "press" / "press_truth.npz")
    results = tmp_path / "results"
    assert (
        main(["reconstruct", str(tmp_path / "press/sensor.toml"), str(tmp_path / "press/press.png"), "--out", str(results)])
        == 0
    )
    (row,) = csv.DictReader((results / "summary.csv").open())
    force = np.array([float(row[f"force_{c}"]) for c in "xyz"])
    assert row["status_text"] == "ok" and np.linalg.norm(force - truth["force"]) < 0.1 * np.linalg.norm(truth["force"])


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_a_sheet_is_the_same_in_every_unit_of_length(unit):
    """In a rim of 32 points, in whose corners of the grid many choices are equally good."""
    turns = np.arange(32) * np.pi / 16
    rim = np.stack([8 * np.cos(turns), 8 * np.sin(turns), np.full(32, 14.0)], 1)
    one, other = (
        formed_surface(rim * scale, SheetMaterial("neo_hookean", 1.05), height=4 * scale, lines=17) for scale in (1, unit)
    )
    np.testing.assert_allclose(other.vertices / unit, one.vertices, atol=1e-9)
    assert other.pressure * unit == pytest.approx(one.pressure, rel=1e-9)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_a_rest_surface_is_the_same_without_gradients(mode):
    rim = np.insert(ellipse((41.0, 30.0)), 2, 30.0, axis=1)
    with mode():
        found = film(rim, 9).vertices
    outline_grid_module._outline_grid.cache_clear()
    np.testing.assert_array_equal(found, film(rim, 9).vertices)


def test_a_dot_keeps_clear_of_the_sides_of_a_rim_not_of_the_lines_through_them():
    """An L: in its corner the lines through the notch's sides run across the membrane."""
    rim = np.array([[0.0, 0], [6, 0], [6, 2], [2, 2], [2, 6], [0, 6]])
    share = np.linspace(0, 1, 4001)[:, None]
    sides = np.concatenate([a + share * (b - a) for a, b in zip(rim, np.roll(rim, -1, 0), strict=True)])
    points = np.random.default_rng(0).uniform(0, 6, (200, 2))
    expected = np.linalg.norm(points[:, None] - sides, axis=-1).min(1)
    np.testing.assert_allclose(_distance(rim, points), expected, atol=2e-3)


def test_an_outline_s_frame_leads_back_to_its_points():
    """An irregular tilted polygon with more points on one side: its origin is the middle of its area."""
    rng = np.random.default_rng(0)
    angle = np.sort(np.concatenate([rng.uniform(0, 2, 12), np.linspace(2, 6, 7)]))
    flat = np.stack([9 * np.cos(angle), 6 * np.sin(angle), rng.uniform(-0.2, 0.2, 19)], -1)
    X = flat @ Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix().T + [3.0, -2.0, 40.0]
    outline = outline_of(X)
    np.testing.assert_allclose(outline.camera_frame(np.column_stack([outline.points, outline.heights])), X, atol=1e-12)
    p, q = outline.points, np.roll(outline.points, -1, 0)
    cross = p[:, :1] * q[:, 1:] - p[:, 1:] * q[:, :1]
    np.testing.assert_allclose(((p + q) * cross).sum(0), 0, atol=1e-9)


def test_samples_of_a_rim_are_at_equal_steps_once_around():
    samples = outline_of(raised(ellipse((40.0, 40.0)))).sampled(24)
    steps = np.linalg.norm(np.roll(samples, -1, 0) - samples, axis=1)
    np.testing.assert_allclose(steps, 40 * np.sin(np.pi / 24), rtol=1e-3)
