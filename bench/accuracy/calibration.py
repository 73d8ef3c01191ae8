"""How well calibration recovers a simulated truth, from noisy rendered images.

python -m bench.accuracy.calibration [PART ...] [--seeds 3] [--json FILE] [--figures docs/calibration]

Parts: lens ports rest effect views depth layout material gauge.
Sensors of this package are seen by the simulator with noise 40 dB below white; the first guess is off. Printed: error, reported
standard deviation, and the largest error over its deviation; for `effect` the error of the surface at the dots before and after
the pose was calibrated.
"""

import argparse
import itertools
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bench.data.record import write
from torchmembrane import Camera, Markers, MembraneError, Reconstructor, Surface, preset
from torchmembrane.calibrate import (
    Checkerboard,
    DotBoard,
    KnownPressures,
    Views,
    find_target,
    layout_for_pixels,
    lens_from_views,
    material_from_images,
    pixel_lattice,
    ports_from_views,
    rest_from_depth,
    rest_from_image,
    rest_from_views,
)
from torchmembrane.calibrate.report import Report
from torchmembrane.calibrate.surface import fine_surface, surface_projection
from torchmembrane.files.images import to_grey
from torchmembrane.markers.dots.pattern import find_dots
from torchmembrane.plot.calibration import fit_figure, layout_figure, surface_figure
from torchmembrane.plot.files import save
from torchmembrane.simulate import Appearance, Plane, Simulator, Sphere
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.target_renderer import TargetRenderer

NOISE_LEVEL = 40.0
LENSES = {
    "pinhole": ((265.0, 266.0), (322.4, 237.0), (-0.05, 0.01, 0.0005, -0.0003, 0.0)),
    "fisheye": ((180.0, 180.5), (321.5, 238.2), (-0.012, 0.002, 0.0, 0.0)),
}
PORT = {"port_distance": 4.0, "port_thickness": 3.0, "port_index": 1.49, "medium_index": 1.33}
GUESS = {"port_distance": 4.3, "port_thickness": 2.8, "port_index": 1.53, "medium_index": 1.36}
TILT = Rotation.from_rotvec(np.deg2rad([0.8, 0.6, 0.0]))  # 1 degree
OFFSET = np.array([0.0, 0.0, 0.3])


def lens(seeds, figures):
    board = Checkerboard(11, 8, 2.5)
    for model, truth in LENSES.items():
        photograph = TargetRenderer.for_camera(Camera(model, (640, 480), *truth))
        for seed in range(seeds):
            pixels = poses_seen(photograph, board, 12, (14, 26), 0.35, np.random.default_rng(seed))
            guess = Camera(model, (640, 480), (250, 250), (320, 240))
            found = lens_from_views(guess, board, Views(pixels, np.zeros(len(pixels), bool)))
            expected = np.concatenate(truth)
            yield row(f"lens, {model}", seed, found.names, found.fit, expected)
        title, start = (
            f"{model}, {len(pixels)} images of a checkerboard",
            [*guess.focal, *guess.centre, *np.zeros(len(truth[2]))],
        )
        draw(
            figures,
            f"lens_{model}",
            Report.from_fit(title, found.names, found.names, start, found.fit, pixels, found.residuals),
        )


def ports(seeds, figures):
    board = DotBoard(17, 13, 2.0)
    for model in LENSES:
        for seed in range(seeds):
            rng, sets = np.random.default_rng(seed), []
            for air in (True, False):
                sets.append(poses_seen(TargetRenderer.for_camera(behind_port(model, PORT, air)), board, 6, (14, 22), 0.1, rng))
            pixels, filled = np.concatenate(sets), np.arange(12) >= 6
            for label, chosen in (("air", ~filled), ("medium", filled), ("both", filled | True)):
                views = Views(pixels[chosen], filled[chosen])
                found = ports_from_views(behind_port(model, GUESS), board, views)
                expected = [PORT[name] for name in found.names]
                yield row(f"ports, {model}, {label}", seed, found.names, found.fit, expected)
                if seed == seeds - 1:
                    start = [GUESS[name] for name in found.names]
                    title = f"{model} through a port, images in {label.replace('both', 'air and medium')}"
                    report = Report.from_fit(title, found.names, found.names, start, found.fit, pixels[chosen], found.residuals)
                    draw(figures, f"ports_{model}_{label}", report)


