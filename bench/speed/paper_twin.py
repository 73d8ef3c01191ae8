"""The paper's solve of one frame as one would write it with scipy: sparse assembly and factorisation."""

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import splu

from torchmembrane.estimators.paper.estimator import PaperEstimator, grid_laplacian
from torchmembrane.surface.topology import corners


class PaperTwin:
    """Eq. 22 with the smoother of eq. 28, by eqs. 25 to 27, for a liquid. Constants are worked out beforehand, here as there.

    Args:
        estimator: whose solve it does again, in double precision.
    """

    def __init__(self, estimator: PaperEstimator):
        self.membrane, self.energy = membrane, energy = estimator.membrane, estimator.energy
        V, grid = len(membrane.rest), membrane.grid
        self.index = corners(torch.arange(V)[:, None], grid)[..., 0].reshape(-1, 4).numpy()
        local = (energy.tension * energy.area)[..., None, None] * (energy.map_weights @ energy.map_weights.mT)
        self.local = local.reshape(-1, 4, 4).double().numpy()
        self.places = np.repeat(self.index, 4, 1).ravel(), np.tile(self.index, (1, 4)).ravel()
        self.free, self.fixed = membrane.free_vertices.numpy(), membrane.fixed.numpy()
        smoother = grid_laplacian(torch.eye(V, dtype=torch.float64), grid).numpy()
        self.smoother = sparse.csc_matrix(smoother)[:, self.free]
        self.weight = float(estimator.settings.smoothing * estimator.elasticity.tension)
        constants = membrane.rest, estimator.rest_range, estimator.rest_load, estimator.rest_pressure, membrane.rest_volume
        self.rest, self.rest_range, self.rest_load, self.rest_pressure, self.volume = (a.double().numpy() for a in constants)

    def __call__(self, directions: np.ndarray, relaxed: np.ndarray) -> np.ndarray:
        """Vertices `[V, 3]` on the rays `[V, 3]` of a pinhole camera, `relaxed [V]` where the smoother leaves them alone."""
        free, d = self.free, np.where(self.fixed[:, None], 0.0, directions)
        dots = np.einsum("qic,qjc->qij", d[self.index], d[self.index])
        K = sparse.csc_matrix(((self.local * dots).ravel(), self.places), shape=(len(d), len(d)))[free][:, free]
        M = K + self.weight * (self.smoother.T @ sparse.diags((~relaxed).astype(float)) @ self.smoother)
        x = np.where(self.fixed[:, None], self.rest, self.rest_range[:, None] * d)
        at = torch.from_numpy(x).to(self.membrane.rest)
        v = (self.membrane.volume_gradient(at).numpy() * d).sum(1)
        load = self.rest_pressure * v + ((self.rest_load - self.energy.gradient(at).numpy()) * d).sum(1)
        y, w = splu(M.tocsc()).solve(np.stack([load[free], v[free]], 1)).T
        multiplier = (v[free] @ y - (self.volume - float(self.membrane.volume(at)))) / (v[free] @ w)
        x[free] += (y - multiplier * w)[:, None] * d[free]
        return x
