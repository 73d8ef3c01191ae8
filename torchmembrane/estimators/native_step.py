"""A step of force balance by machine code made here: what `Descent.step` does, frame by frame, without gradients.

On a processor the tensor operations of a step, some six hundred, take longer to begin than to work: on 33 x 33 vertices three
times, on 9 x 9 thirty times as long as this. The formulas are those of `contact_force`, `traction_loss`, `bearings`,
`normal_equations`, `camera_motion` and `descent`, which say what they mean; tests hold both to the same numbers.
"""

from typing import Any, NamedTuple

import numpy as np

from ..mechanics.native_membrane import STENCIL, Surface, linearise
from ..solve.native_band import LANES, RANK, backward, compiled, factor, forward, storage
from .camera_motion import RARE
from .traction_loss import POWER, TINY

RIDGES = (0.0, 1e-6, 1e-5, 1e-4)
"""Added, one instead of the other, to a diagonal about 1 of a matrix that rounding has left without a factor."""
LOADS = 7
NOTHING = 1e-22
"""Of what is summed, beside `TINY`."""


class Constants(NamedTuple):
    """What is constant of an estimator on one grid."""

    surface: Surface
    area: Any
    """`[N]`, of the inner vertices."""
    surroundings: Any
    """`[N, N]`, column k the mean around vertex k; as `wider`."""
    surroundings_within: Any
    """`[N, 2]`: where row i begins and ends to be more than zero."""
    wider: Any
    wider_within: Any
    push_noise: Any
    """`[N]`"""
    positions: Any
    """`[D, 3]`, of the markers at rest."""
    smooth: tuple[Any, Any]
    """Numbers of inner vertices and their shares in the markers' displacement, `[D, K]` each."""
    corners: tuple[Any, Any]
    """The same in what markers pull, `[D, 3]`."""
    numbers: "Numbers"


class Numbers(NamedTuple):
    """Settings, and other numbers of an estimator."""

    reference: float
    size: float
    friction: float
    slip: float
    sparsity: float
    floor: float
    last_tau: float
    first_tau: float
    scale_share: float
    far_share: float
    noise_share: float
    decrease: float
    least_scale: float
    camera_motion: float
    longest_step: float
    largest_stretch: float
    rest_pressure: float
    is_open: bool
    is_gas: bool
    absolute: float
    gas_volume: float


class Workspace(NamedTuple):
    """Arrays of a step, made once: to make them would take longer than what is done in them."""

    force: Any
    """`[m, n, 3]`; as `volume`, the volume's gradient."""
    volume: Any
    A: Any
    """`[m, n, 3, 21]`, the tangent stiffness; its rows once weighted: `weighted [3, 24]`."""
    weighted: Any
    normal: Any
    """`[N, 3]`"""
    W: Any
    """`[N, 3, 3]`"""
    fields: Any
    """`[4, N]`"""
    blocks: Any
    """`[D, 3, 3]`, of the markers."""
    U: Any
    """The matrix, and `inverse [3 N]`, `panel` and its `scale [3 N]`, as `native_band` stores them."""
    inverse: Any
    panel: Any
    scale: Any
    loads: Any
    """`[7, 3 N]`: of the volume, the forces, the fluid, the camera's four motions."""
    width: int
    """Diagonals of the matrix above the main one."""


def workspace(grid: tuple[int, int], markers: int, dtype: Any) -> Workspace:
    """Arrays for a grid and so many markers."""
    m, n = grid
    N, width = (m - 2) * (n - 2), 3 * (2 * (n - 2) + 2) + 2  # to two lines, two vertices and two components further
    unknowns, rows, ld = storage(3 * N, width)
    shapes = dict(force=(m, n, 3), volume=(m, n, 3), A=(m, n, 3, 21), weighted=(3, 24), normal=(N, 3), W=(N, 3, 3))
    shapes |= dict(fields=(4, N), blocks=(markers, 3, 3), inverse=(unknowns,), panel=(RANK * ld,), scale=(unknowns,))
    arrays = {name: np.zeros(shape, dtype) for name, shape in shapes.items()}
    return Workspace(U=_aligned(rows * ld, dtype), loads=np.zeros((LOADS, unknowns), dtype), width=width, **arrays)


