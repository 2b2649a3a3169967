"""What a user would otherwise run: the scattering function of Yu et al. 2020 in plain PyTorch.

Two networks of eight layers of 256, coarse and fine, 64 and 64 + 64 samples a ray, density and colour at all
of them, as in the authors' code (michguo/osf) without its data handling.
"""

from collections.abc import Callable

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]

from dano.vision.capture._ray_set import RaySet

_COARSE, _FINE = 64, 64


def torch_calls(batch: RaySet) -> tuple[Callable[[], object], Callable[[], object]]:
    """Drawing and one step of training with a batch of rays, on one thread."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    names = ("origin", "direction", "near", "far", "light")
    rays = {name: torch.tensor(np.asarray(getattr(batch.rays, name))) for name in names}
    colour = torch.tensor(np.asarray(batch.colour))
    coarse, fine = _Network(), _Network()
    optimiser = torch.optim.Adam([*coarse.parameters(), *fine.parameters()], lr=5e-4)

    def draw() -> object:
        with torch.no_grad():
            return _seen(coarse, fine, rays)

    def step() -> object:
        optimiser.zero_grad()
        loss = sum(((seen - colour) ** 2).mean() for seen in _seen(coarse, fine, rays))
        loss.backward()  # pyright: ignore[reportAttributeAccessIssue]
        optimiser.step()
        return None

    return draw, step


class _Network(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        inputs = [63] + [256 + 63 * (i == 4) for i in range(7)]
        self.trunk = nn.ModuleList(nn.Linear(n, 256) for n in inputs)
        self.density, self.bottleneck = nn.Linear(256, 1), nn.Linear(256, 256)
        self.head, self.colour = nn.Linear(256 + 54, 128), nn.Linear(128, 3)

    def forward(self, x, view, light):
        code = _encoded(x, 10)
        h = code
        for i, layer in enumerate(self.trunk):
            h = torch.relu(layer(h))
            if i == 4:
                h = torch.cat([code, h], -1)
        density = torch.relu(self.density(h))[..., 0]
        directions = torch.cat([_encoded(view, 4), _encoded(light, 4)], -1)
        h = torch.relu(self.head(torch.cat([self.bottleneck(h), directions], -1)))
        return density, 1.2 * (torch.sigmoid(self.colour(h)) - 0.5) + 0.5


def _encoded(x, n):
    return torch.cat([x, *(f(2.0**k * x) for k in range(n) for f in (torch.sin, torch.cos))], -1)


def _seen(coarse, fine, rays):
    """Colours by the coarse and by the fine network."""
    share = torch.linspace(0, 1, _COARSE)
    t = rays["near"][:, None] + (rays["far"] - rays["near"])[:, None] * share
    first, weights = _rendered(coarse, rays, t)
    with torch.no_grad():
        cumulative = torch.cumsum(weights + 1e-5, -1)
        cumulative = cumulative / cumulative[:, -1:]
        wanted = torch.rand(len(t), _FINE)
        index = torch.searchsorted(cumulative, wanted).clamp(max=_COARSE - 1)
        t = torch.sort(torch.cat([t, torch.gather(t, 1, index)], -1), -1)[0]
    second, _ = _rendered(fine, rays, t)
    return first, second


def _rendered(network, rays, t):
    points = rays["origin"][:, None] + t[..., None] * rays["direction"][:, None]
    view, light = (rays[name][:, None].expand_as(points) for name in ("direction", "light"))
    density, colour = network(points, view, light)
    length = torch.cat([torch.diff(t, dim=-1), torch.full_like(t[:, :1], 1e-3)], -1)
    alpha = 1 - torch.exp(-density * length)
    clear = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha + 1e-10], -1), -1)[:, :-1]
    weights = alpha * clear
    return (weights[..., None] * colour).sum(-2), weights
