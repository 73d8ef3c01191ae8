"""What each part of force balance is worth: the estimator with one part changed at a time, on rendered presses with truth.

python bench/ablation.py CASES [--only GROUP ...] [--json FILE]

CASES as for accuracy.py; of several images of a press the last is taken. Markers are located once an image, so that all rows
see the same pixels (`exact`: the truth's). Printed as a table: error of the markers over their displacement (rms, median and
worst press), distance of the contact points from the true ones in mm, relative errors of total force and pressure change
(medians), and how many presses did not settle.
"""

import argparse
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from accuracy import cases_in, contact_errors
from record import write

from torchmembrane import reconstruct
from torchmembrane.estimators import force_balance
from torchmembrane.estimators.force_balance import FRICTION, SPARSITY
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.parts import Cavity
from torchmembrane.sensor.sensor import Sensor

GRID = 33


@dataclass
class Variant:
    """The base with one change: `constants` of `force_balance`, what the sensor's file says, which markers."""

    group: str
    label: str
    constants: dict = field(default_factory=dict)
    model: str | None = None
    filling: Callable[[Cavity], Cavity] = lambda cavity: cavity
    grid: int = GRID
    assumed: float = reconstruct.MARKER_NOISE["dots"]
    noise: float = 0.0
    every: int = 1
    exact: bool = False


def named(group: str, name: str, *values) -> list[Variant]:
    return [Variant(group, f"{name} = {value:g}", {name: value}) for value in values]


HEADINGS = ("changed", "", "surface", "worst", "contact, mm", "force", "pressure change", "unsettled")
ROW = "| {group} | {label} | {surface:.3f} | {worst:.2f} | {contact:.2f} | {force:.0%} | {pressure_change:.0%} | {unsettled} |"
VARIANTS = [
    *(Variant("base", f"{n} x {n}, located markers", grid=n) for n in (33, 17)),
    *(Variant("base", f"{n} x {n}, exact markers", grid=n, exact=True) for n in (33, 17)),
    Variant("cavity", "open: no volume constraint", filling=lambda cavity: replace(cavity, filling="open")),
    Variant("cavity", "gas, 1013 hPa", filling=lambda cavity: replace(cavity, filling="gas", pressure=1013.0)),
    Variant("price of a push", "quadratic: tau stays", dict(TAU=(10.0, 10.0), FINE_TAU=(10.0, 10.0))),
    Variant("price of a push", "not graduated: tau 0.4 at once", dict(TAU=(0.4, 0.4), FINE_TAU=(0.4, 0.4))),
    *named("price of a push", "SPARSITY", SPARSITY / 4, SPARSITY * 4),
    *named("friction", "FRICTION", 0.0, FRICTION / 4, FRICTION * 4),
    *named("friction", "CONE", 0.0, 40.0),
    Variant("friction", "COARSE_CONE = 15, 6 steps there", dict(COARSE_CONE=15.0, COARSE_STEPS=6)),
    *(Variant("energy", model.replace("_", "-"), model=model) for model in ("harmonic", "neo_hookean", "mooney_rivlin")),
    *(Variant("grid", f"{n} x {n}", grid=n) for n in (13, 25)),
    *(Variant("steps", f"{n} from rest on 9 x 9", dict(COARSE_STEPS=n)) for n in (3, 6)),
    *(Variant("steps", f"{n} on 17 x 17 and on 33 x 33", dict(FINE_STEPS=n, FINER_STEPS=n)) for n in (3, 6, 20)),
    *(Variant("steps", f"{n} on 17 x 17, no finer grid", dict(FINE_STEPS=n), grid=17) for n in (3, 4, 20)),
    *(Variant("steps", f"{n} from rest on 17 x 17, no other grid", dict(COARSEST=17, STEPS=n), grid=17) for n in (6, 8)),
    *named("surroundings", "REACH", 1e-6, 0.08),
    *named("surroundings", "FLOOR", 0.0, 1e-2),
    *(Variant("marker noise", f"assumed {px:g} px", assumed=px) for px in (0.05, 0.2)),
    *(Variant("marker noise", f"{px:g} px added", noise=px) for px in (0.1, 0.2, 0.5)),
    *(Variant("number of dots", f"one in {n}", every=n) for n in (2, 4)),
]


