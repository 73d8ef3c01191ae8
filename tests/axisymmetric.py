"""An independent twin of the estimator for round membranes.

A flat disc of radius 1 at z = 1 is seen from the origin; the material circle s is observed at image radius `phi(s)`
(z = 1 plane), so that its points are `t(s) (phi cos a, phi sin a, 1)`. The energy of the principal stretches
`m = |d(t phi, t)/ds|` and `n = t phi / s` is minimised over `t(s)`, `t(1) = 1`, by the midpoint rule and Newton's method.
"""

import numpy as np
from scipy.linalg import solve_banded

NODES = 800


def phi(s, amplitude):
    return s * (1 + amplitude * (1 - s**2))


def harmonic(m2, n2):
    """Derivatives of `(m^2 + n^2) / 2` in `m^2` and `n^2`."""
    return 0.5 + 0 * m2, 0.5 + 0 * n2


def neo_hookean(prestretch):
    """Derivatives of `(l^2 (m^2 + n^2) + 1 / (l^4 m^2 n^2)) / 2`."""
    l2 = prestretch**2
    return lambda m2, n2: (0.5 * (l2 - 1 / (l2**2 * m2**2 * n2)), 0.5 * (l2 - 1 / (l2**2 * m2 * n2**2)))


def least_energy(amplitude, slopes, keep_volume):
    """Depth `t(s)` as a function, and the multiplier (pressure) of the volume `1/3 int t^3 phi phi' ds` if it is kept."""
    s = np.linspace(0, 1, NODES + 1)
    h, mid, f = 1 / NODES, (s[1:] + s[:-1]) / 2, phi(s, amplitude)

    def force(free):
        t = np.append(free, 1.0)
        hoop = (t * f)[1:] / 2 / mid + (t * f)[:-1] / 2 / mid
        along, dt = np.diff(t * f) / h, np.diff(t) / h
        dm, dn = (d * mid * h for d in slopes(along**2 + dt**2, hoop**2))
        a, b, c = 2 * dm * along / h, 2 * dm * dt / h, dn * hoop / mid
        nodal = np.zeros(NODES + 1)
        nodal[1:] += (a + c) * f[1:] + b
        nodal[:-1] += (c - a) * f[:-1] - b
        return nodal[:-1]

    def volume(free):
        t = np.append(free, 1.0)
        weight, level = np.diff(f**2) / 2, (t[1:] + t[:-1]) / 2
        nodal = np.zeros(NODES + 1)
        nodal[1:] += level**2 * weight / 2
        nodal[:-1] += level**2 * weight / 2
        return (level**3 * weight).sum() / 3, nodal[:-1]

    t, p = np.ones(NODES), 0.0
    for _ in range(15):
        V, v = volume(t)
        residual = lambda u: force(u) - p * volume(u)[1]  # noqa: B023, E731
        K = _tridiagonal(residual, t)
        y, w = solve_banded((1, 1), K, np.stack([-residual(t), v], 1)).T
        rise = (1 / 6 - V - v @ y) / (v @ w) if keep_volume else 0.0
        t, p = t + y + rise * w, p + rise
    assert np.abs(y + rise * w).max() < 1e-9
    return lambda q: np.interp(q, s, np.append(t, 1.0)), p


def _tridiagonal(function, t):
    band = np.zeros((3, NODES))
    for colour in range(3):
        nudge = np.zeros(NODES)
        nudge[colour::3] = 1e-6
        slope = (function(t + nudge) - function(t - nudge)) / 2e-6
        column = np.arange(colour, NODES, 3)
        for offset in (-1, 0, 1):
            inside = (column + offset >= 0) & (column + offset < NODES)
            band[1 + offset, column[inside]] = slope[(column + offset)[inside]]
    return band
