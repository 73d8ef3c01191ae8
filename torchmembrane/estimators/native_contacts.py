"""Contact patches as machine code: `ContactPatches.pushes` and `regions.persistent_peaks`, without gradients.

The formulas are those of `contacts` and `regions`, where they are explained; a test compares the numbers.
"""

from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from ..machine_code import Kept, compiled, fingerprint, kept
from ..solve import native_rows
from ..solve.native_rows import sum_rows, within
from ..surface.tangent import ALONG_Z
from .regions import CANDIDATES

TOLD = 14
"""Numbers that are told of a patch."""
TINY = 1e-37
"""Keeps quotients of what vanishes finite."""


Limits = tuple[float, float, float, float, float]


class Constants(NamedTuple):
    """Arrays and limits that stay the same for all frames of a membrane; see `contacts.ContactPatches`."""

    rest: Any
    """Vertices at rest `[m, n, 3]`, length unit."""
    area: Any
    """Area of each vertex at rest `[V]`."""
    near_rim: Any
    """`[V]`, 1 where a vertex is closer to the rim than `contacts.RIM` or the markers' spacing, else 0."""
    beside_rim: Any
    """`[V]`, weight of the displacement of the vertices beside the rim, 0 elsewhere."""
    surroundings: Any
    """`[N, N]`, a mean around every inner vertex in each column; where its rows are not zero, `places [N, 2]`."""
    places: Any
    pushed: float
    """This and the next four: the constants PUSHED, LEAST, APART, RIM_SHARE and MOVED of `contacts`."""
    least: float
    apart: float
    rim_share: float
    moved: float
    least_span: float
    """Smallest diameter of a patch whose curvatures are reported, length unit."""
    size: float
    """Size of the surface, length unit."""


