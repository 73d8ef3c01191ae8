"""Machine code for one frame: the angles between the markers and their measured rays, and what they contribute to the equations
of a Gauss-Newton step.

The formulas repeat those of `MarkerResiduals`; a test compares the numbers.
"""

import numpy as np

from ....machine_code import compiled
from .equations import CAMERA, FORCES


@compiled
def load_markers(c, work, u, moved, seen, outlier, own, slope):
    """`MarkerResiduals.angles` and what they add to the loads and to the camera's equations, `own [4, 4]` and `slope [4]`; the
    markers' blocks.

    `seen`: origins `[3, D]`, across `[2, 3, D]`, weight `[D]`, motion `[2, 4, D]`."""
    (_, _, weight, motion), (corners, pulls) = seen, c.corners
    place, jacobian, angle = np.zeros(3), np.zeros((2, 3)), np.zeros(2)
    for d in range(len(weight)):
        place_of(c, u, d, place)
        square = turned(seen, d, place, moved, jacobian, angle)
        w = weight[d] / (1 + weight[d] * square / outlier**2)
        work.marker_weights[d] = w
        for a in range(3):
            work.jacobians[d, 0, a], work.jacobians[d, 1, a] = w * jacobian[0, a], w * jacobian[1, a]
            pull = w * (jacobian[0, a] * angle[0] + jacobian[1, a] * angle[1])
            for b in range(3):
                work.blocks[d, a, b] = w * (jacobian[0, a] * jacobian[0, b] + jacobian[1, a] * jacobian[1, b])
            for s in range(3):
                at, share = 3 * corners[d, s] + a, pulls[d, s]
                work.loads[FORCES, at] += share * pull
                for e in range(4):
                    by_motion = motion[0, e, d] * jacobian[0, a] + motion[1, e, d] * jacobian[1, a]
                    work.loads[CAMERA + e, at] += share * w * by_motion
        for a in range(4):
            slope[a] += w * (motion[0, a, d] * angle[0] + motion[1, a, d] * angle[1])
            for b in range(4):
                own[a, b] += w * (motion[0, a, d] * motion[0, b, d] + motion[1, a, d] * motion[1, b, d])


@compiled
def load_markers_after(c, work, u, moved, seen, slope):
    """Add to the load of the forces and to `slope [4]` what the markers contribute after a step, to first order: the vertices
    have moved by `-solved` from `u`; `moved [4]` is the camera's motion after the step."""
    (_, _, weight, motion), (corners, pulls) = seen, c.corners
    place, jacobian, angle = np.zeros(3), np.zeros((2, 3)), np.zeros(2)
    for d in range(len(weight)):
        place_of(c, u, d, place)
        turned(seen, d, place, moved, jacobian, angle)
        for s in range(3):
            for a in range(3):
                move = -pulls[d, s] * work.solved[3 * corners[d, s] + a]
                angle[0] += jacobian[0, a] * move
                angle[1] += jacobian[1, a] * move
        for s in range(3):
            for a in range(3):
                pull = work.jacobians[d, 0, a] * angle[0] + work.jacobians[d, 1, a] * angle[1]
                work.loads[FORCES, 3 * corners[d, s] + a] += pulls[d, s] * pull
        for a in range(4):
            slope[a] += work.marker_weights[d] * (motion[0, a, d] * angle[0] + motion[1, a, d] * angle[1])


@compiled
def turned(seen, d, place, moved, jacobian, angle):
    """Apply `MarkerResiduals._seen`: return the angles of marker d at `place`, their derivatives in it, and the sum of their
    squares; `place` is overwritten with the vector from the ray's origin."""
    origins, across, _, motion = seen
    for a in range(3):
        place[a] -= origins[a, d]
    distance, square = np.sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2), 0.0
    for r in range(2):
        total = 0.0
        for a in range(3):
            total += across[r, a, d] * place[a] / distance
        for a in range(3):
            jacobian[r, a] = (across[r, a, d] - total * place[a] / distance) / distance
        for a in range(4):
            total += motion[r, a, d] * moved[a]
        angle[r] = total
        square += total * total
    return square


@compiled
def place_of(c, u, d, place):
    """Return the position of marker d on the surface as `MarkerResiduals.markers` does."""
    n, (numbers, shares) = c.surface.free.shape[1], c.smooth
    for a in range(3):
        place[a] = c.positions[d, a]
    for s in range(numbers.shape[1]):
        i = numbers[d, s]
        for a in range(3):
            place[a] += shares[d, s] * u[i // (n - 2) + 1, i % (n - 2) + 1, a]