def _aligned(size: int, dtype: Any) -> Any:
    whole = np.zeros(size + 64, dtype)
    first = -whole.ctypes.data % 64 // whole.itemsize
    return whole[first : first + size]


@compiled
def step(c, work, u, pressure, moved, before, origins, across, weight, noise_level, motion, gauge, scales):
    """From a state to the next: `u [m, n, 3]`, `pressure [1]`, `moved [4]`, `before [N]` (weights of normal tractions) change.

    `origins [3, D]`, `across [2, 3, D]`, `weight [D]`, `noise_level`, `motion [2, 4, D]`, `gauge [2]`: what is measured;
    `scales`: tau, outlier, cone, renewal, damping.
    """
    tau, outlier, cone, renewal, damping = scales
    k, (m, n) = c.numbers, c.surface.free.shape
    width, ld, unknowns = work.width, len(work.panel) // RANK, len(work.inverse)
    rise = linearise(c.surface, u, pressure[0], work.force, work.A, work.volume)
    _weigh(c, work, before, noise_level, tau, cone, renewal)
    own, slope, products = np.zeros((4, 4)), np.zeros(4), np.zeros((LOADS, LOADS))
    fWv, vWv = _load_forces(c, work)
    _load_markers(c, work, u, moved, origins, across, weight, motion, outlier, own, slope)
    for ridge in RIDGES:
        _assemble(c, work, ld, damping, ridge)
        if factor(work.U, ld, width, unknowns, work.inverse, work.panel):
            break
    else:
        work.loads[:] = np.nan
    loads = work.loads
    loads *= work.scale
    forward(work.U, ld, width, unknowns, work.inverse, loads)
    for a in range(LOADS):
        for b in range(a + 1):
            products[a, b] = products[b, a] = _dot(loads[a], loads[b])
    play = k.camera_motion * (min(tau, k.first_tau) / k.last_tau) ** 2
    stiffness = RARE / (play**2 + _dot(moved, moved))
    for a in range(4):
        own[a, a] += stiffness
        slope[a] += stiffness * moved[a]
    following = _camera_eliminated(products, own, slope)
    multiplier, one, change = _shares(k, products, rise, pressure[0], fWv, vWv, gauge)
    solved = loads[0]
    for i in range(unknowns):
        solved[i] = multiplier * loads[0, i] + one * loads[1, i] + change * loads[2, i]
    turn = np.empty_like(moved)
    for a in range(4):
        turn[a] = multiplier * following[a, 0] + one * following[a, 1] + change * following[a, 2]
        for i in range(unknowns):
            solved[i] += turn[a] * loads[3 + a, i]
    backward(work.U, ld, width, unknowns, work.inverse, solved)
    solved *= -work.scale
    move = solved[: 3 * (m - 2) * (n - 2)].reshape((m - 2, n - 2, 3))
    share = _share(c, u, move)
    u[1:-1, 1:-1] += share * move
    pressure[0] += share * change
    moved += share * turn


