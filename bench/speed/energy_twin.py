"""The steps of minimum energy on one frame as one would write them with numpy and scipy."""

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import splu

from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergy
from torchmembrane.solve.anderson import DEPTH


class EnergyTwin:
    """The same fixed-point steps with the same acceleration, for triangles, an exact volume and a liquid, rays from the origin.

    The rest's stiffness is factored beforehand, as its inverse is there; the acceleration is by least squares.

    Args:
        estimator: whose solve it does again, in double precision.
    """

    def __init__(self, estimator: MinimumEnergy):
        membrane, self.elasticity, self.steps = estimator.membrane, estimator.elasticity, estimator.steps
        constants = membrane.rest, estimator.rest_range, estimator.rest_load, estimator.rest_pressure, membrane.rest_volume
        self.rest, self.rest_range, self.rest_load, self.rest_pressure, self.volume = (a.double().numpy() for a in constants)
        self.free, self.fixed, self.triangles = (
            membrane.free_vertices.numpy(),
            membrane.fixed.numpy(),
            membrane.triangles.numpy(),
        )
        T, V = len(self.triangles), len(self.rest)
        self.to_vertices = sparse.csr_matrix((np.ones(3 * T), (self.triangles.T.ravel(), np.arange(3 * T))), shape=(V, 3 * T))
        _, _, self.metric = self.sides(self.rest)
        self.det = self.metric[0] * self.metric[2] - self.metric[1] ** 2
        inverse = estimator.inverse.double().numpy()[np.ix_(self.free, self.free)]
        stiffness = np.linalg.inv(inverse)
        stiffness[np.abs(stiffness) < 1e-4 * np.abs(stiffness).max()] = 0
        self.factor = splu(sparse.csc_matrix(stiffness))

    def sides(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Two sides of every triangle `[T, 3]`, and their metric `[3, T]`."""
        a, b, c = (x[self.triangles[:, k]] for k in range(3))
        return b - a, c - a, np.stack([((b - a) ** 2).sum(1), ((b - a) * (c - a)).sum(1), ((c - a) ** 2).sum(1)])

    def forces(self, x: np.ndarray) -> np.ndarray:
        """The energy's derivative, `[V, 3]`."""
        b, c, g = self.sides(x)
        inverse = np.stack([self.metric[2], -self.metric[1], self.metric[0]]) / self.det
        first = inverse[0] * g[0] + 2 * inverse[1] * g[1] + inverse[2] * g[2]
        second = (g[0] * g[2] - g[1] ** 2) / self.det
        w_I, w_D = (np.asarray(w) for w in self.elasticity.first_derivatives(torch.from_numpy(first), torch.from_numpy(second)))
        stress = np.sqrt(self.det) * (w_I * inverse + w_D * np.stack([g[2], -g[1], g[0]]) / self.det)
        of_b, of_c = (stress[k, :, None] * b + stress[k + 1, :, None] * c for k in (0, 1))
        return self.to_vertices @ np.concatenate([-of_b - of_c, of_b, of_c])

    def volume_gradient(self, x: np.ndarray) -> np.ndarray:
        """Return the derivative of the enclosed volume with respect to the vertices `x [V, 3]`: `[V, 3]`, length^2."""
        a, b, c = (x[self.triangles[:, k]] for k in range(3))
        return self.to_vertices @ np.concatenate([np.cross(b, c), np.cross(c, a), np.cross(a, b)]) / 6

    def move(self, t: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Where the rest's stiffness would have the ranges of the free vertices go."""
        x = np.where(self.fixed[:, None], self.rest, t[:, None] * d)
        of_volume = self.volume_gradient(x)
        v = (of_volume * d).sum(1)[self.free]
        load = self.rest_pressure * v + ((self.rest_load - self.forces(x)) * d).sum(1)[self.free]
        y, w = self.factor.solve(np.stack([load, v], 1)).T
        return y - (v @ y + (of_volume * x).sum() / 3 - self.volume) / (v @ w) * w

    def __call__(self, directions: np.ndarray) -> np.ndarray:
        """Vertices `[V, 3]` on the rays `[V, 3]`; `remaining` is the step that is left."""
        d, t, tried, moves = directions, self.rest_range.copy(), [], []
        for _ in range(self.steps):
            moves.append(self.move(t, d))
            tried.append(t[self.free] + moves[-1])
            moves, tried = moves[-DEPTH - 1 :], tried[-DEPTH - 1 :]
            after = tried[-1]
            if len(moves) > 1:
                changes = np.diff(moves, axis=0).T
                after = after - np.diff(tried, axis=0).T @ np.linalg.lstsq(changes, moves[-1], rcond=1e-10)[0]
            t[self.free] = after
        self.remaining = np.abs(self.move(t, d)).max()
        return np.where(self.fixed[:, None], self.rest, t[:, None] * d)
