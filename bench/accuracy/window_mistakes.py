"""Forces of an inflated window when one number of its sensor file is wrong: the table of docs/own_window.md.

python -m bench.accuracy.window_mistakes [--json FILE]

The window and the press of that page, and a ball pressed 2.5 mm into its middle, photographed by the simulator. For each row
the sensor file is drafted from the rest photograph with one number wrong, as `torchmembrane init` does, and both photographs
are reconstructed. Printed: forces found over true, and the rise of the pressure, hPa.
"""

import argparse
import re
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from torchmembrane.cli.main import main as command
from torchmembrane.sensor.units import hectopascal

TRUE = {"size": "50,36", "corner": "4", "height": "6mm", "overpressure": "12hPa", "prestretch": "1.07"}
PRESSES = {"angle": "--depth 3 --direction 0.3,0.2,0.93 --friction 0.3", "middle": "--depth 2.5 --direction 0,0,1"}
ROWS = {
    "nothing": {},
    "prestretch 1.02": {"prestretch": "1.02"},
    "prestretch 1.1, as assumed": {"prestretch": "1.1"},
    "prestretch 1.2": {"prestretch": "1.2"},
    "height 5.7 mm": {"height": "5.7mm"},
    "height 6.3 mm": {"height": "6.3mm"},
    "gauge 5 % too high": {"overpressure": "12.6hPa"},
    "rim 51 x 37 mm": {"size": "51,37"},
}


def run(line: str) -> None:
    """A command of torchmembrane, without what it prints."""
    with redirect_stdout(StringIO()) as said:
        code = command(line.split())
    assert code == 0, said.getvalue()


def drafted(path: Path, numbers: dict[str, str], more: str) -> None:
    """A sensor file by `init`."""
    stated = " ".join(f"--{name} {value}" for name, value in numbers.items())
    run(f"init {path} --shape rectangle {stated} --distance 40 --focal 480 {more}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    args, rows = parser.parse_args(), []
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drafted(folder / "real.toml", TRUE, "--thickness 0.2 --image-size 640,480 --pitch 3.6")
        truths = {}
        for press, options in PRESSES.items():
            run(f"simulate {folder}/real.toml --indenter sphere --radius 6 {options} --noise 40 --out {folder} --name {press}")
            truth = np.load(folder / f"{press}_truth.npz")
            truths[press] = float(np.linalg.norm(truth["force"])), float(truth["p"] - truth["p0"]) / hectopascal("mm")
        print("true rise of the pressure, hPa:", ", ".join(f"{rise:.2f}" for _, rise in truths.values()))
        for row, wrong in ROWS.items():
            path = folder / f"{re.sub(r'[^a-z0-9]+', '_', row)}.toml"
            drafted(path, TRUE | wrong, f"--rest {folder}/sensor_rest.png")
            reconstructor = tm.Reconstructor.from_file(path)
            with torch.no_grad():
                found = reconstructor(reconstructor.read(*(folder / f"{press}.png" for press in PRESSES)))
            ratios = [float(f.norm()) / force for f, (force, _) in zip(found.force, truths.values(), strict=True)]
            rises = (found.pressure_change.double() / hectopascal("mm")).tolist()
            rows.append(dict(wrong=row, forces=ratios, rises=rises, status=found.status.tolist()))
            cells = [row, *(f"{ratio:.2f}" for ratio in ratios), ", ".join(f"{rise:.2f}" for rise in rises)]
            print(f"| {' | '.join(cells)} | status {found.status.tolist()}", flush=True)
    write(args.json, dict(true_rises=[rise for _, rise in truths.values()], rows=rows))


if __name__ == "__main__":
    main()
