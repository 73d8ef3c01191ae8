"""Forces and depths on membranes of any outline, against a simulation that shares neither mesh nor solver with the package.

python -m bench.accuracy.windows [--noise 0.1] [--rims rectangle ...] [--material]

A rectangle, an ellipse, a rounded triangle, a bean (concave) and a saddle (not planar), about 50 x 36 mm, neo-Hookean sheets of
prestretch 1.1 and modulus x thickness 0.05 N/mm, blown up by 12 hPa of gas, pressed by a ball of 8 mm, twice. The truth is
found on an unstructured mesh (Delaunay) of linear triangles by L-BFGS, with a penalty for contact, without friction. The
package is told the rim, the height, the gauge and the prestretch, as `init` takes them. The dots' pixels carry Gaussian noise;
the dots are placed from those at rest. Printed are the modulus, and of each press depth and force, found over true.
With --material the package is told a prestretch of 1.2, wrongly, and no modulus; prestretch and modulus are then calibrated
from both presses with their forces, known to 3 %, and the gauge at rest, and printed with their deviations.
"""

import argparse
import math
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.spatial import Delaunay
from torch import Tensor

import torchmembrane as tm
from torchmembrane.calibrate.known_modulus import KnownForces
from torchmembrane.calibrate.material import material_from_pixels
from torchmembrane.forming.outline import ellipse, encloses, outline_of, rectangle
from torchmembrane.presets.blown_up import Stated, blown_up
from torchmembrane.sensor.parts import Cavity, Markers

ANGLE = 2 * np.pi * np.arange(360) / 360
STRETCH, MODULUS, GAUGE, THICKNESS, AIR, BALL = 1.1, 0.05, 12.0, 0.2, 1013.0, 8.0
STEP, PITCH, STIFFNESS = 1.4, 3.6, 0.2  # of the mesh and of the dots, mm; of the contact's penalty, N/mm^3
PRESSES = (((0.0, 0.0), 3.0), ((5.0, -3.0), 2.0))


def rims() -> dict[str, np.ndarray]:
    """Points once around, `[K, 3]`, mm."""
    around = {
        "triangle": 21 + 2.5 * np.cos(3 * ANGLE),
        "bean": 18 + 7 * np.cos(2 * ANGLE) + 2 * np.cos(3 * ANGLE),
    }
    flat = {"rectangle": rectangle((50.0, 36.0), 4.0), "ellipse": ellipse((50.0, 36.0))[::2]}
    flat |= {name: np.stack([r * np.cos(ANGLE), r * np.sin(ANGLE)], -1) for name, r in around.items()}
    found = {name: np.insert(rim, 2, 40.0, axis=1) for name, rim in flat.items()}
    bent = found["ellipse"].copy()
    bent[:, 2] += 1.5 * np.cos(2 * np.arctan2(bent[:, 1] / 18, bent[:, 0] / 25))
    return found | {"saddle": bent}


class Sheet(NamedTuple):
    """A sheet as it is made: prestretch, modulus x thickness (N/mm), and the overpressure that blows it up (hPa)."""

    stretch: float = STRETCH
    modulus: float = MODULUS
    gauge: float = GAUGE