@contextmanager
def constants_of(variant: Variant):
    before = {name: getattr(force_balance, name) for name in variant.constants}
    for name, value in variant.constants.items():
        setattr(force_balance, name, value)
    yield
    for name, value in before.items():
        setattr(force_balance, name, value)


def reconstructor_of(sensor: Sensor, variant: Variant) -> Reconstructor:
    markers = replace(sensor.markers, rest_image=None)
    membrane, cavity = sensor.surface.membrane((variant.grid, variant.grid)), variant.filling(sensor.cavity)
    changed = Reconstructor(replace(sensor, membrane=membrane, cavity=cavity, markers=markers), model=variant.model)
    estimator = changed.estimator
    while estimator is not None:
        estimator.noise *= variant.assumed / reconstruct.MARKER_NOISE[markers.kind]
        estimator = estimator.coarse
    return changed


@dataclass
class Press:
    truth: dict[str, np.ndarray]
    pixels: torch.Tensor
    confidence: torch.Tensor
    noise: torch.Tensor


def presses_of(root: Path, name: str, cases: list[dict]) -> tuple[Sensor, torch.Tensor, list[Press]]:
    """A sensor, its markers located in the rest image, and its presses with the markers located in their images."""
    locating, presses = Reconstructor.from_file(root / name), []
    generator = torch.Generator().manual_seed(0)
    for case in (c for c in cases if c["sensor"] == name):
        displacement, confidence, _ = locating.observe(locating.read(root / case["images"][-1]))
        noise = torch.randn(displacement.shape, generator=generator)
        pixels = displacement + locating.measured_rest
        presses.append(Press(dict(np.load(root / case["truth"])), pixels, confidence, noise))
    return locating.sensor, locating.measured_rest, presses


def errors_of(changed: Reconstructor, rest: torch.Tensor, press: Press, variant: Variant) -> dict[str, float]:
    truth, pixels, confidence = press.truth, press.pixels, press.confidence
    if variant.exact:
        pixels, rest = (torch.from_numpy(truth[name].astype(np.float32)) for name in ("uv_deformed", "uv_nominal"))
        confidence = torch.ones(1, len(pixels))
    kept = torch.arange(confidence.shape[1]) % variant.every == 0
    result = changed.from_pixels(pixels + variant.noise * press.noise, confidence * kept, rest)
    X, Y = truth["dots_nominal"].astype(float), truth["dots_deformed"].astype(float)
    surface = float(np.sqrt(((result.markers[0].numpy() - Y) ** 2).sum() / ((Y - X) ** 2).sum()))
    return dict(surface=surface, unsettled=int(result.status[0] != 0), **contact_errors(result, truth))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--only", nargs="*", choices=sorted({variant.group for variant in VARIANTS}))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    reconstruct.ALIKE_SHARE = 0.0  # one dot in four is enough here
    cases, rows = cases_in(args.cases), []
    with torch.no_grad():
        sensors = [presses_of(args.cases, name, cases) for name in sorted({case["sensor"] for case in cases})]
        print("| " + " | ".join(HEADINGS) + " |\n" + len(HEADINGS) * "|---" + "|")
        for variant in VARIANTS:
            if args.only and variant.group not in args.only:
                continue
            with constants_of(variant):
                found = []
                for sensor, rest, presses in sensors:
                    changed = reconstructor_of(sensor, variant)
                    found += [errors_of(changed, rest, press, variant) for press in presses]
            every = {name: np.array([errors[name] for errors in found]) for name in found[0]}
            row = dict(group=variant.group, label=variant.label)
            row |= {name: float(np.nanmedian(values)) for name, values in every.items()}
            row |= dict(worst=float(np.nanmax(every["surface"])), unsettled=int(every["unsettled"].sum()))
            print(ROW.format(**row), flush=True)
            rows.append(row | dict(each={name: values.tolist() for name, values in every.items()}))
    write(args.json, dict(presses=len(cases), rows=rows))


if __name__ == "__main__":
    main()