def behind_port(lens_model: str, port: dict[str, float], air: bool = False) -> Camera:
    """A camera of `LENSES` behind a flat port, in air or in the medium."""
    layer = (port["port_distance"], port["port_thickness"], port["port_index"])
    return Camera(lens_model, (640, 480), *LENSES[lens_model], [layer], 1.0 if air else port["medium_index"])


def rest(seeds, figures):
    for name in ("fingertip", "half_cylinder", "bubble"):
        design = preset(name)
        for seed in range(seeds):
            truth = posed(design, TILT, OFFSET)
            image = rest_image(truth, seed)
            found = rest_from_image(bare(design), image)
            record = row(f"rest, {name}", seed, found.names, found.fit, [0.8, 0.6, 0.0, *OFFSET])
            before, after = (rms(s.markers.positions - truth.markers.positions) for s in (design, found.sensor))
            yield record | dict(dots_before=before, dots_after=after)
        title, start = f"{name}: rest surface from one image", np.zeros(6)
        report = Report.from_fit(title, found.names, found.names, start, found.fit, found.pixels, found.residuals)
        draw(figures, f"rest_{name}", report)


def effect(seeds, figures):
    """Error of the dots in space, mm, over all presses, by sensor file and estimator."""
    for name, radius, depth in (("fingertip", 4.0, 2.0), ("half_cylinder", 4.0, 2.0)):
        design, truth = preset(name), posed(preset(name), TILT, OFFSET)
        simulator = Simulator(truth, appearance=Appearance(noise=NOISE_LEVEL))
        image = simulator.rest_image()
        calibrated = rest_from_image(bare(design), image).sensor
        sensors = {"design": design, "calibrated": calibrated, "truth": truth}
        aim = simulator.membrane.rest[simulator.membrane.fixed].mean(0).numpy()
        frames = []
        for body, travel in ((Sphere(radius), (0, 0, -1)), (Sphere(radius), (-0.5, 0, -0.87)), (Plane(), (0.2, 0.3, -1))):
            stroke = stroke_to(simulator, body, aim, travel, depth)
            (state,) = simulator.presses(stroke, ("push",))
            frames.append(simulator.frame(state, stroke, np.random.default_rng(0)))
        for estimator in ("minimum-energy", "force-balance"):
            for label, sensor in sensors.items():
                sensor = replace(sensor, markers=replace(sensor.markers, rest_image=image))
                solver, errors = Reconstructor(sensor, estimator), {"nulled": [], "not nulled": []}
                for frame in frames:
                    pixels = torch.from_numpy(frame.truth["uv_deformed"])
                    with torch.no_grad():
                        answers = {"nulled": solver(torch.from_numpy(frame.image)), "not nulled": solver.from_pixels(pixels)}
                    for how, answer in answers.items():
                        errors[how].append(errors_of(answer, solver, frame.truth))
                for how, pairs in errors.items():
                    surface, relative = np.mean(pairs, 0)
                    print(f"effect, {name}, {estimator}, {label}, {how}: surface {surface:.3f} mm, displacement {relative:.3f}")
                    record = dict(sensor=name, estimator=estimator, file=label, how=how)
                    yield record | dict(surface=surface, displacement=relative)


def errors_of(answer, solver, truth) -> tuple[float, float]:
    """Rms distance of the dots from where they are, mm; and of their displacements, over the true ones."""
    x, u = answer.markers[0].double().numpy(), (answer.markers[0] - solver.rest_markers).double().numpy()
    true = (truth["dots_deformed"] - truth["dots_nominal"]).astype(float)
    return rms(x - truth["dots_deformed"]), rms(u - true) / rms(true)


