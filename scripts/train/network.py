"""The networks: what goes in, what comes out, what they cost.

In: S0, S1, S2 of stage I and the back-projected residual R0, R1, R2, scaled as INPUTS say, [B, 6, T, T].
Out: what is to be added to S1, S2, in units of rms(S0), [B, 2, T, T].

What goes into a model file is the trunk alone; Candidates has its twin in src/fusion/mixer.rs.

The readings say next to nothing about detail of less than eight pixels in L = S1 + i·S2, and all that is linear in them stage I has
found. What is left is to tell where its answer should be smoother or rougher, and where the guide's detail is that of L. So the
network does not paint: it mixes. Candidates are made of L, its blurred versions and the guide's detail times local slopes, each
linear in L; a convolutional trunk, which sees only what does not depend on the direction of polarization, gives every pixel its
real weights. Turning the polarization of the input turns the output: what is learned at one angle holds at all.
"""
import torch
import torch.nn as nn
import torch.nn.functional as F

# (plane, scale, offset) of the manifest: scale · plane / rms(S0) + offset.
INPUTS = [("s0", 1, 0), ("s1", 1, 0), ("s2", 1, 0), ("r0", 1000, 0), ("r1", 1000, 0), ("r2", 1000, 0)]
SCALE = 1.0
TILE = 256
LEVELS = (4, 8, 16)  # sides of the cells over which slopes are taken
CANDIDATES = 4 + 3 * len(LEVELS) + 1
FLAT = 3e-4  # variance of S0 below which it has no slope


def interpolation(coarse, fine):
    """[fine, coarse]: linear between the middles of cells."""
    at = ((torch.arange(fine) + 0.5) * coarse / fine - 0.5).clamp(0, coarse - 1)
    return F.relu(1 - (at[:, None] - torch.arange(coarse)).abs())


def enlarged(x, matrix):
    """Linear interpolation of squares: M·X·Mᵀ, with one matrix for both sides."""
    return torch.matmul(matrix, torch.matmul(matrix, x).transpose(2, 3)).transpose(2, 3)


def smooth(x):
    return F.avg_pool2d(x, 3, 1, 1, count_include_pad=False)


def length(re, im):
    return torch.sqrt(re * re + im * im + 1e-8)


