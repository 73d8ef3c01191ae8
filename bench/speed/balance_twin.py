"""Force balance for one frame as one would write it with scipy: sparse assembly, sparse factor, a bordered 2 x 2 system.

Tractions, their weights and the triangles' second derivatives are the estimator's own, so that both solve the same steps.
"""

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import splu

from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.force_balance.estimator import ForceBalance
from torchmembrane.estimators.force_balance.marker_residuals import MeasuredRays
from torchmembrane.estimators.force_balance.robust import Cauchy
from torchmembrane.estimators.force_balance.schedule import (
    LARGEST_STRETCH,
    LEAST_MOVE,
    falling,
    outlier_scale,
    scaled_step,
    share_of_next,
)
from torchmembrane.solve.stencil import inner, pad_border
from torchmembrane.surface.topology import corners, triangles_of

DAMPING = 1e-6


def dofs(vertices: np.ndarray) -> np.ndarray:
    return (3 * vertices[..., None] + np.arange(3)).reshape(*vertices.shape[:-1], -1)


class BalanceTwin:
    """Surface and pressure from one frame's observation, rays `[D, 3]`, from rest; `estimator` in float64."""

    def __init__(self, estimator: ForceBalance):
        self.estimator, grid = estimator, estimator.membrane.grid
        self.coarse = None if estimator.coarse is None else BalanceTwin(estimator.coarse)
        index = torch.arange(grid[0] * grid[1])[:, None]
        triangle = dofs(triangles_of(corners(index, grid)).reshape(-1, 3).numpy())
        self.row, self.column = np.repeat(triangle, 9, 1).ravel(), np.tile(triangle, (1, 9)).ravel()
        points = estimator.membrane.closest_points(estimator.equations.bearings.positions.numpy())
        self.marker_weights, marker = points.weights, dofs(points.vertices)
        self.marker_row = np.repeat(np.arange(2 * len(marker)), 9)
        self.marker_column = np.repeat(marker, 2, 0).ravel()
        self.free = dofs(estimator.membrane.free_vertices.numpy()[:, None]).ravel()
        self.count = 3 * len(index)

    def __call__(self, observation: Observation) -> tuple[np.ndarray, float]:
        e, single = self.estimator, Observation(*(None if part is None else part[None] for part in observation))
        measured = e.equations.bearings.measured(single)
        if self.coarse is None:
            u, pressure, _ = e.at_rest(single.confidence)
        else:
            displacement, pressure = self.coarse(observation)
            still = torch.zeros(1, 4).double()
            u, pressure, _ = e.refined(torch.from_numpy(displacement)[None], torch.tensor([pressure]).double(), still)
        tau, last = e.settings.tau[0 if self.coarse is None else 1], e.settings.tau[1]
        settings, share = e.gauss_newton.settings, 1.0
        for _ in range(e.steps):
            before = u
            u, pressure = self.step(u, pressure, measured, tau, outlier_scale(settings.outlier, tau / last), share)
            lengths = ((field.square().sum(-1).mean().sqrt() / e.size) for field in (u - before, u))
            moved = scaled_step(*map(float, lengths))
            if tau <= last and moved <= settings.settled_step_tol:
                break
            share = 1.0 if tau > last else min(1.0, share_of_next(moved, settings.settled_step_tol))
            tau = max(last, tau * falling(max(moved, LEAST_MOVE)))
        return u[0].numpy(), float(pressure)

    def step(self, u: torch.Tensor, pressure, measured: MeasuredRays, tau: float, outlier: float, share: float):
        e, free, count = self.estimator, self.free, self.count
        x = e.membrane.rest + u
        forces, bearings, loss = e.equations.forces, e.equations.bearings, e.equations.loss
        force, normals = forces(u, pressure), e.membrane.normals(x)
        within = (inner(field, e.membrane.grid).mT for field in (normals, force))
        inner_weights = loss.weights(*within, measured.noise_level, torch.full_like(measured.noise_level, tau))
        weights = pad_border(inner_weights.flatten(1, 2).mT, e.membrane.grid)[0].unflatten(-1, (3, 3)).numpy()
        blocks = e.elasticity.hessian_blocks(x) - pressure * e.membrane.volume_hessian_blocks(x)
        angle, jacobian = bearings.angles(u, measured, torch.zeros(1, 4).double())
        jacobian = jacobian.movedim(-1, 1).numpy()[..., None, :] * self.marker_weights[:, None, :, None]
        certainty = measured.weight * Cauchy(outlier).weight(measured.weight * angle.square().sum(1))
        certainty = np.repeat(certainty[0].numpy(), 2)
        v = (e.membrane.volume_gradient(x) * forces.free)[0].numpy().ravel()
        f, r = force[0].numpy().ravel(), angle[0].mT.numpy().ravel()
        A = sparse.csr_matrix((blocks.numpy().ravel(), (self.row, self.column)), shape=(count, count))[free][:, free]
        J = sparse.csr_matrix((jacobian.ravel(), (self.marker_row, self.marker_column)), shape=(len(r), count))[:, free]
        W = sparse.bsr_matrix((weights, np.arange(count // 3), np.arange(count // 3 + 1))).tocsr()[free][:, free]
        AW, Jw = A.T @ W, J.T @ sparse.diags(certainty)
        M = AW @ A + Jw @ J
        M = (M + DAMPING * sparse.diags(M.diagonal())).tocsc()
        f, v = f[free], v[free]
        g, m, n = AW @ f + Jw @ r, -AW @ v, v
        factor = splu(M, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=dict(SymmetricMode=True))
        Mg, Mm, Mn = factor.solve(np.stack([g, m, n], 1)).T
        target, compliance = (float(a) for a in e.cavity.condition(e.membrane.volume(x) - e.membrane.rest_volume, pressure))
        Wv = W @ v
        border = [[v @ Wv - m @ Mm, compliance - m @ Mn], [compliance - m @ Mn, -n @ Mn]]
        rise, multiplier = np.linalg.solve(border, [f @ Wv + m @ Mg, target + n @ Mg])
        move = np.zeros(count)
        move[free] = -Mg - rise * Mm - multiplier * Mn
        move = move.reshape(-1, 3)
        stretch = 0.0
        surface, change = (a.reshape(*e.membrane.grid, 3) for a in (x[0].numpy(), move))
        for axis in (0, 1):
            edge, turn = (np.linalg.norm(np.diff(a, axis=axis), axis=-1) for a in (surface, change))
            stretch = max(stretch, (turn / edge).max())
        share *= min(1.0, LARGEST_STRETCH / max(stretch, 1e-12))
        return u + share * torch.from_numpy(move), pressure + share * rise
