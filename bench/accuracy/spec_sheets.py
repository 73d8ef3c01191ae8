"""Spec sheets, as `torchmembrane check SENSOR.toml --accuracy` prints them, and their processor time.

python -m bench.accuracy.spec_sheets [SENSOR.toml|preset:NAME ...] [--seed 0] [--jobs 1] [--json FILE]

Without a sensor, of examples/sensor.toml and of the preset bubble. Printed: the lines of each sheet, and its seconds.
"""

import argparse
import time
import warnings
from pathlib import Path

import torch

import torchmembrane as tm
from bench.data.record import write
from torchmembrane.accuracy.measure import spec_sheet
from torchmembrane.cli.sheet import sheet_lines
from torchmembrane.presets import sensor_file

SENSORS = ["examples/sensor.toml", "preset:bubble"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sensors", nargs="*", default=SENSORS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    sheets = []
    for name in args.sensors:
        start = time.process_time()
        lines = sheet_lines(spec_sheet(tm.Sensor.from_file(sensor_file(name)), args.seed, jobs=args.jobs))
        sheets.append(dict(sensor=name, lines=lines, seconds=time.process_time() - start))
        print(*lines, f"{name}: {sheets[-1]['seconds']:.0f} s", sep="\n", flush=True)
    write(args.json, dict(sheets=sheets))


if __name__ == "__main__":
    main()
