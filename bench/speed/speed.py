"""Time a frame: markers, flow, solve, at several batch sizes, beside per-frame scipy twins of the solves.

python -m bench.speed.speed [--sensor examples/sensor.toml] [--image examples/press_on_axis.png] [--device cpu] [--json FILE]

The paper: its estimator with the soft locator, stage by stage, and `paper_twin` of its solve. Minimum energy: beside
`energy_twin`, which makes the same steps. Force balance (17 x 17): beside `balance_twin`, which does so too. Paper, force
balance and solves alone: processor time, the least of several turns, taken in turn, as other programs may share the cores. How
accurate the 17 x 17 grid is: `accuracy/ablation.py`, its base row. With 2000000000 as the environment's
MALLOC_TRIM_THRESHOLD_ and MALLOC_MMAP_THRESHOLD_ glibc keeps freed memory: a quarter less time in batches.
"""

import argparse
import copy
import time
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import median_seconds, write
from bench.speed.balance_twin import BalanceTwin
from bench.speed.energy_twin import EnergyTwin
from bench.speed.paper_twin import PaperTwin
from torchmembrane.estimators.base import Observation


def minimum_energy(args):
    for label, model in (("harmonic", "harmonic"), ("the sensor's material", None)):
        reconstructor = tm.Reconstructor.from_file(args.sensor, "minimum-energy", model=model).to(args.device)
        locator, estimator = reconstructor.observer.locator, reconstructor.estimator
        image = reconstructor.read(args.image)
        with torch.no_grad():
            for batch in args.batches:
                images = image.expand(batch, -1, -1, -1).contiguous()
                displacement, confidence, covariance, _ = reconstructor.observer(images)
                pixels = reconstructor.rest_pixels + displacement
                observation = reconstructor.observation(displacement, confidence, covariance)
                parts = dict(
                    markers=partial(locator, images),
                    flow=partial(estimator.flow, pixels, confidence),
                    solve=partial(estimator, observation),
                    whole=partial(reconstructor, images),
                )
                times = {name: [1000 * t / batch for t in median_seconds(part)] for name, part in parts.items()}
                yield dict(estimator=label, batch=batch, milliseconds_a_frame=times)
                print(f"{label}, batch {batch}: " + ", ".join(f"{k} {t[0]:.2f} ms" for k, t in times.items()), flush=True)
            if args.device == "cpu":
                twin = EnergyTwin(estimator)
                one = Observation(*(None if part is None else part[:1] for part in observation))
                d = one.directions[0].double().numpy()
                gap = np.abs(twin(d) - estimator(one).vertices[0].numpy()).max()
                times = least_milliseconds({"solve": partial(estimator, one), "scipy twin": partial(twin, d)}, 25)
                yield dict(estimator=label, batch=1, solve_alone=times)
                print(
                    f"the solve alone, a frame: {times['solve']:.2f} ms, its twin {times['scipy twin']:.2f} ms (gap {gap:.1e})"
                )


def least_milliseconds(functions: dict, turns: int) -> dict[str, float]:
    """Least processor time of every function, taken in turn, after one warm-up call each."""
    times = {name: [] for name in functions}
    for turn in range(turns + 1):
        for name, function in functions.items():
            start = time.process_time()
            function()
            if turn:
                times[name].append(1000 * (time.process_time() - start))
    return {name: min(values) for name, values in times.items()}