@compiled
def _dot(a, b):
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled
def _weigh(c, work, before, noise_level, tau, cone, renewal):
    """`TractionLoss.weights`: `W`, and `before` becomes the weights of the normal tractions."""
    k, N, (m, n) = c.numbers, len(c.area), c.surface.free.shape
    q_n, shear2, push2, around = work.fields
    for i in range(N):
        p, q = i // (n - 2) + 1, i % (n - 2) + 1
        v, f = work.volume[p, q], work.force[p, q]
        length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        for a in range(3):
            work.normal[i, a] = v[a] / length if length > 0 else v[a]
        normal = work.normal[i]
        along = f[0] * normal[0] + f[1] * normal[1] + f[2] * normal[2]
        across2 = 0.0
        for a in range(3):
            across2 += (f[a] - along * normal[a]) ** 2
        unit = c.area[i] * k.reference
        q_n[i], shear2[i] = along / unit, across2 / unit**2
    push2[:] = 0
    for i in range(N):
        if not q_n[i] >= 0:
            _add(push2, c.surroundings[i], q_n[i] ** 2, c.surroundings_within[i])
    top = TINY
    for i in range(N):
        top = max(top, push2[i])
    around[:] = 0
    for i in range(N):
        share = (push2[i] / top) ** POWER
        if not share < NOTHING:
            _add(around, c.wider[i], share, c.wider_within[i])
    least = min(k.decrease * (tau / k.last_tau - 1) + k.least_scale, 1.0) ** 2
    for i in range(N):
        expected = top * max(around[i], TINY) ** (1 / POWER) * k.scale_share**2
        expected = max(expected, top * k.far_share**2, (k.noise_share * noise_level * c.push_noise[i]) ** 2)
        rho2 = min(max(expected / k.last_tau**2, least), 1.0)
        pushed = push2[i] / rho2
        w_n = k.floor + ((1 + pushed / tau**2) ** -2 if q_n[i] < 0 else 1.0)
        w_n = before[i] * (w_n / before[i]) ** renewal
        w_t = k.friction / (1 + cone * np.sqrt(pushed + k.slip**4)) / np.sqrt(shear2[i] / rho2 + k.slip**2)
        scale = k.sparsity / (k.reference * k.size) ** 2 / c.area[i] / rho2
        for a in range(3):
            for b in range(3):
                work.W[i, a, b] = scale * (w_n - w_t) * work.normal[i, a] * work.normal[i, b]
            work.W[i, a, a] += scale * w_t
        before[i] = w_n


@compiled
def _add(total, row, share, within):
    """`total += share row`, of which only the places `within` are not zero."""
    part, of_row = total[within[0] : within[1]], row[within[0] : within[1]]
    for i in range(len(part)):
        part[i] += share * of_row[i]


@compiled
def _load_forces(c, work):
    """`BalanceEquations.loads` of the forces; `f W v` and `v W v`."""
    m, n = c.surface.free.shape
    loads, of_f, of_v, fWv, vWv = work.loads, np.zeros(3), np.zeros(3), 0.0, 0.0
    loads[:] = 0
    for i in range(1, m - 1):
        for j in range(1, n - 1):
            if not c.surface.free[i, j]:
                continue
            k = (i - 1) * (n - 2) + j - 1
            f, v, W, A = work.force[i, j], work.volume[i, j], work.W[k], work.A[i, j]
            for a in range(3):
                of_f[a] = W[a, 0] * f[0] + W[a, 1] * f[1] + W[a, 2] * f[2]
                of_v[a] = W[a, 0] * v[0] + W[a, 1] * v[1] + W[a, 2] * v[2]
                fWv += of_f[a] * v[a]
                vWv += of_v[a] * v[a]
                loads[0, 3 * k + a] = v[a]
            for s in range(7):
                p, q = i + STENCIL[s][0], j + STENCIL[s][1]
                if 0 < p < m - 1 and 0 < q < n - 1:
                    at = 3 * ((p - 1) * (n - 2) + q - 1)
                    for d in range(3):
                        x, y, z = A[0, 3 * s + d], A[1, 3 * s + d], A[2, 3 * s + d]
                        loads[1, at + d] += x * of_f[0] + y * of_f[1] + z * of_f[2]
                        loads[2, at + d] -= x * of_v[0] + y * of_v[1] + z * of_v[2]
    return fWv, vWv


