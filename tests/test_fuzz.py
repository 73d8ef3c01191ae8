"""Damaged and hostile files, a few of each kind: `make soak` tries as many as there is time for."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_damaged_files_are_refused_in_one_line_or_answered():
    """In a process of its own, whose memory is limited."""
    command = [sys.executable, "bench/fuzz.py", "--sensors", "120", "--images", "120", "--seed", "7"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "refused" in done.stdout and "answered, OK" in done.stdout
