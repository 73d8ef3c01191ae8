"""The elastic energy of an inflated sheet, whose stretch at rest varies from place to place."""

import torch
from torch import Tensor

from ..mechanics.hyperelastic import ElasticEnergy
from ..surface.membrane import Membrane
from ..surface.topology import grid_triangles


class SheetEnergy(ElasticEnergy):
    """`ElasticEnergy` whose prestretch and modulus are those of the sheet before inflation, not of the rest surface.

    With the metrics `G` of the sheet's triangles and `g` of the membrane's, `I = tr(G^-1 g)` and `D = det g / det G` are used
    in the same `W(I, D)`, per area of the sheet. Tension at rest then varies with place and direction, as in the inflated
    sheet. A membrane that equals its sheet has the energy of `ElasticEnergy`.

    Args:
        membrane: the rest surface.
        sheet: positions of its vertices before inflation, `[V, 3]`: stretched in the rim by the prestretch, without pressure.
        model: "harmonic" | "neo_hookean" | "mooney_rivlin".
        prestretch: equibiaxial prestretch of the sheet.
        modulus: shear modulus x thickness of the sheet stretched in its rim, force / length.
        c2_ratio: C2 / C1, for "mooney_rivlin" only.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> flat, cap = (spherical_cap(12.0, height, 15.0, (9, 9)) for height in (1e-5, 5.0))
        >>> energy = SheetEnergy(cap, flat.rest, "neo_hookean", prestretch=1.1)
        >>> bool(energy.tension > ElasticEnergy(cap, prestretch=1.1).tension)
        True
    """

    sheet: Tensor
    rest: Tensor
    is_free: Tensor

    def __init__(
        self,
        membrane: Membrane,
        sheet: Tensor,
        model: str = "neo_hookean",
        prestretch: float = 1.0,
        modulus: float = 1.0,
        c2_ratio: float = 0.0,
    ) -> None:
        of_rest = ElasticEnergy(membrane, model)
        super().__init__(_Reference(sheet, membrane.grid), model, prestretch, modulus, c2_ratio)  # type: ignore[arg-type]
        self.modulus, self.c2_ratio = modulus, c2_ratio
        for name in ("rest_edges", "rest_sides", "rest_cell_edges"):
            self.register_buffer(name, getattr(of_rest, name))
        split = torch.from_numpy(grid_triangles(membrane.grid))
        for name, value in (("sheet", sheet), ("rest", membrane.rest), ("is_free", (~membrane.fixed)[split].any(1))):
            self.register_buffer(name, value)

    def for_membrane(self, membrane: Membrane) -> "SheetEnergy":
        """Return the energy of the same sheet for `membrane`, whose grid consists of every second line of this one."""
        sheet = self.sheet.unflatten(0, self.grid)[::2, ::2].flatten(0, 1)
        return SheetEnergy(membrane, sheet, self.model, float(self.prestretch), self.modulus, self.c2_ratio)

    @property
    def rest_stretches(self) -> Tensor:
        """Principal stretches at rest relative to the unstretched sheet, larger and smaller, `[T, 2]`, of triangles not wholly
        on the rim."""
        return (self.prestretch * self.principal_stretches(self.rest))[self.is_free]

    @property
    def tension(self) -> Tensor:
        """Mean tension at rest (force / length), averaged over the rest surface and both principal directions.

        Half the trace of the stress resultant is `(I dW/dI + 2 D dW/dD) / sqrt D`.
        """
        strain = self.strain(self.rest)
        w_I, w_D = self.first_derivatives(strain.I, strain.D)
        area = self.area * self.is_free.unflatten(0, (-1, 2)).T.flatten()  # first triangles of all cells, then second ones
        total: Tensor = (area * (strain.I * w_I + 2 * strain.D * w_D)).sum() / (area * strain.D.sqrt()).sum()
        return total


class _Reference:
    """The attributes of a membrane that `ElasticEnergy` uses."""

    def __init__(self, rest: Tensor, grid: tuple[int, int]) -> None:
        self.rest, self.grid = rest, grid
