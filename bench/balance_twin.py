"""Force balance for one frame as one would write it with scipy: sparse assembly, sparse factor, a bordered 2 x 2 system.

Tractions, their weights and the triangles' second derivatives are the estimator's own, so that both solve the same steps.
"""

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import splu

from torchmembrane.estimators.force_balance import LONGEST_STEP, ForceBalance
from torchmembrane.surface.stencil import inner, pad_border
from torchmembrane.surface.topology import corners, triangles_of

DAMPING = 1e-6


def dofs(vertices: np.ndarray) -> np.ndarray:
    return (3 * vertices[..., None] + np.arange(3)).reshape(*vertices.shape[:-1], -1)


class BalanceTwin:
    """Surface and pressure from one frame's rays `[D, 3]` and weights `[D]`, from rest; `estimator` in float64."""

    def __init__(self, estimator: ForceBalance):
        self.estimator, grid = estimator, estimator.membrane.grid
        self.coarse = None if estimator.coarse is None else BalanceTwin(estimator.coarse)
        index = torch.arange(grid[0] * grid[1])[:, None]
        triangle = dofs(triangles_of(corners(index, grid)).reshape(-1, 3).numpy())
        self.row, self.column = np.repeat(triangle, 9, 1).ravel(), np.tile(triangle, (1, 9)).ravel()
        points = estimator.membrane.closest_points(estimator.positions.numpy())
        self.marker_weights, marker = points.weights, dofs(points.vertices)
        self.marker_row = np.repeat(np.arange(2 * len(marker)), 9)
        self.marker_column = np.repeat(marker, 2, 0).ravel()
        self.free = dofs(estimator.membrane.free_vertices.numpy()[:, None]).ravel()
        self.count = 3 * len(index)

    def __call__(self, origins, directions, weight) -> tuple[np.ndarray, float]:
        e = self.estimator
        seen = e.observation(origins[None], directions[None], weight[None])
        if self.coarse is None:
            x, pressure = e.at_rest(weight[None])
        else:
            surface, pressure = self.coarse(origins, directions, weight)
            x, pressure = e.refined(torch.from_numpy(surface)[None], torch.tensor([pressure]).double())
        for tau, outlier in e.falls():
            x, pressure = self.step(x, pressure, seen, tau, outlier)
        return x[0].numpy(), float(pressure)

    def step(self, x, pressure, seen, tau, outlier):
        e, free, count = self.estimator, self.free, self.count
        force = e.contact_force(x, pressure)
        inner_weights = e.force_weights(*(inner(field, e.membrane.grid).mT for field in (e.membrane.normals(x), force)), tau)
        weights = pad_border(inner_weights.flatten(1, 2).mT, e.membrane.grid)[0].unflatten(-1, (3, 3)).numpy()
        blocks = e.elasticity.hessian_blocks(x) - pressure * e.membrane.volume_hessian_blocks(x)
        angle, slope = e.angles(x, seen)
        slope = slope.movedim(-1, 1).numpy()[..., None, :] * self.marker_weights[:, None, :, None]
        certainty = np.repeat(e.marker_weights_at(angle, seen, outlier)[0].numpy(), 2)
        v = (e.membrane.volume_gradient(x) * e.moves)[0].numpy().ravel()
        f, r = force[0].numpy().ravel(), angle[0].mT.numpy().ravel()
        A = sparse.csr_matrix((blocks.numpy().ravel(), (self.row, self.column)), shape=(count, count))[free][:, free]
        J = sparse.csr_matrix((slope.ravel(), (self.marker_row, self.marker_column)), shape=(len(r), count))[:, free]
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
        share = min(1.0, LONGEST_STEP * e.size / np.linalg.norm(move, axis=1).max())
        return x + share * torch.from_numpy(move), pressure + share * rise