@compiled
def _load_markers(c, work, u, moved, origins, across, weight, motion, outlier, own, slope):
    """`MarkerBearings.angles` and what they add to blocks, loads and the camera's equations."""
    n, (numbers, shares), (corners, pulls) = c.surface.free.shape[1], c.smooth, c.corners
    to_marker, jacobian, angle = np.zeros(3), np.zeros((2, 3)), np.zeros(2)
    for d in range(len(weight)):
        for a in range(3):
            to_marker[a] = c.positions[d, a] - origins[a, d]
        for s in range(numbers.shape[1]):
            i = numbers[d, s]
            at = u[i // (n - 2) + 1, i % (n - 2) + 1]
            for a in range(3):
                to_marker[a] += shares[d, s] * at[a]
        distance = np.sqrt(_dot(to_marker, to_marker))
        square = 0.0
        for r in range(2):
            turned = 0.0
            for a in range(3):
                turned += across[r, a, d] * to_marker[a] / distance
            for a in range(3):
                jacobian[r, a] = (across[r, a, d] - turned * to_marker[a] / distance) / distance
            for a in range(4):
                turned += motion[r, a, d] * moved[a]
            angle[r] = turned
            square += turned * turned
        w = weight[d] / (1 + weight[d] * square / outlier**2)
        for a in range(3):
            pull = w * (jacobian[0, a] * angle[0] + jacobian[1, a] * angle[1])
            for b in range(3):
                work.blocks[d, a, b] = w * (jacobian[0, a] * jacobian[0, b] + jacobian[1, a] * jacobian[1, b])
            for s in range(3):
                at, share = 3 * corners[d, s] + a, pulls[d, s]
                work.loads[1, at] += share * pull
                for e in range(4):
                    by_motion = motion[0, e, d] * jacobian[0, a] + motion[1, e, d] * jacobian[1, a]
                    work.loads[3 + e, at] += share * w * by_motion
        for a in range(4):
            slope[a] += w * (motion[0, a, d] * angle[0] + motion[1, a, d] * angle[1])
            for b in range(4):
                own[a, b] += w * (motion[0, a, d] * motion[0, b, d] + motion[1, a, d] * motion[1, b, d])


@compiled
def _assemble(c, work, ld, damping, ridge):
    """`A^T W A` and the markers' blocks in `U`, scaled from both sides by `scale` to a diagonal of 1, the ridge added to it."""
    (m, n), U, (corners, pulls) = c.surface.free.shape, work.U, c.corners
    N, scale, WA = (m - 2) * (n - 2), work.scale, work.weighted
    places = np.empty(7, np.int64)
    U[:] = 0
    for i in range(1, m - 1):
        for j in range(1, n - 1):
            if not c.surface.free[i, j]:
                continue
            W, A = work.W[(i - 1) * (n - 2) + j - 1], work.A[i, j]
            for a in range(3):
                for t in range(21):
                    WA[a, t] = W[a, 0] * A[0, t] + W[a, 1] * A[1, t] + W[a, 2] * A[2, t]
            for s in range(7):
                p, q = i + STENCIL[s][0], j + STENCIL[s][1]
                places[s] = 3 * ((p - 1) * (n - 2) + q - 1) if 0 < p < m - 1 and 0 < q < n - 1 else -1
            for s in range(7):
                if places[s] < 0:
                    continue
                for a in range(3):
                    r = places[s] + a
                    at = r * ld - r // LANES * LANES
                    x, y, z = A[0, 3 * s + a], A[1, 3 * s + a], A[2, 3 * s + a]
                    for other in range(s, 7):
                        if places[other] >= 0:
                            for b in range(a if other == s else 0, 3):
                                t = 3 * other + b
                                U[at + places[other] + b] += x * WA[0, t] + y * WA[1, t] + z * WA[2, t]
    for d in range(len(work.blocks)):
        for s in range(3):
            for other in range(3):
                share = pulls[d, s] * pulls[d, other]
                if share != 0 and corners[d, other] >= corners[d, s]:
                    for a in range(3):
                        r = 3 * corners[d, s] + a
                        at = r * ld - r // LANES * LANES
                        for b in range(a if other == s else 0, 3):
                            U[at + 3 * corners[d, other] + b] += share * work.blocks[d, a, b]
    for r in range(len(scale)):
        diagonal = U[r * ld + r % LANES]
        scale[r] = 1 / np.sqrt(diagonal * (1 + damping)) if diagonal > 0 else 1.0
    for k in range(N):
        i, j = k // (n - 2), k % (n - 2)
        for further in range(3):
            if i + further >= m - 2:
                break
            first, last = max(j - 1, 0) if further == 1 else j, min(j + 2, n - 3)
            first, last = 3 * ((i + further) * (n - 2) + first), 3 * ((i + further) * (n - 2) + last) + 3
            for r in range(3 * k, 3 * k + 3):
                at = r * ld - r // LANES * LANES
                for column in range(max(first, r + 1), last):
                    U[at + column] *= scale[r] * scale[column]
    for r in range(len(scale)):
        U[r * ld + r % LANES] = 1 + ridge


@compiled
def _camera_eliminated(products, own, slope):
    """`CameraMotion.eliminated`: how the camera follows each load, `[4, 3]`; the loads' own products become those with it."""
    system = np.empty((4, 7))
    system[:, :4], system[:, 4:] = own - products[3:, 3:], products[3:, :3]
    for a in range(4):
        system[a, 5] -= slope[a]
    for a in range(4):
        system[a] /= system[a, a]
        for b in range(4):
            if b != a:
                system[b] -= system[b, a] * system[a]
    for a in range(3):
        for b in range(3):
            for e in range(4):
                products[a, b] += products[a, 3 + e] * system[e, 4 + b]
    return system[:, 4:]


@compiled
def _shares(k, products, rise, pressure, fWv, vWv, gauge):
    """`Descent._shares`: of the volume's multiplier, the forces and the pressure's change in a step."""
    if k.is_open:
        return 0.0, 1.0, 0.0
    above = pressure - k.rest_pressure
    fWv, vWv = fWv - gauge[1] * (above - gauge[0]), vWv + gauge[1]
    target, compliance = -rise, 0.0
    if k.is_gas:
        ratio = k.gas_volume / (k.gas_volume + rise)
        compliance = k.gas_volume / (k.absolute * ratio**2)
        target = compliance * (k.absolute * (ratio - 1) - above)
    a11, a12, a22 = vWv - products[2, 2], compliance - products[0, 2], -products[0, 0]
    b1, b2 = fWv + products[2, 1], target + products[0, 1]
    det = a11 * a22 - a12 * a12
    return (a11 * b2 - a12 * b1) / det, 1.0, (b1 * a22 - a12 * b2) / det


@compiled
def _share(c, u, move):
    """`Descent._share`: so that no vertex goes far and no line of the grid is stretched or shrunk by much."""
    (m, n), rest, k, tiny = c.surface.free.shape, c.surface.rest, c.numbers, 1e-30
    far2, stretch2 = 0.0, 0.0
    here, there = np.zeros(3), np.zeros(3)
    for i in range(m):
        for j in range(n):
            inside = 0 < i < m - 1 and 0 < j < n - 1
            if inside:
                here[:] = move[i - 1, j - 1]
            else:
                here[:] = 0
            far2 = max(far2, here[0] ** 2 + here[1] ** 2 + here[2] ** 2)
            for axis in range(2):
                p, q = i + 1 - axis, j + axis
                if p < m and q < n:
                    inner = 0 < p < m - 1 and 0 < q < n - 1
                    change2, edge2 = 0.0, 0.0
                    for a in range(3):
                        change = (move[p - 1, q - 1, a] if inner else 0.0) - here[a]
                        edge = rest[p, q, a] - rest[i, j, a] + (u[p, q, a] - u[i, j, a])
                        change2 += change * change
                        edge2 += edge * edge
                    stretch2 = max(stretch2, change2 / max(edge2, tiny))
    far2 = max(far2 / (k.longest_step * k.size) ** 2, stretch2 / k.largest_stretch**2, 1.0)
    return 1 / np.sqrt(far2)


@compiled
def steps(c, work, u, pressure, moved, before, origins, across, weight, noise_level, motion, gauge, scales):
    """`step` of every frame."""
    for b in range(len(u)):
        at = b if len(weight) > 1 else 0
        now = u[b], pressure[b : b + 1], moved[b], before[b]
        step(c, work, *now, origins[at], across[at], weight[at], noise_level[at], motion[at], gauge[at], scales)
