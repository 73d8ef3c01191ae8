"""Steps and deviations of frames by machine code: in one function, so that what both need is compiled once."""

from ..machine_code import fingerprint, kept
from ..mechanics import cavity, native_membrane
from ..solve import native_band
from . import native_equations, native_spread, native_step
from .native_spread import spread_of
from .native_step import step


def _entry(sources):
    @kept
    def frames(c, work, u, pressure, moved, weights, before, origins, across, weight, noise_level, motion, gauge, rows, found):
        """Steps of every frame, and then its deviations.

        `u [B, m, n, 3]`, `pressure [B]`, `moved [B, 4]` and `weights [B, N]`, of the normal tractions, become those after the
        steps; `before [B, m, n, 3]` the displacement before the last; `found [B, 4]` the standard deviations of force and depth
        by the last of the rows, with which no step is taken; `[0, 4]` where they are not asked for.

        c: `Constants`, work: a `Workspace`, origins to gauge: `Bearings`, rows: of every step tau, outlier, cone, renewal and
        damping, `[S, 5]`.
        """
        count = len(rows) - (len(found) > 0)
        for b in range(len(u) if sources else 0):
            state, measured = (u[b], pressure[b : b + 1], moved[b], weights[b]), (noise_level[b], gauge[b])
            seen, now, earlier = (origins[b], across[b], weight[b], motion[b]), u[b].ravel(), before[b].ravel()
            for k in range(count):
                for i in range(len(earlier) if k == count - 1 else 0):
                    earlier[i] = now[i]
                step(c, work, *state, seen, *measured, rows[k])
            if len(found) > 0:
                spread_of(c, work, *state, seen, *measured, rows[count], found[b])

    return frames


frames = _entry(
    fingerprint(
        __file__,
        *(each.__file__ for each in (cavity, native_band, native_equations, native_membrane, native_spread, native_step)),
    )
)