class Twin:
    """A sheet on an unstructured mesh, reference by metrics."""

    def __init__(self, rim: np.ndarray, made: Sheet | None = None) -> None:
        self.made = made or Sheet()
        outline = outline_of(rim)
        border = outline.camera_frame(outline.sampled(int(outline.length / STEP)))
        i, j = np.meshgrid(*(np.arange(-40, 41),) * 2)
        inner = np.stack([i + 0.5 * (j % 2), j * math.sqrt(0.75)], -1).reshape(-1, 2) * STEP
        far = np.linalg.norm(inner[:, None] - border[None, :, :2], axis=2).min(1) > 0.6 * STEP
        inner = inner[far & encloses(border[:, :2], inner)]
        flat = np.concatenate([border[:, :2], inner])
        cells = Delaunay(flat).simplices
        cells = cells[encloses(border[:, :2], flat[cells].mean(1))]
        self.fixed, self.flat, self.cells = len(border), flat, torch.from_numpy(cells.astype(np.int64))
        e = self._edges(torch.from_numpy(np.insert(flat, 2, 0.0, axis=1)))
        turned = torch.linalg.cross(e[..., 0], e[..., 1])[:, 2] < 0
        self.cells[turned] = self.cells[turned][:, [0, 2, 1]]
        self.border = torch.from_numpy(border)
        self.sheet = self._film(np.ptp(border[:, 2]))
        metric = self._metric(self.sheet)
        self.inverse, self.det = torch.linalg.inv(metric), torch.linalg.det(metric)
        self.area = self.det.sqrt() / 2
        self.at_nodes = torch.zeros(len(flat), dtype=torch.float64).index_add_(
            0, self.cells.flatten(), (self.area / 3).repeat_interleave(3)
        )
        self.rest_volume = None

    def _edges(self, x: Tensor) -> Tensor:
        p = x[self.cells]
        return torch.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]], -1)

    def _metric(self, x: Tensor) -> Tensor:
        e = self._edges(x)
        return e.mT @ e

    def _film(self, bent: float) -> Tensor:
        flat = torch.from_numpy(self.flat)
        whole = torch.cat([flat, torch.full((len(flat), 1), float(self.border[:, 2].mean()), dtype=torch.float64)], 1)
        whole[: self.fixed] = self.border
        if bent < 1e-9:
            return whole

        def area(z: Tensor) -> Tensor:
            x = torch.cat([self.border, torch.cat([flat[self.fixed :], z[:, None]], 1)])
            return torch.linalg.det(self._metric(x)).sqrt().sum() / 2

        z = least(area, whole[self.fixed :, 2])
        whole[self.fixed :, 2] = z
        return whole

    def volume(self, x: Tensor) -> Tensor:
        return torch.linalg.det(x[self.cells]).sum() / 6

    def elastic(self, x: Tensor) -> Tensor:
        g = self._metric(x)
        first = (self.inverse * g).sum((1, 2))
        stretch, modulus, _ = self.made
        return (self.area * modulus / 2 * (stretch**2 * first + self.det / torch.linalg.det(g) / stretch**4 - 3)).sum()

    def at(self, wanted: np.ndarray) -> tuple[Tensor, Tensor]:
        """Points of the sheet `[D, 2]` on the mesh, those outside left out: the vertices around each `[D, 3]`, and weights."""
        a, b, c = self.flat[self.cells.numpy()].transpose(1, 0, 2)
        inverse = np.linalg.inv(np.stack([b - a, c - a], -1))
        share = np.einsum("tij,dtj->dti", inverse, wanted[:, None] - a)
        weights = np.concatenate([1 - share.sum(-1, keepdims=True), share], -1)
        inside = weights.min(-1)
        cell, kept = inside.argmax(1), inside.max(1) > -1e-9
        return self.cells[cell[kept]], torch.from_numpy(weights[np.arange(len(wanted)), cell][kept])

    def blown_up(self) -> Tensor:
        x = self.sheet.clone()
        width = np.abs(self.flat).max(0)
        x[self.fixed :, 2] += torch.from_numpy(5 * (1 - (self.flat[self.fixed :] / width) ** 2).clip(0).prod(1))

        def potential(free: Tensor) -> Tensor:
            y = torch.cat([self.border, free.reshape(-1, 3)])
            return self.elastic(y) - self.made.gauge * 1e-4 * self.volume(y)

        x[self.fixed :] = least(potential, x[self.fixed :].flatten()).reshape(-1, 3)
        self.rest_volume = float(self.volume(x))
        return x

    def pressed(self, x: Tensor, centre: Tensor, gas: float, ball: float = BALL) -> tuple[Tensor, Tensor]:
        """Vertices and force under a ball of a radius outside the membrane."""
        p0, P = (pressure * 1e-4 for pressure in (self.made.gauge, AIR + self.made.gauge))

        def contact(y: Tensor) -> Tensor:
            depth = (ball - (y - centre).norm(dim=1)).clamp_min(0)
            return STIFFNESS / 2 * (self.at_nodes * depth**2).sum()

        def potential(free: Tensor) -> Tensor:
            y = torch.cat([self.border, free.reshape(-1, 3)])
            rise = self.volume(y) - self.rest_volume
            fluid = (p0 - P) * rise + P * gas * torch.log1p(rise / gas)
            return self.elastic(y) - fluid + contact(y)

        y = x.clone()
        y[self.fixed :] = least(potential, x[self.fixed :].flatten()).reshape(-1, 3)
        z = y.clone().requires_grad_()
        return y, -torch.autograd.grad(contact(z), z)[0].sum(0)


