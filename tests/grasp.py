"""A model around a reconstruction, trained by several processes."""

from dataclasses import replace
from pathlib import Path

import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel

import torchmembrane as tm

EXAMPLES = Path(__file__).parents[1] / "examples"


class Grasp(nn.Module):
    """A linear head on the wrench that a reconstruction finds, and a shift of all pixels before it."""

    def __init__(self, reconstructor: tm.Reconstructor) -> None:
        super().__init__()
        self.reconstructor, self.head = reconstructor, nn.Linear(6, 1)
        self.shift = nn.Parameter(torch.zeros(2))
        nn.init.constant_(self.head.bias, 0.1)
        nn.init.constant_(self.head.weight, 0.2)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        return self.head(self.reconstructor.from_pixels(pixels + self.shift).wrench)


def grasp() -> Grasp:
    sensor = tm.Sensor.from_file(EXAMPLES / "sensor.toml")
    return Grasp(tm.Reconstructor(replace(sensor, membrane=sensor.surface.membrane((9, 9))), dtype=torch.float64)).double()


def gradients(model: nn.Module, pixels: torch.Tensor) -> list[torch.Tensor]:
    """Of the mean over the batch."""
    model(pixels).square().mean().backward()
    return [parameter.grad for parameter in model.parameters()]


def train(rank: int, processes: int, folder: Path) -> None:
    """One of the processes: keeps the gradients that all find together."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=processes)
    batch = torch.load(folder / "pixels.pt")
    torch.save(gradients(DistributedDataParallel(grasp()), batch[rank::processes]), folder / f"{rank}.pt")
    dist.destroy_process_group()
