"""Vectors in machine code give the numbers of the formula."""

import json
import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from torchmembrane import vectors
from torchmembrane.vectors import BYTES, load, spread, store, total


@numba.njit
def compute(a, b, found):
    """Formulas of two arrays, a vector at a time from place 3 on."""
    for k in range(3, 3 + len(found), BYTES // a.itemsize):
        x, y = load(a, k), load(b, k)
        store(found, k - 3, 2.0 * x - y / x + (y - spread(a, 1)) * 0.5 - 1 + x * y)


@numba.njit
def summed(a, found):
    """The sum of the vectors of an array, which a loop carries along in a pair."""
    both = load(a, 0) * 0.0, load(a, 0)
    for k in range(0, a.size, BYTES // a.itemsize):
        both = both[0] + load(a, k), load(a, k)
    store(found, 0, both[0])


@numba.njit
def totals(a, sums):
    """The sum of each vector of an array."""
    for k in range(len(sums)):
        sums[k] = total(load(a, k * a.size // len(sums)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_total_is_the_sum_of_the_numbers_of_one_vector(dtype):
    lanes, sums = BYTES // np.dtype(dtype).itemsize, np.zeros(3, dtype)
    a = np.arange(3 * lanes, dtype=dtype)
    totals(a, sums)
    np.testing.assert_array_equal(sums, a.reshape(3, lanes).sum(1))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_each_number_is_that_of_the_formula(dtype):
    lanes = BYTES // np.dtype(dtype).itemsize
    a, b = np.random.default_rng(0).uniform(1, 2, (2, 3 + 5 * lanes)).astype(dtype)
    found = np.zeros(5 * lanes, dtype)
    compute(a, b, found)
    x, y = a[3:], b[3:]
    np.testing.assert_allclose(found, 2 * x - y / x + (y - a[1]) / 2 - 1 + x * y, rtol=20 * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_places_count_through_all_dimensions_and_loops_carry_vectors(dtype):
    lanes = BYTES // np.dtype(dtype).itemsize
    a, found = np.arange(6 * lanes, dtype=dtype).reshape(2, 3, lanes), np.zeros(lanes, dtype)
    summed(a, found)
    np.testing.assert_array_equal(found, a.sum((0, 1)))


def test_nan_and_infinity_keep_their_meaning():
    a = np.full(3 + BYTES // 8, 1.0)
    b, found = a.copy(), np.zeros(BYTES // 8)
    a[3], b[4] = np.nan, np.inf
    compute(a, b, found)
    assert np.isnan(found[0]) and not np.isfinite(found[1]) and np.isfinite(found[2:]).all()


@pytest.mark.parametrize("features, size", [("+avx,+avx2,+fma", 32), ("+avx2,+avx512f,+fma", 64), ("", 32)])
def test_a_vector_is_as_long_as_a_register(features, size, monkeypatch):
    """Of what numba compiles for, whatever processor this is."""
    for host, told in ((features, None), ("+avx2,+avx512f" if size == 32 else "+avx2", features)):
        monkeypatch.setattr(vectors.config, "CPU_FEATURES", told)
        monkeypatch.setattr(vectors.binding, "get_host_cpu_features", lambda host=host: Features(host))
        assert vectors._bytes() == size


class Features(str):
    """The features of a processor."""

    def flatten(self):
        return str(self)


def test_numbers_are_the_same_without_the_longest_registers():
    """In another process, told that the processor has none of its later features."""
    program = "import numpy as np, test_vectors as t; a = np.linspace(1, 2, 99, dtype='f'); c = np.zeros(64, 'f'); "
    program += "t.compute(a, a[::-1].copy(), c); print(t.BYTES, c.tolist())"
    told = dict(os.environ, NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="", PYTHONPATH=os.pathsep.join(sys.path))
    done = subprocess.run(
        [sys.executable, "-c", program], env=told, cwd=os.path.dirname(__file__), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    size, numbers = done.stdout.split(" ", 1)
    a, found = np.linspace(1, 2, 99, dtype="f"), np.zeros(64, "f")
    compute(a, a[::-1].copy(), found)
    assert size == "32"
    np.testing.assert_allclose(json.loads(numbers), found, rtol=1e-5)
