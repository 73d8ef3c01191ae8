"""What each part of force balance is worth: the estimator with one part changed at a time, on rendered presses with truth.

python -m bench.accuracy.ablation CASES [--only GROUP ...] [--json FILE]

CASES as for accuracy.py; of several images of a press the last is taken. Markers are located once an image, so that all rows
see the same pixels (`exact`: the truth's). Printed as a table: error of the markers over their displacement (rms, median and
worst press), distance of the contact points from the true ones in mm, relative errors of total force and pressure change
(medians), and how many presses did not settle.
"""

import argparse
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.accuracy.accuracy import cases_in, contact_errors
from bench.data.record import write
from torchmembrane.markers.observer import FOUND_CONFIDENCE
from torchmembrane.sensor.parts import FRICTION

GRID = 33
BASE = tm.ForceBalanceSettings()


@dataclass
class Variant:
    """The base with one change: settings of the estimator, what the sensor's file says, which markers."""

    group: str
    label: str
    settings: tm.ForceBalanceSettings = BASE
    model: str | None = None
    friction: float = FRICTION
    filling: Callable[[tm.Cavity], tm.Cavity] = lambda cavity: cavity
    grid: int = GRID
    assumed: float = 1.0  # of the noise that markers are known to have
    noise: float = 0.0
    every: int = 1
    exact: bool = False


def changed(group: str, label: str, grid: int = GRID, **settings) -> Variant:
    return Variant(group, label, replace(BASE, **settings), grid=grid)


def each(group: str, name: str, *values: float) -> list[Variant]:
    return [changed(group, f"{name} = {value:g}", **{name: value}) for value in values]


HEADINGS = ("changed", "", "surface", "worst", "contact, mm", "force", "pressure change", "unsettled")
ROW = "| {group} | {label} | {surface:.3f} | {worst:.2f} | {contact:.2f} | {force:.0%} | {pressure_change:.0%} | {unsettled} |"
VARIANTS = [
    *(Variant("base", f"{n} x {n}, located markers", grid=n) for n in (33, 17)),
    *(Variant("base", f"{n} x {n}, exact markers", grid=n, exact=True) for n in (33, 17)),
    Variant("cavity", "open: no volume constraint", filling=lambda cavity: replace(cavity, filling="open")),
    Variant("cavity", "gas, 1013 hPa", filling=lambda cavity: replace(cavity, filling="gas", pressure=1013.0)),
    changed("compressive loss", "quadratic: tau = (10, 10)", tau=(10.0, 10.0)),
    changed("compressive loss", "not graduated: tau = (0.4, 0.4)", tau=(0.4, 0.4)),
    *each("compressive loss", "sparsity", BASE.sparsity / 4, BASE.sparsity * 4),
    *each("what tractions are measured against", "scale_share", 0.1, 0.4),
    *each("shear and friction", "shear", 0.0, BASE.shear / 4, BASE.shear * 4),
    *(Variant("shear and friction", f"friction = {mu:g}", friction=mu) for mu in (0.0, 0.25, 1.0)),
    *(Variant("energy", model.replace("_", "-"), model=model) for model in ("harmonic", "neo_hookean", "mooney_rivlin")),
    *(Variant("grid", f"{n} x {n}", grid=n) for n in (13, 25)),
    *each("steps", "settled_step_tol", 1e-3, 1e-5),
    *(changed("steps", f"steps = (64, 32, {n})", steps=(64, 32, n)) for n in (4, 16, 32, 64)),
    *each("surroundings", "reach", 1e-6, 0.08),
    *each("surroundings", "floor", 1e-5, 1e-2),
    *(Variant("marker noise", f"assumed {share:g} times as large", assumed=share) for share in (0.5, 2)),
    *(Variant("marker noise", f"{px:g} px added", noise=px) for px in (0.1, 0.2, 0.5)),
    *(Variant("number of dots", f"one in {n}", every=n) for n in (2, 4)),
]