def paper(args):
    """The paper's estimator with the soft locator, stage by stage, one frame."""
    r = tm.Reconstructor.from_file(args.sensor, "paper", locator="soft")
    estimator, segmentation, image = r.estimator, r.estimator.segmentation, r.read(args.image)
    displacement, confidence, covariance, _ = r.observer(image)
    seen = r.observation(displacement, confidence, covariance)
    relaxed = segmentation.in_contact(segmentation.by_polar_angle(seen.directions).region)
    programme, system = estimator.programme(seen, relaxed)[0], estimator.system
    factor, loads = system.factor(programme.stencil), torch.stack([programme.load, programme.v], 1)
    twin, frame = PaperTwin(estimator), (seen.directions[0].double().numpy(), relaxed[0].numpy())
    gap = np.abs(twin(*frame) - estimator.solve(seen, relaxed).vertices[0].numpy()).max()
    stages = {
        "dots": partial(r.observer, image),
        "flow and rays (eq. 2)": partial(r.observation, displacement, confidence),
        "first contacts (eq. 29)": partial(segmentation.by_polar_angle, seen.directions),
        "Q, Q^T Q, smoother, volume (eqs. 18, 21, 28)": partial(estimator.programme, seen, relaxed),
        "factor": partial(system.factor, programme.stencil),
        "two solves (eqs. 25-27)": partial(system.substitute, factor, loads),
        "the solve, all of these three": partial(estimator.solve, seen, relaxed),
        "scipy twin of the solve": partial(twin, *frame),
        "contacts of the surface": partial(segmentation.by_normals, estimator.solve(seen, relaxed).vertices),
        "the whole loop": partial(estimator, seen),
        "image to result": partial(r, image),
    }
    for stage, milliseconds in least_milliseconds(stages, 15).items():
        print(f"the paper, {stage}: {milliseconds:.1f} ms", flush=True)
        yield dict(estimator="the paper", what=stage, milliseconds_a_frame=milliseconds)
    print(f"largest difference from the twin: {gap:.1e}")


def force_balance(args):
    sensor = tm.Sensor.from_file(args.sensor)
    reconstructor = tm.Reconstructor(replace(sensor, membrane=sensor.surface.membrane((17, 17))))
    estimator, exact = reconstructor.estimator, copy.deepcopy(reconstructor.estimator).double()
    displacement, confidence, covariance, _ = reconstructor.observer(reconstructor.read(args.image))
    frame = reconstructor.observation(displacement, confidence, covariance)
    frame = frame._replace(motion=torch.zeros_like(frame.motion))  # the twin's camera stays
    twin, single = BalanceTwin(exact), Observation(*(None if part is None else part[0].double() for part in frame))
    displacement = estimator(frame).vertices[0] - estimator.membrane.rest
    gap = np.abs(twin(single)[0] - displacement.numpy()).max()
    functions, batches = {"scipy twin, cold": partial(twin, single)}, {}
    for batch in args.batches:
        frames = Observation(*(None if part is None else part.expand(batch, *part.shape[1:]).contiguous() for part in frame))
        functions[f"batch {batch}, cold"] = partial(estimator, frames)
        batches[f"batch {batch}, cold"] = batch
        if args.compiled:
            compiled = torch.compile(estimator, fullgraph=True)
            functions[f"batch {batch}, compiled, cold"] = partial(compiled, frames)
            batches[f"batch {batch}, compiled, cold"] = batch
    times = {name: value / batches.get(name, 1) for name, value in least_milliseconds(functions, 5).items()}
    for name, value in times.items():
        ratio = value / times["scipy twin, cold"]
        print(
            f"force balance, 17 x 17, {len(single.confidence)} dots, {name}: {value:.1f} ms a frame, {ratio:.2f} of the twin",
            flush=True,
        )
        yield dict(estimator="force balance", what=name, milliseconds_a_frame=value, of_the_twin=ratio)
    print(f"largest difference from the twin: {gap:.1e}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="examples/sensor.toml")
    parser.add_argument("--image", default="examples/press_on_axis.png")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--batches", type=int, nargs="*", default=[1, 16, 64])
    parser.add_argument("--only", choices=("paper", "minimum-energy", "force-balance"))
    parser.add_argument("--compiled", action="store_true", help="force balance by torch.compile as well: minutes")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(args.threads)
    rows, parts = [], (paper, minimum_energy, force_balance)
    with torch.no_grad():
        for part in parts:
            if args.only in (None, part.__name__.replace("_", "-")):
                rows += part(args)
    write(args.json, dict(sensor=args.sensor, rows=rows))


if __name__ == "__main__":
    main()