@compiled
def _smoothed(c, push, height):
    """Return the push `[V]` smoothed twice; `height [V]` has zeros at the border."""
    m, n = c.rest.shape[:2]
    once, twice = np.empty(len(c.places), push.dtype), np.empty(len(c.places), push.dtype)
    for k in range(len(once)):
        twice[k] = push[(k // (n - 2) + 1) * n + k % (n - 2) + 1]
    sum_rows(once, c.surroundings, c.places, twice)
    sum_rows(twice, c.surroundings, c.places, once)
    height[:] = 0
    for k in range(len(once)):
        height[(k // (n - 2) + 1) * n + k % (n - 2) + 1] = twice[k]


@compiled
def _summits(height, m, n, up):
    """Apply `regions._summits`."""
    for v in range(m * n):
        best, up[v] = -np.inf, v
        for p in range(max(v // n - 1, 0), min(v // n + 2, m)):
            for q in range(max(v % n - 1, 0), min(v % n + 2, n)):
                if height[p * n + q] > best:
                    best, up[v] = height[p * n + q], p * n + q
    for v in range(m * n):
        while up[up[v]] != up[v]:
            up[v] = up[up[v]]


@compiled
def _passes(height, m, n, basin, passes):
    """Apply `regions._passes`."""
    passes[:] = -np.inf
    for v in range(m * n):
        for p in range(max(v // n - 1, 0), min(v // n + 2, m)):
            for q in range(max(v % n - 1, 0), min(v % n + 2, n)):
                a, b = basin[p * n + q], basin[v]
                if a >= 0 and b >= 0:
                    passes[a, b] = max(passes[a, b], min(height[p * n + q], height[v]))
    for k in range(len(passes)):
        for i in range(len(passes)):
            for j in range(len(passes)):
                passes[i, j] = max(passes[i, j], min(passes[i, k], passes[k, j]))


@compiled
def _peaks(c, height, peaks):
    """Apply `regions.persistent_peaks`: fill `peaks [P]` with vertices, the highest first, and return their number."""
    m, n = c.rest.shape[:2]
    up, place, count, found = np.empty(m * n, np.intp), np.empty(CANDIDATES, np.intp), 0, 0
    _summits(height, m, n, up)
    for v in range(m * n):
        if up[v] == v and height[v] > 0 and (count < CANDIDATES or height[v] > height[place[-1]]):
            k = min(count, CANDIDATES - 1)
            while k > 0 and height[place[k - 1]] < height[v]:
                place[k] = place[k - 1]
                k -= 1
            place[k], count = v, min(count + 1, CANDIDATES)
    basin, passes = np.full(m * n, -1), np.empty((count, count), height.dtype)
    for k in range(count):
        basin[place[k]] = k
    for v in range(m * n):
        basin[v] = basin[up[v]]
    _passes(height, m, n, basin, passes)
    for i in range(count):
        top, stands = height[place[i]], height[place[i]] >= c.least * height[place[0]]
        for j in range(i):
            stands = stands and not passes[i, j] > top - c.apart * top
        if stands and found < len(peaks):
            peaks[found] = place[i]
            found += 1
    return found


@compiled
def _owners(c, weight, peaks, found, owner):
    """Apply `contact_points`: return the number of the patch that each vertex belongs to; patch 0 is the strongest."""
    rest, loads, order = c.rest.reshape((-1, 3)), np.zeros(found), np.zeros(found, np.intp)
    for v in range(len(rest)):
        least = np.inf
        for k in range(found):
            away = 0.0
            for a in range(3):
                away += (rest[v, a] - rest[peaks[k], a]) ** 2
            if away < least:
                least, owner[v] = away, k
        loads[owner[v]] += weight[v]
    for k in range(found):
        for other in range(found):
            order[k] += loads[other] > loads[k] or (loads[other] == loads[k] and other < k)
    for v in range(len(rest)):
        owner[v] = order[owner[v]]


@compiled
def _areas(c, x, area):
    """Return `Membrane.vertex_area`."""
    m, n = c.rest.shape[:2]
    area[:] = 0
    for i in range(m - 1):
        for j in range(n - 1):
            for t in range(2):
                first, third = i * n + j, (i + 1) * n + j + 1
                second = third - 1 if t == 0 else third
                third = third if t == 0 else first + 1
                square = 0.0
                for a in range(3):
                    b, d = (a + 1) % 3, (a + 2) % 3
                    e1, e2 = x[second, b] - x[first, b], x[third, d] - x[first, d]
                    f1, f2 = x[second, d] - x[first, d], x[third, b] - x[first, b]
                    square += (e1 * e2 - f1 * f2) ** 2
                share = np.sqrt(square) / 6
                area[first] += share
                area[second] += share
                area[third] += share


@compiled
def _length(v):
    return np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@compiled
def _axes(normal, axes):
    """Return `tangent_frame` of a normal, and the normal itself."""
    x, y, z = normal[0], normal[1], normal[2]
    if abs(z) < ALONG_Z:
        axes[0, 0], axes[0, 1], axes[0, 2] = y, -x, 0.0
    else:
        axes[0, 0], axes[0, 1], axes[0, 2] = 0.0, z, -y
    length = max(_length(axes[0]), 1e-12)
    for a in range(3):
        axes[0, a] /= length
        axes[2, a] = normal[a]
    for a in range(3):
        b, d = (a + 1) % 3, (a + 2) % 3
        axes[1, a] = normal[b] * axes[0, d] - normal[d] * axes[0, b]


@compiled
def _curvature(c, x, mine, strong, share, axes, curvature):
    """Return `ContactPatches._curvature` of the vertices `mine`, and their extent."""
    local, mean, spread2, sums, t = np.empty((len(mine), 3)), np.zeros(3), 0.0, np.zeros((6, 7)), np.empty(7)
    for i in range(len(mine)):
        for a in range(3):
            local[i, a] = axes[a, 0] * x[mine[i], 0] + axes[a, 1] * x[mine[i], 1] + axes[a, 2] * x[mine[i], 2]
            mean[a] += share[i] * local[i, a]
    for i in range(len(mine)):
        spread2 += share[i] * ((local[i, 0] - mean[0]) ** 2 + (local[i, 1] - mean[1]) ** 2)
    spread = np.sqrt(max(spread2, (1e-6 * c.size) ** 2))
    for i in range(len(mine)):
        u, v, z = (local[i, 0] - mean[0]) / spread, (local[i, 1] - mean[1]) / spread, (local[i, 2] - mean[2]) / spread
        t[0], t[1], t[2], t[3], t[4], t[5], t[6] = 1.0, u, v, u * u / 2, u * v, v * v / 2, z
        for a in range(6):
            for b in range(7):
                sums[a, b] += strong[i] * t[a] * t[b]
    for a in range(6):
        sums[a, a] += 1e-6
    for a in range(6):
        for b in range(6):
            by = sums[b, a] / sums[a, a] if b != a else 0.0
            for e in range(a, 7):
                sums[b, e] -= by * sums[a, e]
    for a in range(6):
        t[a] = sums[a, 6] / sums[a, a]
    by_u, by_v, uu, uv, vv = t[1], t[2], t[3], t[4], t[5]
    steep = 1 + by_u * by_u + by_v * by_v
    middle = ((1 + by_v * by_v) * uu - 2 * by_u * by_v * uv + (1 + by_u * by_u) * vv) / (2 * steep * np.sqrt(steep))
    gauss = (uu * vv - uv * uv) / (steep * steep)
    apart = np.sqrt(max(middle * middle - gauss, 1e-12))
    curvature[0], curvature[1] = (middle + apart) / spread, (middle - apart) / spread
    return np.sqrt(8.0) * spread


@compiled
def _told(c, x, normals, traction, indicator, area, mine, told):
    """Return the properties of a patch, `told [14]`: point, force, normal, area, slip, two curvatures, whether it touches the
    rim, and the largest displacement beside the rim there."""
    strong, share, sums, axes = np.zeros(len(mine)), np.zeros(len(mine)), np.zeros((4, 3)), np.empty((3, 3))
    pushes, whole, strongest, at_rim, beside = 0.0, 0.0, 0.0, 0.0, 0.0
    rest, load, normal_force = c.rest.reshape((-1, 3)), np.empty(3), 0.0
    for i in range(len(mine)):
        v, inward, away2 = mine[i], 0.0, 0.0
        for a in range(3):
            load[a] = traction[v, a] * c.area[v]
            inward -= load[a] * normals[v, a]
            away2 += (x[v, a] - rest[v, a]) ** 2
        push = max(inward, 0.0) if indicator[v] > c.pushed else 0.0
        strong[i], share[i] = push * (push / c.area[v]), area[v] if indicator[v] > c.pushed else 0.0
        for a in range(3):
            sums[0, a] += push * x[v, a]
            sums[1, a] += load[a]
            sums[2, a] += load[a] + inward * normals[v, a]
            sums[3, a] += strong[i] * normals[v, a]
        pushes, whole, strongest = pushes + push, whole + share[i], strongest + strong[i]
        normal_force, at_rim = normal_force + inward, at_rim + push * c.near_rim[v]
        beside = max(beside, np.sqrt(away2) * c.beside_rim[v])
    length = max(_length(sums[3]), 1e-12)
    for a in range(3):
        told[a], told[3 + a], told[6 + a] = sums[0, a] / max(pushes, TINY), sums[1, a], sums[3, a] / length
    for i in range(len(mine)):
        strong[i], share[i] = strong[i] / max(strongest, TINY), share[i] / max(whole, TINY)
    told[9], told[10] = whole, _length(sums[2]) / normal_force if normal_force > 0 else np.nan
    _axes(told[6:9], axes)
    if not _curvature(c, x, mine, strong, share, axes, told[11:13]) >= c.least_span:
        told[11:13] = np.nan
    told[13] = at_rim > c.rim_share * pushes
    return beside


def _entry(sources: str) -> Any:
    @kept
    def patches(c, x, normals, traction, reference, indicator, told):
        """Fill `indicator [B, V]` and `told [B, P, 14]` for frames `[B, V, 3]` and `[B, V]`."""
        V = x.shape[1]
        push, weight, height, area = np.empty((4, V), x.dtype)
        owner, peaks, mine = np.empty(V, np.intp), np.empty(told.shape[1], np.intp), np.empty(V, np.intp)
        told[:] = np.nan
        rest = c.rest.reshape((-1, 3))
        for f in range(len(x) if sources else 0):
            farthest = 0.0
            for v in range(V):
                inward, away2 = 0.0, 0.0
                for a in range(3):
                    inward -= traction[f, v, a] * normals[f, v, a]
                    away2 += (x[f, v, a] - rest[v, a]) ** 2
                inward = max(inward, 0.0)
                indicator[f, v] = inward / (inward + reference[f, v] / 2)
                push[v] = inward if indicator[f, v] > c.pushed else 0.0
                weight[v], farthest = push[v] * c.area[v], max(farthest, np.sqrt(away2))
            _smoothed(c, push, height)
            found = _peaks(c, height, peaks)
            if found > 0:
                owner[:] = 0
                _owners(c, weight, peaks, found, owner)
                _areas(c, x[f], area)
            for k in range(found):
                count = 0
                for v in range(V):
                    if owner[v] == k:
                        mine[count], count = v, count + 1
                beside = _told(c, x[f], normals[f], traction[f], indicator[f], area, mine[:count], told[f, k])
                told[f, k, 13] = told[f, k, 13] > 0 and beside > c.moved * farthest

    return patches


SOURCES = fingerprint(__file__, native_rows.__file__)
patches = _entry(SOURCES)
kept_patches = Kept(patches, SOURCES, 12)


class NativePatches:
    """The patches of one membrane. Constants are looked up again after a move to another device or precision."""

    def __init__(self) -> None:
        self._constants: tuple[Tensor, Constants] | None = None

    def __reduce__(self) -> tuple[Any, tuple[()]]:
        return type(self), ()

    def __call__(self, owner: Any, count: int, limits: Limits, surroundings: Tensor, *frames: Tensor) -> tuple[Tensor, ...]:
        """What `Contacts` holds, of `frames`: surface, normals, traction and reference; `limits`: of `contacts`, as the
        `Constants` have them."""
        if self._constants is None or self._constants[0] is not surroundings:
            self._constants = surroundings, _constants(owner, surroundings, limits)
        given = [value.contiguous() for value in frames]
        x = given[0]
        indicator, told = x.new_empty(x.shape[:2]), x.new_empty(len(x), count, TOLD)
        with kept_patches.compiling(x.numpy().dtype):
            patches(self._constants[1], *(value.numpy() for value in given), indicator.numpy(), told.numpy())
        points, force, normal, area, slip, curvature, at_rim = told.split([3, 3, 3, 1, 1, 2, 1], -1)
        return indicator, points, force, normal, area[..., 0], slip[..., 0], curvature, at_rim[..., 0]


def _constants(owner: Any, surroundings: Tensor, limits: Limits) -> Constants:
    membrane = owner.membrane
    dtype = membrane.rest.numpy().dtype
    rows = np.ascontiguousarray(surroundings.numpy(), dtype)
    rest = np.ascontiguousarray(membrane.rest.numpy().reshape(*membrane.grid, 3))
    area, near, beside = (each.numpy().astype(dtype) for each in (membrane.rest_area, owner.near_rim, owner.beside_rim))
    return Constants(rest, area, near, beside, rows, within(rows), *limits, owner.least_span, membrane.size)