def conv(i, o, k=3, stride=1):
    return nn.Conv2d(i, o, k, stride, k // 2)


class Block(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.a, self.b = conv(width, width), conv(width, width)

    def forward(self, x):
        return x + self.b(F.relu(self.a(x)))


class Candidates(nn.Module):
    """From the input the candidates for S1 and for S2, [B, CANDIDATES, T, T] each, and what the trunk sees, [B, SEEN, T/4, T/4].
    Nothing here is learned."""

    SEEN = 16 + 8 + 4 * len(LEVELS)

    def __init__(self):
        super().__init__()
        for cell in LEVELS:
            self.register_buffer(f"whole{cell}", interpolation(TILE // cell, TILE), persistent=False)
            self.register_buffer(f"quarter{cell}", interpolation(TILE // cell, TILE // 4), persistent=False)

    def forward(self, x):
        s0, l, r0, r = x[:, :1], x[:, 1:3], x[:, 3:4], x[:, 4:6]
        fine, own = s0 - smooth(s0), l - smooth(l)
        pooled = lambda v, cell: F.avg_pool2d(v, cell)
        made, seen = [l, own], []
        squares = torch.cat([s0, l, s0 * s0, s0 * l], 1)
        for cell in LEVELS:
            squares = pooled(squares, cell if cell == LEVELS[0] else 2)
            near = smooth(squares)
            slope = (near[:, 4:6] - near[:, :1] * near[:, 1:3]) / (near[:, 3:4] - near[:, :1] ** 2 + FLAT)
            degree = near[:, 1:3] / (near[:, :1] + 0.05)
            large = enlarged(torch.cat([squares[:, :3], slope, degree], 1), getattr(self, f"whole{cell}"))
            detail = s0 - large[:, :1]
            if cell == LEVELS[0]:
                made += [large[:, 3:5] * fine, large[:, 5:7] * fine]
                first = (detail, l - large[:, 1:3])
            made += [l - large[:, 1:3], large[:, 3:5] * detail, large[:, 5:7] * detail]
            a, d = slope.split(1, 1), degree.split(1, 1)
            both = torch.cat([length(*a), length(*d), a[0] * d[0] + a[1] * d[1], torch.sqrt(near[:, 3:4] - near[:, :1] ** 2 + FLAT)], 1)
            if cell > 4:
                both = enlarged(both, getattr(self, f"quarter{cell}"))
            seen.append(3 * both)
        made.append(0.3 * r)
        light, back = pooled(l, 4), pooled(r, 4)
        rms = lambda v: torch.sqrt(pooled((v * v).sum(1, keepdim=True), 4) + 1e-8)
        seen += [pooled(s0, 4) - 1, 3 * length(light[:, :1], light[:, 1:]), 10 * rms(own), 10 * rms(first[1]), 10 * rms(fine),
                 30 * pooled(r0, 4), 30 * length(back[:, :1], back[:, 1:]),
                 100 * (light * back).sum(1, keepdim=True), F.pixel_unshuffle(5 * first[0], 4)]
        candidates = [torch.cat([v[:, k:k + 1] for v in made], 1) for k in (0, 1)]
        seen = torch.cat(seen, 1)
        return *candidates, seen / (1 + seen.abs())


class Mixer(nn.Module):
    """The trunk, a U-Net whose finest pixels are 4 × 4 of the frame's, and the sum of the candidates."""

    def __init__(self, widths, blocks):
        super().__init__()
        self.candidates = Candidates()
        self.head = conv(Candidates.SEEN, widths[0])
        stage = lambda k: nn.Sequential(*[Block(widths[k]) for _ in range(blocks[k])])
        self.encoder = nn.ModuleList(stage(k) for k in range(len(widths)))
        self.down = nn.ModuleList(conv(a, b, 3, 2) for a, b in zip(widths, widths[1:]))
        self.up = nn.ModuleList(conv(b, 4 * a, 1) for a, b in zip(widths, widths[1:]))
        self.decoder = nn.ModuleList(stage(k) for k in range(len(widths) - 1))
        self.tail = conv(widths[0], 16 * CANDIDATES, 1)
        nn.init.zeros_(self.tail.weight)
        nn.init.zeros_(self.tail.bias)

    def weights(self, x):
        x = F.relu(self.head(x))
        skips = []
        for k, stage in enumerate(self.encoder):
            x = stage(x)
            if k < len(self.down):
                skips.append(x)
                x = F.relu(self.down[k](x))
        for k in reversed(range(len(self.down))):
            x = self.decoder[k](F.relu(skips[k] + F.pixel_shuffle(self.up[k](x), 2)))
        return self.tail(F.relu(x))

    def forward(self, x):
        return self.mixed(x, self.weights)

    def mixed(self, x, trunk):
        """The answer with `trunk` in place of its own."""
        with torch.autocast(x.device.type, enabled=False):
            one, two, seen = self.candidates(x.float())
        weights = F.pixel_shuffle(trunk(seen).float(), 4)
        return torch.cat([(weights * v).sum(1, keepdim=True) for v in (one, two)], 1)

    @property
    def multiple(self):
        return max(LEVELS[-1], 4 << len(self.down))


class Trunk(nn.Module):
    """What a model file holds: [B, Candidates.SEEN, H, W] to [B, 16 * CANDIDATES, H, W]."""

    def __init__(self, mixer):
        super().__init__()
        self.mixer = mixer

    def forward(self, x):
        return self.mixer.weights(x)


# Name: widths, and residual blocks at each of them.
SIZES = {
    "default": ((32, 48, 64), (1, 1, 2)),
    "preview": ((18, 24, 40), (1, 1, 1)),
    # Not shipped: what more arithmetic would gain.
    "large": ((56, 84, 112), (2, 2, 2)),
}


def cost(network):
    """Multiply-adds of one tile, interpolation and mixing included, and parameters."""
    total = (7 * len(LEVELS) + 2 * CANDIDATES) * TILE * TILE

    def count(layer, _, out):
        nonlocal total
        total += out.shape[2] * out.shape[3] * layer.weight.numel()

    hooks = [m.register_forward_hook(count) for m in network.modules() if isinstance(m, nn.Conv2d)]
    with torch.no_grad():
        network(torch.zeros(1, len(INPUTS), TILE, TILE))
    for hook in hooks:
        hook.remove()
    return total, sum(p.numel() for p in network.parameters())


if __name__ == "__main__":
    for name, (widths, blocks) in SIZES.items():
        macs, parameters = cost(Mixer(widths, blocks))
        print(f"{name}: {macs / 1e9:.3f} GMAC, {parameters / 1e3:.0f} k parameters")
