"""The results of a state after the steps as machine code: `ForceBalance.equilibrium`, frame by frame, without gradients."""

import numpy as np

from ....machine_code import compiled
from ....mechanics.native_membrane import linearise
from ..robust import geman_mcclure_loss
from ..traction_loss import NO_CONTACT_SCALE
from .equations import scaled, weight_of_shear
from .markers import place_of, turned

STEP, VOLUME, MISFIT, OBJECTIVE, UNEXPLAINED, SHARED = range(6)
"""Places in what is `told` of a frame."""
TOLD = 6
loss_of_push = compiled(geman_mcclure_loss)


@compiled
def solution_of(c, work, u, pressure, moved, before, seen, noise_level, gauge, far, told, traction, reference):
    """Compute `told [6]`, `traction [m, n, 3]` and `reference [m, n]` of a state; `far` is the limit of a marker's angle."""
    (m, n), k, step2 = c.surface.free.shape, c.numbers, 0.0
    told[VOLUME] = linearise(c.surface, u, pressure, work.x, work.cells, work.force, work.A, work.volume)
    scaled(c, work, noise_level, k.last_tau)
    for i in range(m):
        for j in range(n):
            for a in range(3):
                step2 += (u[i, j, a] - before[i, j, a]) ** 2
                traction[i, j, a] = 0.0
            reference[i, j] = k.reference
    told[STEP] = np.sqrt(step2 / (m * n)) / k.size
    pushes, others = _tractions(c, work, traction)
    count, misfit = _markers(c, u, moved, seen, far, told)
    rise = pressure[0] - k.rest_pressure
    misfit += gauge[1] * (rise - gauge[0]) ** 2 / 2
    told[UNEXPLAINED] = (misfit + others) / count
    told[OBJECTIVE] = told[UNEXPLAINED] + pushes / count
    for i in range(len(c.area)):
        above = work.fields[2, i] > (k.contact_noise * noise_level * c.push_noise[i]) ** 2
        scale = np.sqrt(work.fields[3, i]) if above else NO_CONTACT_SCALE
        reference[i // (n - 2) + 1, i % (n - 2) + 1] = k.reference * scale


@compiled
def _tractions(c, work, traction):
    """Apply `TractionLoss.forward`: return the loss of pushes and that of pulls and shear; write the tractions."""
    k, n, pushes, others = c.numbers, c.surface.free.shape[1], 0.0, 0.0
    for i in range(len(c.area)):
        p, q, unit = i // (n - 2) + 1, i % (n - 2) + 1, k.sparsity / k.size**2 * c.area[i]
        for a in range(3):
            traction[p, q, a] = work.force[p, q, a] / c.area[i]
        rho2, push2 = work.fields[3, i], work.fields[2, i]
        q_n, shear2 = work.fields[0, i] / np.sqrt(rho2), work.fields[1, i] / rho2
        if q_n < 0:
            pushes += unit * loss_of_push(q_n * q_n, k.last_tau)
        else:
            others += unit * q_n * q_n / 2
        others += unit * weight_of_shear(k, push2 / rho2) * (np.sqrt(shear2 + k.slip**2) - k.slip)
    return pushes, others


@compiled
def _markers(c, u, moved, seen, far, told):
    """Apply `MarkerResiduals.misfits`; return also the number of visible markers, and their loss."""
    weight, k, count = seen[2], c.numbers, len(seen[2])
    place, jacobian, angle, here = np.zeros(3), np.zeros((2, 3)), np.zeros(2), np.empty((count, 2))
    total, misfit, counted = 0.0, 0.0, 0.0
    for d in range(count):
        place_of(c, u, d, place)
        square = turned(seen, d, place, moved, jacobian, angle)
        misfit += _cauchy(weight[d] * square, k.outlier)
        counted += weight[d] * min(square / 2, k.outlier**2)
        total += weight[d]
        share = weight[d] * min(far / np.sqrt(max(square, 1e-12)), 1.0)
        here[d, 0], here[d, 1] = share * angle[0], share * angle[1]
    shared, pairs = 0.0, 0.0
    for d in range(count):
        for s in range(c.nearest.shape[1]):
            other = c.nearest[d, s]
            shared += here[d, 0] * here[other, 0] + here[d, 1] * here[other, 1]
            pairs += weight[d] * weight[other]
    told[MISFIT], told[SHARED] = np.sqrt(counted / max(total, 1.0)), np.sqrt(max(shared / max(pairs, 1.0), 0.0))
    return max(total, 1.0), misfit


@compiled
def _cauchy(r2, scale):
    """Return `Cauchy.loss`."""
    return scale**2 / 2 * np.log1p(r2 / scale**2)