def reconstructor_of(sensor: tm.Sensor, variant: Variant) -> tm.Reconstructor:
    markers = replace(sensor.markers, rest_image=None)
    membrane, cavity = sensor.surface.membrane((variant.grid, variant.grid)), variant.filling(sensor.cavity)
    material = replace(sensor.material, friction=variant.friction)
    sensor = replace(sensor, membrane=membrane, material=material, cavity=cavity, markers=markers)
    return tm.Reconstructor(sensor, settings=variant.settings, model=variant.model)


@dataclass
class Press:
    truth: dict[str, np.ndarray]
    pixels: torch.Tensor
    confidence: torch.Tensor
    noise: torch.Tensor


def presses_of(root: Path, name: str, cases: list[dict]) -> tuple[tm.Sensor, torch.Tensor, list[Press]]:
    """A sensor, its markers located in the rest image, and its presses with the markers located in their images."""
    locating, presses = tm.Reconstructor.from_file(root / name), []
    observer = locating.observer
    generator = torch.Generator().manual_seed(0)
    for case in (c for c in cases if c["sensor"] == name):
        displacement, confidence, *_ = observer(locating.read(root / case["images"][-1]))
        noise = torch.randn(displacement.shape, generator=generator)
        pixels = displacement + observer.measured_rest
        presses.append(Press(dict(np.load(root / case["truth"])), pixels, confidence, noise))
    return locating.sensor, observer.measured_rest, presses


def errors_of(reconstructor: tm.Reconstructor, rest: torch.Tensor, press: Press, variant: Variant) -> dict[str, float]:
    truth, pixels, confidence = press.truth, press.pixels, press.confidence
    if variant.exact:
        pixels, rest = (torch.from_numpy(truth[name].astype(np.float32)) for name in ("uv_deformed", "uv_nominal"))
        confidence = torch.ones(1, len(pixels))
    kept = torch.arange(confidence.shape[1]) % variant.every == 0
    result = unjudged(reconstructor, pixels + variant.noise * press.noise, confidence * kept, rest, variant.assumed)
    X, Y = truth["dots_nominal"].astype(float), truth["dots_deformed"].astype(float)
    surface = float(np.sqrt(((result.markers[0].numpy() - Y) ** 2).sum() / ((Y - X) ** 2).sum()))
    return dict(surface=surface, unsettled=int(result.status[0] != 0), **contact_errors(result, truth))


def unjudged(reconstructor: tm.Reconstructor, pixels, confidence, rest, assumed: float) -> tm.Reconstruction:
    """As `from_pixels`, without asking whether most markers are found: one dot in four is enough here."""
    displacement, confidence, covariance, status = reconstructor.observer.from_pixels(pixels, confidence, rest)
    usable = torch.where(confidence > FOUND_CONFIDENCE, confidence, 0.0)
    observation = reconstructor.observation(displacement, usable, assumed**2 * covariance)
    return reconstructor.result(reconstructor.estimator(observation), observation, displacement, usable, status)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--only", nargs="*", choices=sorted({variant.group for variant in VARIANTS}))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    cases, rows = cases_in(args.cases), []
    with torch.no_grad():
        sensors = [presses_of(args.cases, name, cases) for name in sorted({case["sensor"] for case in cases})]
        print("| " + " | ".join(HEADINGS) + " |\n" + len(HEADINGS) * "|---" + "|")
        for variant in VARIANTS:
            if args.only and variant.group not in args.only:
                continue
            found = []
            for sensor, rest, presses in sensors:
                reconstructor = reconstructor_of(sensor, variant)
                found += [errors_of(reconstructor, rest, press, variant) for press in presses]
            every = {name: np.array([errors[name] for errors in found]) for name in found[0]}
            row = dict(group=variant.group, label=variant.label)
            row |= {name: float(np.nanmedian(values)) for name, values in every.items()}
            row |= dict(worst=float(np.nanmax(every["surface"])), unsettled=int(every["unsettled"].sum()))
            print(ROW.format(**row), flush=True)
            rows.append(row | dict(each={name: values.tolist() for name, values in every.items()}))
    write(args.json, dict(presses=len(cases), rows=rows))


if __name__ == "__main__":
    main()
