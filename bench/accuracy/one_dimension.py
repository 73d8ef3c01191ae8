"""The experiments of Figs. 19 and 20: a half cylinder's cross-section pressed by one cylinder (4 mm) and at two points (2 mm).

python -m bench.accuracy.one_dimension [--json FILE]

Radius 15 mm, prestretch 1.2, 31 markers seen from the centre with 0.2 mrad noise (0.05 px at 240 px/rad); data from the
closed form (estimators/paper/studies/pressed_strip.py), the estimators' polygons have 60 edges. Printed: rms error at the
markers over their
displacement, largest depth found and true, the discs' total force and the pressure against the truth. Medians over
eight draws of the noise.
"""

import argparse
from pathlib import Path

import numpy as np

from bench.data.record import write
from torchmembrane.estimators.paper.studies.pressed_strip import Disc, PressedStrip
from torchmembrane.estimators.paper.studies.profile import ForceBalanceProfile, MinimumEnergyProfile, StripProfile
from torchmembrane.estimators.paper.studies.strip import Strip

RADIUS, NODES, MARKERS, ANGLE_NOISE, DRAWS = 15.0, 61, 31, 2e-4, 8
STRIPS = {"neo-Hookean": Strip("neo_hookean", 1.2), "harmonic": Strip("harmonic", 1.2)}
EXPERIMENTS = {
    "one cylinder, radius 5, 4 mm": [Disc.pressed(RADIUS, 90, 4.0, 5.0)],
    "the same, 60 degrees": [Disc.pressed(RADIUS, 60, 4.0, 5.0)],
    "two points, 2 mm": [Disc.pressed(RADIUS, angle, 2.0, 0.0) for angle in (60, 120)],
}


def observed(truth: PressedStrip, draw: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rest angles of the markers, the angles at which they are seen, with noise, and where they are."""
    theta = np.linspace(0, np.pi, MARKERS + 2)[1:-1]
    place = truth.positions(np.rad2deg(theta))
    return (
        theta,
        np.arctan2(place[:, 1], place[:, 0]) + ANGLE_NOISE * np.random.default_rng(draw).standard_normal(MARKERS),
        place,
    )


def score(profile: StripProfile, theta, place, truth: PressedStrip, strip: Strip, share: float) -> dict[str, float]:
    rest = RADIUS * np.stack([np.cos(theta), np.sin(theta)], -1)
    force, found = truth.forces(strip).sum(0), (profile.traction * share).sum(0).numpy()
    fine = truth.positions(np.linspace(0, 180, 2001))
    return dict(
        error=float(np.sqrt(((profile.at(theta) - place) ** 2).sum() / ((rest - place) ** 2).sum())),
        depth=float(RADIUS - profile.nodes.norm(dim=-1).min()),
        true_depth=float(RADIUS - np.linalg.norm(fine, axis=1).min()),
        force=float(np.linalg.norm(found - force) / np.linalg.norm(force)),
        pressure=float(profile.pressure / truth.pressure(strip) - 1),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for name, discs in EXPERIMENTS.items():
        truth = PressedStrip(RADIUS, discs)
        for material, strip in STRIPS.items():
            for estimator in (
                MinimumEnergyProfile(RADIUS, strip, NODES),
                ForceBalanceProfile(RADIUS, strip, NODES, 2 * ANGLE_NOISE),
            ):
                draws = []
                for draw in range(DRAWS):
                    theta, psi, place = observed(truth, draw)
                    draws.append(score(estimator(theta, psi), theta, place, truth, strip, estimator.share))
                median = {key: float(np.median([d[key] for d in draws])) for key in draws[0]}
                rows.append(dict(experiment=name, material=material, estimator=type(estimator).__name__, **median))
                print(
                    "{experiment:28s} {material:11s} {estimator:20s} error {error:.2f}, "
                    "depth {depth:.2f} of {true_depth:.2f} mm, force off {force:.2f}, pressure {pressure:+.2f}".format(
                        **rows[-1]
                    )
                )
    write(args.json, dict(profile=rows))


if __name__ == "__main__":
    main()
