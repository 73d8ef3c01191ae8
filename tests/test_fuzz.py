"""Damaged and malformed files break no rule: a few of each kind."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FEW = [
    "sensors=40",
    "images=40",
    "npz=20",
    "parquet=20",
    "readings=35",
    "dots=35",
    "motions=35",
    "forces=35",
    "rims=15",
    "videos=15",
]
MORE = [
    "sensors=120",
    "images=120",
    "npz=60",
    "parquet=60",
    "readings=100",
    "dots=100",
    "motions=100",
    "forces=100",
    "rims=60",
    "videos=30",
]


@pytest.mark.parametrize("counts, lines", [(FEW, ["--lines", "9"]), pytest.param(MORE, [], marks=pytest.mark.full)])
def test_damaged_files_are_refused_in_one_line_or_answered(counts, lines):
    """In a process of its own, whose memory is limited."""
    command = [sys.executable, "-m", "bench.robustness.fuzz", "--count", *counts, "--seed", "7", *lines]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "refused" in done.stdout and "answered, OK" in done.stdout and "decoded, in part" in done.stdout
