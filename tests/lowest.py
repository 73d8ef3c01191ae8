"""The quick start works with the lowest versions of dependencies.

Images of the examples are reconstructed by minimum energy and by force balance, and a gradient is taken through the latter.
"""

import warnings
from importlib.metadata import version
from pathlib import Path

import torch

import torchmembrane as tm

EXAMPLES = Path(__file__).parents[1] / "examples"
LOWEST = Path(__file__).parents[1] / "constraints-lowest.txt"


def installed_are_lowest() -> bool:
    """Whether each dependency has the version that the constraints say."""
    pins = dict(line.split("==") for line in LOWEST.read_text().splitlines() if "==" in line)
    others = {name: version(name) for name, pin in pins.items() if version(name).partition("+")[0] != pin}
    print("installed:", ", ".join(f"{name} {version(name)}" for name in pins))
    return not others


def main() -> None:
    warnings.simplefilter("ignore")
    assert installed_are_lowest(), "expected the versions of constraints-lowest.txt"
    for estimator in ("minimum-energy", "force-balance"):
        reconstructor = tm.Reconstructor.from_file(EXAMPLES / "sensor.toml", estimator)
        images = reconstructor.read(EXAMPLES / "two_contacts.png", EXAMPLES / "flat_plate.png")
        with torch.no_grad():
            result = reconstructor(images)
        assert result.status.tolist() == [0, 0], f"{estimator}: statuses {result.status.tolist()}"
        assert result.displacement.norm(dim=-1).amax() > 0.5, f"{estimator}: nothing is pressed"
        print(f"{estimator}: depth {result.displacement.norm(dim=-1).amax(-1).tolist()}, force {result.force.tolist()}")
    pixels = result.pixels.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(reconstructor.from_pixels(pixels).force.square().sum(), pixels)
    assert gradient.isfinite().all() and gradient.abs().max() > 0, "the gradient is zero or not finite"
    print(f"gradient: largest {gradient.abs().max().item():.3g}")


if __name__ == "__main__":
    main()