def least(value, start: Tensor) -> Tensor:
    """The minimum near a start."""

    def both(x: np.ndarray) -> tuple[float, np.ndarray]:
        unknown = torch.from_numpy(x).requires_grad_()
        total = value(unknown)
        return float(total.detach()), torch.autograd.grad(total, unknown)[0].numpy()

    options = {"maxiter": 3000, "maxfun": 4000, "maxcor": 40, "ftol": 1e-15, "gtol": 1e-9}
    return torch.from_numpy(minimize(both, start.numpy(), jac=True, method="L-BFGS-B", options=options).x)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", type=float, default=0.1, help="px")
    parser.add_argument("--material", action="store_true")
    parser.add_argument("--rims", nargs="+", choices=list(rims()), default=list(rims()))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rng, errors = np.random.default_rng(0), []
    noise = {"noise": arguments.noise} if arguments.noise else {}
    camera = tm.Camera("pinhole", (640, 480), (480.0, 480.0), (321.0, 238.0))
    for name, rim in rims().items():
        if name not in arguments.rims:
            continue
        twin = Twin(rim)
        rest = twin.blown_up()
        outline = outline_of(rim)
        height = float((rest[:, 2] - outline.origin[2]).max())
        stretch, gauge = (1.2, None) if arguments.material else (STRETCH, GAUGE)
        found = blown_up({"outline": rim}, "mm", Stated(height, gauge, stretch, None, THICKNESS))
        dots = lattice(twin)

        def seen(x: Tensor, dots=dots) -> Tensor:
            pixels = camera.point_to_pixel((x[dots[0]] * dots[1][..., None]).sum(1))
            return pixels + arguments.noise * torch.from_numpy(rng.standard_normal(pixels.shape))

        rest_pixels = seen(rest)
        rays = camera.pixel_to_ray(rest_pixels)
        placed = found.surface.membrane((65, 65))
        hits = placed.ray_points(rays.origin.numpy(), rays.direction.numpy())
        kept = np.isfinite(hits.distance)
        positions = (rays.origin.numpy() + hits.distance[:, None] * rays.direction.numpy())[kept]
        membrane = found.surface.membrane((33, 33))
        gas = membrane.cavity_volume
        cavity, markers = Cavity("gas", AIR + GAUGE, gas), Markers("dots", positions=positions)
        sensor = tm.Sensor(name, "mm", camera, membrane, found.material, cavity, markers, found.surface)
        if arguments.material:
            calibrated(name, sensor, [twin.pressed(rest, centre, gas) for centre in centres(rest)], seen, kept, noise)
            continue
        reconstructor = tm.Reconstructor(sensor)
        modulus = found.material.modulus / MODULUS
        print(f"{name}: {kept.sum()} dots, {height:.2f} mm high, modulus x {modulus:.3f}", flush=True)
        for ((px, py), depth), centre in zip(PRESSES, centres(rest), strict=True):
            x, force = twin.pressed(rest, centre, gas)
            with torch.no_grad():
                result = reconstructor.from_pixels(seen(x)[kept][None], rest_pixels=rest_pixels[kept], **noise).frame(0)
            deepest = [float(-u.min()) for u in (x[:, 2] - rest[:, 2], torch.from_numpy(result["displacement"][:, 2]))]
            ratio = np.linalg.norm(result["force"]) / float(force.norm())
            errors.append([abs(ratio - 1), abs(deepest[1] / deepest[0] - 1)])
            print(
                f"  {depth:g} mm at {px:g},{py:g}: force {float(force.norm()):.4f} N x {ratio:.3f}, deepest {deepest[0]:.2f} mm"
                f" x {deepest[1] / deepest[0]:.3f}, status {int(result['status'])}",
                flush=True,
            )
    if arguments.material:
        return
    print(f"median error of force {np.median(errors, 0)[0]:.1%}, of depth {np.median(errors, 0)[1]:.1%}")


def centres(rest: Tensor) -> list[Tensor]:
    """Of the ball in each press."""
    places = [torch.tensor(place, dtype=torch.float64) for place, _ in PRESSES]
    tops = [rest[(rest[:, :2] - place).norm(dim=1).argmin(), 2:] for place in places]
    return [torch.cat([place, top + BALL - depth]) for place, top, (_, depth) in zip(places, tops, PRESSES, strict=True)]


def calibrated(name: str, sensor: tm.Sensor, presses: list, seen, kept: np.ndarray, noise: dict) -> None:
    """Calibrate the material from presses, and print it."""
    forces = np.stack([force.numpy() for _, force in presses])
    known = KnownForces(forces, 0.03 * np.linalg.norm(forces, axis=1))
    pixels = torch.stack([seen(x)[kept] for x, _ in presses])
    found = material_from_pixels(sensor, pixels, known, overpressure=GAUGE, **noise)
    off = (found.values - [STRETCH, MODULUS]) / found.deviations
    said = [f"{value:.3f} ± {sd:.3f} ({z:+.1f})" for value, sd, z in zip(found.values, found.deviations, off, strict=True)]
    print(f"{name}: prestretch {said[0]}, modulus {said[1]} {list(found.contradictions)}", flush=True)


def lattice(twin: Twin) -> tuple[Tensor, Tensor]:
    """Dots on the mesh: the vertices around each `[D, 3]`, and weights."""
    i, j = np.meshgrid(*(np.arange(-12, 13),) * 2)
    return twin.at(np.stack([i, j], -1).reshape(-1, 2) * PITCH)


if __name__ == "__main__":
    main()