def material(seeds, figures):
    """Prestretch and modulus from three rendered presses, of which one's force is known, or all."""
    presses = ((Sphere(3.0), (0, 0, -1), 2.5), (Sphere(4.0), (-0.5, 0, -0.87), 2.0), (Sphere(3.0), (0.3, -0.5, -0.7), 2.0))
    for name, prestretch in itertools.product(("fingertip", "half_cylinder"), (1.05, 1.15, 1.3, 1.6, 2.0)):
        design = preset(name)
        truth = replace(design, material=replace(design.material, prestretch=prestretch, shear_modulus=0.3, thickness=0.4))
        simulator = Simulator(truth, appearance=Appearance(noise=NOISE_LEVEL))
        sensor = replace(design, markers=replace(design.markers, rest_image=simulator.rest_image()))
        aim = simulator.membrane.rest[simulator.membrane.fixed].mean(0).numpy()
        strokes = [stroke_to(simulator, body, aim, travel, depth) for body, travel, depth in presses]
        states = [next(simulator.presses(stroke, ("push",))) for stroke in strokes]
        forces = np.stack([state.force.numpy() for state in states])
        for seed in range(seeds):
            images = np.stack([simulator.image(state.vertices, np.random.default_rng(seed)) for state in states]) / 255
            for known in (1, len(presses)):
                given = np.where(np.arange(len(presses))[:, None] < known, forces, np.nan)
                found = material_from_images(sensor, torch.from_numpy(images)[:, None], given)
                record = dict(sensor=name, prestretch=prestretch, seed=seed, known=known, values=found.values.tolist())
                record |= dict(deviations=found.deviations.tolist(), each=found.each.tolist())
                record["worst"] = worst(found.values - [prestretch, 0.12], found.deviations)
                print("material", record, flush=True)
                yield record


def gauge(seeds, figures):
    """Modulus from readings good to 0.5 % of the rest pressure: of one press or three, since rest, or with rest and offset."""
    both = itertools.product(("fingertip", "half_cylinder"), (1.15, 1.3, 1.6))
    for name, prestretch in (*both, ("bubble", 1.15)):
        design = preset(name)
        truth = replace(design, material=replace(design.material, prestretch=prestretch, shear_modulus=0.3, thickness=0.4))
        simulator = Simulator(truth, appearance=Appearance(noise=NOISE_LEVEL))
        unknown = replace(design.material, shear_modulus=None, thickness=None)
        sensor = replace(design, material=unknown, markers=replace(design.markers, rest_image=simulator.rest_image()))
        size, aim = simulator.membrane.size, simulator.membrane.rest[simulator.membrane.fixed].mean(0).numpy()
        presses = ((0.14, (0, 0, -1), 0.12), (0.19, (-0.5, 0, -0.87), 0.1), (0.14, (0.3, -0.5, -0.7), 0.1))
        strokes = [stroke_to(simulator, Sphere(r * size), aim, travel, depth * size) for r, travel, depth in presses]
        states = [next(simulator.presses(stroke, ("push",))) for stroke in strokes]
        shapes = [simulator.membrane.rest, *(state.vertices for state in states)]
        p0 = float(states[0].rest_pressure)
        pressures = np.array([p0, *(float(state.pressure) for state in states)])
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            images = torch.from_numpy(np.stack([simulator.image(shape, rng) for shape in shapes]) / 255)[:, None]
            read = pressures + 0.005 * p0 * rng.normal(size=4)
            for said, chosen in (
                ("one", [1]),
                ("three", [1, 2, 3]),
                ("rest and one", [0, 1]),
                ("rest and three", [0, 1, 2, 3]),
            ):
                since_rest = "rest" not in said
                known = KnownPressures(read[chosen] - (p0 if since_rest else -0.3 * p0), since_rest)
                found = material_from_images(sensor, images[chosen], pressures=known)
                record = dict(sensor=name, prestretch=prestretch, seed=seed, known=said, values=found.values.tolist())
                record |= dict(deviations=found.deviations.tolist(), rises=(pressures / p0 - 1).tolist())
                record["worst"] = worst(found.values - [prestretch, 0.12], found.deviations)
                print("gauge", record, flush=True)
                yield record


