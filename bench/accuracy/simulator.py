"""How right and how fast the simulator is: closed forms, balance, independent cases, rendered dots, processor time.

python -m bench.accuracy.simulator [CASES] [--grid 65] [--json FILE]

CASES holds index.json, a list of cases with `case`, `folder` (its first word, up to "_", names the shape: `SHAPES`), `sensor`
and `truth` (files), `friction`, `slide`, `slide_dir`, and `indenters`, each a sphere (`R`), cylinder (`R`, `axis`) or plane
(`n`) with `touch_position` and `final_position`. The truths (npz) are another program's: `dots_nominal`, `dots_deformed`,
`probes_nominal`, `probes_deformed [*, 3]`, `force [3]`, `p`, `p0`. One thread; times are the process', not the wall's.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from bench.data.record import write
from torchmembrane import ElasticEnergy, MembraneError, Sensor, preset
from torchmembrane.presets import NAMES
from torchmembrane.sensor.factories import elastic_energy
from torchmembrane.simulate import Appearance, Cylinder, Plane, Simulator, Sphere, facing, press
from torchmembrane.simulate.dataset import Plan, random_frame, stroke_to
from torchmembrane.simulate.equilibrium import EquilibriumProblem, Liquid, Open
from torchmembrane.simulate.quasi_static import carried
from torchmembrane.surface.shapes import ellipsoid_cap, half_cylinder, heightfield, spherical_cap

PRESTRETCH, GRIDS = 1.3, (17, 33, 65)
SHAPES = {
    "dome3": lambda z, grid: spherical_cap(12, 9, z, grid),
    "dome15": lambda z, grid: spherical_cap(12, 9, z, grid),
    "finger": lambda z, grid: ellipsoid_cap((12, 9, 12), z, grid),
    "halfcyl": lambda z, grid: half_cylinder(10, 40, 80, z, grid),
}
FRICTION, DEPTH, BALL = 0.4, 3.0, 4.0
INK_ONLY = Appearance(ambient=1.0, vignetting=0.0, blur=0.0, exposure=1.0, outside=1.0)
DATA_SET = 6


def elasticity_of(membrane):
    return ElasticEnergy(membrane, "neo_hookean", PRESTRETCH)


def laplace(membrane, curvature: float) -> float:
    """Relative error of the pressure of a liquid under constant tension, p = T x curvature."""
    elasticity = elasticity_of(membrane)
    solution = EquilibriumProblem(membrane, elasticity, Liquid(float(membrane.rest_volume))).solve(membrane.rest, 0.1)
    return solution.pressure / float(elasticity.tension * curvature) - 1


def inflation(n: int) -> float:
    """Largest relative error of p = 2 mu (l^2 - 1 / (l^4 s^6)) / (s R), the whole cap stretched by s = 1 ... 1.5."""
    stretches, radius = np.linspace(1, 1.5, 6), 12.5
    exact = 2 * (PRESTRETCH**2 - 1 / (PRESTRETCH**4 * stretches**6)) / (stretches * radius)
    cap = spherical_cap(12, 9, radius - 9, (n, n))
    x, pressure, errors = cap.rest, exact[0], []
    for s, expected in zip(stretches, exact, strict=True):
        x = torch.where(cap.fixed[:, None], s * cap.rest, x)
        x, pressure, *_ = EquilibriumProblem(cap, elasticity_of(cap), Liquid(s**3 * float(cap.rest_volume))).solve(x, pressure)
        errors.append(abs(pressure / expected - 1))
    return max(errors)


def flat_bulge(n: int) -> float:
    """Relative error of a flat square's middle under little pressure, beside the Fourier series of T laplace w = -p."""
    side, pressure, odd = 20.0, 1e-4, np.arange(1, 400, 2)
    sign = np.sin(odd * np.pi / 2) / odd
    series = 16 * side**2 / np.pi**4 * (sign[:, None] * sign / (odd[:, None] ** 2 + odd**2)).sum()
    along = np.linspace(-side / 2, side / 2, n)
    flat = heightfield(along, along, np.full((n, n), 10.0))
    elasticity = elasticity_of(flat)
    x = EquilibriumProblem(flat, elasticity, Open()).solve(flat.rest, pressure).vertices
    return (float(x[n * n // 2, 2]) - 10) * float(elasticity.tension) / (pressure * series) - 1


CLOSED_FORMS = {
    "spherical cap, p = 2 T / R": lambda n: laplace(spherical_cap(12, 9, 15, (n, n)), 2 / 12.5),
    "half cylinder, p = T / R": lambda n: laplace(half_cylinder(10, 40, 80, 3, (n, n)), 1 / 10),
    "neo-Hookean sphere inflated to 1.5": inflation,
    "flat square, Fourier series": flat_bulge,
}


def closed_forms() -> list[dict]:
    rows = []
    for name, error in CLOSED_FORMS.items():
        errors = np.array([abs(error(n)) for n in GRIDS])
        rates = np.log2(errors[:-1] / errors[1:])
        rows.append(dict(name=name, grids=GRIDS, errors=errors.tolist(), rates=rates.tolist()))
        listed = ", ".join(f"{e:.1e} at {n}" for n, e in zip(GRIDS, errors, strict=True))
        print(f"{name}: relative error {listed}; rates {rates.round(2).tolist()}", flush=True)
    return rows


def processor_seconds(function) -> tuple[float, object]:
    start = time.process_time()
    result = function()
    return time.process_time() - start, result


def straight(membrane, depth=DEPTH):
    """The path of a ball that is pressed straight in."""
    ball = Sphere(BALL).touching(membrane, (0, 0, -1))
    return [[ball, ball.moved((0, 0, -depth))]]


def presses_of_a_dome() -> list[dict]:
    """Balance of a press of 3 mm on a dome of 33 x 33, and its time."""
    dome, rows = spherical_cap(12, 9, 3, (33, 33)), []
    elasticity = elasticity_of(dome)
    press(dome, elasticity, straight(dome, 0.5))  # warm-up
    for friction in (0.0, FRICTION):
        seconds, state = processor_seconds(lambda mu=friction: press(dome, elasticity, straight(dome), friction=mu))
        row = {name: getattr(state, name) for name in ("imbalance", "volume_error", "penetration")}
        row |= dict(friction=friction, steps=state.iterations, seconds=seconds)
        rows.append(row)
        print(
            "press of 3 mm, friction {friction}: unbalanced force {imbalance:.0e}, volume off by {volume_error:.0e}, "
            "penetration {penetration:.0e} mm, {steps} Newton steps, {seconds:.2f} s".format(**row),
            flush=True,
        )
    return rows


def case_paths(case: dict) -> list[list]:
    """The poses of a case's indenters: first touch, where the slide begins if there is one, end."""
    bodies = {
        "sphere": lambda i: Sphere(i["R"]),
        "cylinder": lambda i: Cylinder(i["R"], axis=i["axis"]),
        "plane": lambda i: Plane(rotation=facing(i["n"])),
    }
    slide, paths = case["slide"] * np.array(case["slide_dir"]), []
    for indenter in case["indenters"]:
        body, end = bodies[indenter["kind"]](indenter), np.array(indenter["final_position"])
        between = [end - slide] if case["slide"] else []
        paths.append([body.at(place) for place in (indenter["touch_position"], *between, end)])
    return paths


def agreement(root: Path, case: dict, n: int) -> dict:
    """Differences from a case's truth, in %: of the surface over its rms displacement, of force and pressure change."""
    sensor, truth = Sensor.from_file(root / case["sensor"]), np.load(root / case["truth"])
    base_z = float(sensor.membrane.rest[sensor.membrane.fixed, 2].min())
    membrane = SHAPES[case["folder"].partition("_")[0]](base_z, (n, n))
    elasticity = elastic_energy(sensor, membrane)
    seconds, state = processor_seconds(lambda: press(membrane, elasticity, case_paths(case), friction=case["friction"]))
    row = dict(case=case["case"], folder=case["folder"], friction=case["friction"], seconds=seconds)
    for points in ("dots", "probes"):
        X, x = truth[f"{points}_nominal"], truth[f"{points}_deformed"]
        off = carried(state.vertices, membrane, X).numpy() - x
        row[points] = 100 * float(np.linalg.norm(off) / np.linalg.norm(x - X))
    expected, force, change = truth["force"], state.force.numpy(), float(truth["p"] - truth["p0"])
    size = np.linalg.norm(expected)
    row["force"] = 100 * float(np.linalg.norm(force - expected) / size)
    row["force_size"] = 100 * float(np.linalg.norm(force) / size - 1)
    row["pressure"] = 100 * ((state.pressure - state.rest_pressure) / change - 1)
    return row


def agreements(root: Path, n: int) -> list[dict]:
    rows = []
    for case in json.loads((root / "index.json").read_text()):
        try:
            rows.append(agreement(root, case, n))
        except MembraneError as error:
            print(f"{case['case']}: failed, {error}", flush=True)
            rows.append(dict(case=case["case"], folder=case["folder"], failed=str(error)))
            continue
        print(
            "{case} {folder:15s} friction {friction:.1f}: dots {dots:.2f} %, probes {probes:.2f} %, force {force:.2f} %, "
            "its size {force_size:+.2f} %, pressure change {pressure:+.2f} %, {seconds:.1f} s".format(**rows[-1]),
            flush=True,
        )
    made = [row for row in rows if "failed" not in row]
    worst = {key: max(abs(row[key]) for row in made) for key in ("dots", "probes", "force", "force_size", "pressure")}
    print(f"{len(made)} of {len(rows)} cases on {n} x {n}, at worst: " + ", ".join(f"{k} {v:.2f} %" for k, v in worst.items()))
    return rows


def outlines(simulator: Simulator, vertices) -> np.ndarray:
    """The dots' outlines in the image, `[D, 128, 2]`: circles in the tangent planes, dropped on the surface, moved with it."""
    renderer, dots, surface = simulator.renderer, simulator.pattern, simulator.renderer.surface
    at = surface.closest_points(dots.positions)
    normals = (surface.rest_normals.numpy()[at.vertices] * at.weights[..., None]).sum(1)
    frames = np.stack([facing(n).numpy() for n in normals])
    angle = np.linspace(0, 2 * np.pi, 128, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    rings = dots.positions[:, None] + dots.radii[:, None, None] * np.einsum("dij,aj->dai", frames, circle)
    on = surface.closest_points(rings.reshape(-1, 3))
    moved = (renderer.fine_vertices(vertices).numpy()[on.vertices] * on.weights[..., None]).sum(1)
    return renderer.camera.point_to_pixel(torch.from_numpy(moved)).numpy().reshape(*rings.shape[:2], 2)


def polygon_centroid(p: np.ndarray) -> np.ndarray:
    q = np.roll(p, -1, 0)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    return ((p + q) * cross[:, None]).sum(0) / (3 * cross.sum())


def ink_centroid(ink: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Return the centroid `u, v` of the ink in the bounding box of `outline [A, 2]`, enlarged by a pixel on each side, px."""
    (u0, v0), (u1, v1) = np.floor(outline.min(0)).astype(int) - 1, np.ceil(outline.max(0)).astype(int) + 2
    v, u = np.mgrid[v0:v1, u0:u1]
    w = ink[v0:v1, u0:u1]
    return np.array([(w * u).sum(), (w * v).sum()]) / w.sum()


def dot_errors(simulator: Simulator, vertices) -> np.ndarray:
    """Distances in px of the rendered dots' centroids from their outlines', of those that are seen whole."""
    with torch.no_grad():
        ink, visible = 1 - simulator.renderer(vertices).numpy(), simulator.renderer.dots(vertices).visible.numpy()
        rings = outlines(simulator, vertices)
    width, height = simulator.sensor.camera.image_size
    whole = visible & (rings > 1).all((1, 2)) & (rings < [width - 3, height - 3]).all((1, 2))
    return np.array([np.linalg.norm(ink_centroid(ink, ring) - polygon_centroid(ring)) for ring in rings[whole]])


def rendered_dots() -> list[dict]:
    rows = []
    for name in NAMES:
        simulator = Simulator(preset(name), appearance=INK_ONLY)
        membrane, depth = simulator.membrane, 0.05 * simulator.membrane.size
        middle = membrane.rest[membrane.fixed].mean(0).numpy()
        start, travel, *_ = stroke_to(simulator, Sphere(2.5 * depth), middle, (-0.2, 0.1, -1), depth)
        state = press(membrane, simulator.elasticity, [[start, start.moved(depth * travel)]], **simulator.cavity)
        for surface, vertices in (("rest", membrane.rest), ("pressed", state.vertices)):
            errors = dot_errors(simulator, vertices)
            row = dict(preset=name, surface=surface, dots=len(errors), of=len(simulator.pattern.positions))
            row |= dict(rms=float((errors**2).mean() ** 0.5), worst=float(errors.max()))
            rows.append(row)
            print(
                "{preset}, {surface}: centroids of {dots} of {of} dots off by {rms:.4f} px rms, {worst:.3f} px at worst".format(
                    **row
                ),
                flush=True,
            )
    return rows


def rates() -> dict:
    """Time of an image of 640 x 480, and of a frame of a data set with all that it needs, redrawn presses included."""
    simulator = Simulator(preset("fingertip"))
    rng = np.random.default_rng(0)
    simulator.image(simulator.membrane.rest, rng)
    image = min(processor_seconds(lambda: simulator.image(simulator.membrane.rest, rng))[0] for _ in range(3))
    print(f"image of 640 x 480: {image:.2f} s")
    seconds = dict(image=image)
    for friction in (0.0, FRICTION):
        plan = Plan(friction=friction)
        total, _ = processor_seconds(lambda plan=plan: [random_frame(simulator, plan, k) for k in range(DATA_SET)])
        seconds[f"frame of a data set, friction {friction}"] = total / DATA_SET
        print(f"data set, friction {friction}: {total / DATA_SET:.2f} s a frame", flush=True)
    return seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, nargs="?", help="folder with index.json (default: no comparison)")
    parser.add_argument("--grid", type=int, default=65, help="of the cases' presses (default: %(default)s)")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    results = dict(closed_forms=closed_forms(), presses=presses_of_a_dome(), dots=rendered_dots(), seconds=rates())
    if args.cases:
        results |= dict(grid=args.grid, agreement=agreements(args.cases, args.grid))
    write(args.json, results)


if __name__ == "__main__":
    main()