def views(seeds, figures):
    for name, travel in (("fingertip", 1.5), ("half_cylinder", 3.0)):
        design = preset(name)
        motions = travel * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0.0]])
        motions = np.concatenate([motions, np.array([[0, 0, 0], [0, -4, 0], [0, 4, 0], [4, 0, 0], [-4, 0, 0.0]])], 1)
        truth = posed(design, TILT, OFFSET)
        for seed in range(seeds):
            images = [rest_image(seen_from(truth, motion), 10 * seed + k) for k, motion in enumerate(motions)]
            rough = motions + 0.0
            rough[1:, 3:] += np.random.default_rng(seed).normal(size=(4, 3)) * 0.3
            found = rest_from_views(bare(design), images, rough, 0.005)
            true = np.concatenate([motions[1:, 3:], motions[1:, :3]], 1).ravel()
            gap, partner = cKDTree(truth.markers.positions).query(found.dots)
            error = found.dots - truth.markers.positions[partner]
            record = row(f"views, {name}", seed, found.names, found.fit, true)
            record |= dict(dots=rms(error), dots_deviation=rms(found.deviations), dots_worst=worst(error, found.deviations))
            record |= surface_errors(truth, design, found)
            print({key: value for key, value in record.items() if not isinstance(value, list)})
            yield record
        pixels = np.broadcast_to(truth.camera.point_to_pixel(torch.from_numpy(found.dots)).numpy(), found.residuals.shape)
        title = f"{name}: dots and rest surface from five views"
        report = Report.from_fit(title, found.names, found.names, true, found.fit, pixels, found.residuals)
        if figures:
            places = fine_surface(design).rest.numpy()
            save(surface_figure(report, design.camera.image_size, places, found.surface, "mm"), figures / f"views_{name}.png")


def depth(seeds, figures):
    for name in ("fingertip", "half_cylinder"):
        design, truth = preset(name), posed(preset(name), TILT, OFFSET)
        simulator = Simulator(truth, appearance=Appearance(noise=NOISE_LEVEL))
        exact, image = simulator.renderer.depth(simulator.membrane.rest).numpy(), simulator.rest_image()
        for seed in range(seeds):
            noisy = exact + np.random.default_rng(seed).normal(size=exact.shape) * 0.2
            found = rest_from_depth(bare(design), noisy, image)
            gap, _ = cKDTree(truth.markers.positions).query(found.sensor.markers.positions)
            record = dict(what=f"depth, {name}", seed=seed, dots=float(np.sqrt((gap**2).mean())), count=len(gap))
            record |= surface_errors(truth, design, found)
            print(record)
            yield record
        report = Report.without_parameters(f"{name}: rest surface from a depth image, 0.2 mm noise")
        if figures:
            places = fine_surface(design).rest.numpy()
            save(surface_figure(report, design.camera.image_size, places, found.surface, "mm"), figures / f"depth_{name}.png")


def layout(seeds, figures):
    for name in ("half_cylinder", "fingertip"):
        sensor = preset(name)
        pixels, sizes = pixel_lattice(sensor, 30.0)
        dots = layout_for_pixels(sensor, pixels, sizes)
        made = replace(sensor, markers=Markers("dots", "dark", dots.positions, sizes))
        found = find_dots(rest_image(made, 0), "dark").pixels
        gap, _ = cKDTree(found).query(pixels)
        record = dict(what=f"pattern, {name}", dots=len(pixels), found=int((gap < 3).sum()), rms=rms(gap[gap < 3]))
        print(record)
        yield record
        if figures:
            title = f"{name}: {len(pixels)} dots that make a square lattice in the image"
            save(layout_figure(title, sensor, dots), figures / f"layout_{name}.png")


def poses_seen(photograph: TargetRenderer, board, count: int, depths, spread: float, rng) -> np.ndarray:
    """A board in random poses as it was found in its images, `[count, D, 2]` px; poses not wholly seen are drawn again."""
    found, middle = [], np.append(sum(board.extent) / 2, 0.0)
    while len(found) < count:
        rotation = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * [0.5, 0.5, 0.8]).as_matrix()
        z = rng.uniform(*depths)
        place = np.append(rng.uniform(-spread, spread, 2) * z, z)
        image = photograph.image(board, rotation, place - rotation @ middle, NOISE_LEVEL, rng=rng)
        try:
            found.append(find_target(to_grey(image), board))
        except MembraneError:
            continue
    return np.stack(found)


def posed(design, turn: Rotation, offset: np.ndarray):
    """The sensor as it really is: its membrane and dots turned about the rim's centre and shifted."""
    fine = fine_surface(design)
    rim = fine.rest[fine.fixed].mean(0).numpy()
    return moved(design, turn, rim + offset - turn.apply(rim))


def seen_from(sensor, motion: np.ndarray):
    """The same membrane in the frame of a camera that moved by (place, turn in degrees)."""
    back = Rotation.from_rotvec(np.deg2rad(motion[3:])).inv()
    return moved(sensor, back, -back.apply(motion[:3]))


def moved(sensor, turn: Rotation, shift: np.ndarray):
    fine = sensor.surface.membrane((97, 97))
    vertices = (turn.apply(fine.rest.numpy()) + shift).reshape(97, 97, 3)
    surface = Surface("grid", {"vertices": vertices, "fixed": fine.fixed.numpy().reshape(97, 97)})
    markers = Markers("dots", "dark", turn.apply(sensor.markers.positions) + shift, sensor.markers.sizes)
    return replace(sensor, membrane=surface.membrane(sensor.membrane.grid), surface=surface, markers=markers)


def bare(sensor):
    return replace(sensor, markers=replace(sensor.markers, rest_image=None))


def rest_image(sensor, seed: int) -> np.ndarray:
    simulator = Simulator(sensor, appearance=Appearance(noise=NOISE_LEVEL))
    return to_grey(simulator.image(simulator.membrane.rest, np.random.default_rng(seed)))


def surface_errors(truth, design, found) -> dict[str, float]:
    """Distances, mm, of the designed and the calibrated surface from the true one, free vertices, and over their deviations."""
    target = truth.surface.membrane((129, 129))
    free = ~fine_surface(design).fixed.numpy()
    before = surface_projection(target, fine_surface(design).rest.numpy()[free]).signed_distance
    after = surface_projection(target, found.surface.vertices[free]).signed_distance
    deviations = found.surface.deviations[free]
    return dict(
        surface_before=rms(before),
        surface_after=rms(after),
        surface_deviation=rms(deviations),
        surface_beyond_3=float((np.abs(after) > 3 * deviations).mean()),
    )


def row(what: str, seed: int, names, fit, truth) -> dict:
    n = len(names)
    error, deviations = fit.values[:n] - np.asarray(truth), fit.deviations[:n]
    print(f"{what}, seed {seed}: noise {fit.noise:.3f} px, worst error / deviation {worst(error, deviations):.2f}")
    for name, e, sd in list(zip(names, error, deviations, strict=True))[:9]:
        print(f"    {name:16s} error {e:+.5f}  deviation {sd:.5f}")
    errors = dict(error=error.tolist(), deviation=deviations.tolist(), worst=worst(error, deviations))
    return dict(what=what, seed=seed, noise=fit.noise, names=list(names), **errors)


def rms(values) -> float:
    squares = np.asarray(values, float) ** 2
    return float(np.sqrt((squares.sum(-1) if squares.ndim > 1 else squares).mean()))


def worst(error, deviations) -> float:
    return float(np.abs(np.asarray(error) / np.asarray(deviations)).max())


def draw(folder: Path | None, name: str, report: Report) -> None:
    if folder:
        folder.mkdir(parents=True, exist_ok=True)
        save(fit_figure(report, (640, 480)), folder / f"{name}.png")


PARTS = {part.__name__: part for part in (lens, ports, rest, effect, views, depth, layout, material, gauge)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], default=list(PARTS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figures", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    results = {}
    for name in args.parts:
        start = time.perf_counter()
        results[name] = list(PARTS[name](args.seeds, args.figures))
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    write(args.json, results)


if __name__ == "__main__":
    main()
