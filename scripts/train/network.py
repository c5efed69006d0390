"""The networks: what goes in, what comes out, what they cost.

In: S0, S1, S2 of stage I and the back-projected residual R0, R1, R2, over rms(S0) and times SCALES, [B, 6, T, T].
Out: what is to be added to S1, S2, in units of rms(S0), [B, 2, T, T].

A model file holds the trunk alone. Candidates is the twin of crates/core/src/refine/candidates.rs.

The readings say next to nothing about detail of less than eight pixels in L = S1 + i·S2, and all that is linear in them stage I has
found. What is left is to tell where its answer should be smoother or rougher, and where the guide's detail is that of L. So the
network does not paint: it mixes. Candidates are made of L, its blurred versions and the guide's detail times local slopes, each
linear in L; a convolutional trunk, which sees only what does not depend on the direction of polarization, gives every pixel its
real weights. Turning the polarization of the input turns the output: what is learned at one angle holds at all.
"""
import torch
import torch.nn as nn
import torch.nn.functional as F

SCALES = (1, 1, 1, 1000, 1000, 1000)  # of the inputs
TILE = 256
LEVELS = (4, 8, 16)  # sides of the cells over which slopes are taken
MADE = 4 + 3 * len(LEVELS) + 1
CANDIDATES = MADE + 1
SMOOTHING = [0, 1, 4, 7, 10, 13]  # candidates without the guide's detail
UNIFORM = [3, 6, 9, 12]  # candidates of a DoLP that does not vary with the guide's detail
FLAT = 3e-4  # variance of S0 below which it has no slope
DETAILS = 1 + len(LEVELS)  # scales of the guide's detail, fine first
# Each has three shares: of the detail, of its magnitude (what is brighter than its surroundings has another DoLP than what is darker),
# and of its product with how bright these are.
KINDS = 3
# What is told: shares, how far those of the detail are sure, and shares of what L has beyond its blurs.
TOLD = (KINDS + 1) * DETAILS + len(LEVELS)
DOUBT = [2.0, 6.0, 6.0]  # a share of each kind is expected to be one over the root of this
SURE = 4.0  # square of a share over its variance at which half of it is believed


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


class ByteConv(nn.Conv2d):
    """A convolution as int8 makes it, with what goes in, its weights and what comes out rounded to 256 steps of one scale each; the
    ranges follow those of training. Gradients pass the rounding."""

    def __init__(self, *a, **k):
        super().__init__(*a, **k)
        self.register_buffer("ranges", torch.zeros(2, 2))

    def rounded(self, v, k):
        if self.training:
            with torch.no_grad():
                now = torch.stack([v.amin().float().clamp(max=0), v.amax().float().clamp(min=0)])
                old = self.ranges[k]
                self.ranges[k] = torch.where(old[1] > old[0], old + 0.02 * (now - old), now)
        low, high = self.ranges[k].tolist()
        if low == high:  # nothing is known yet
            return v
        scale = (high - low) / 255
        return torch.fake_quantize_per_tensor_affine(v.float(), scale, round(-low / scale), 0, 255)

    def forward(self, x):
        scale = max(self.weight.detach().abs().max().item(), 1e-6) / 127
        weight = torch.fake_quantize_per_tensor_affine(self.weight, scale, 0, -127, 127)
        return self.rounded(self._conv_forward(self.rounded(x, 0), weight, self.bias), 1)


class Block(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.a, self.b = conv(width, width), conv(width, width)

    def forward(self, x):
        return x + self.b(F.relu(self.a(x)))


class Candidates(nn.Module):
    """From the input and the PSF's `power` the candidates for S1 and for S2, [B, CANDIDATES, T, T] each, and what the trunk sees,
    [B, SEEN, T/4, T/4]. Nothing here is learned."""

    SEEN = 16 + 8 + 4 * len(LEVELS) + TOLD

    def __init__(self):
        super().__init__()
        for cell in LEVELS:
            self.register_buffer(f"whole{cell}", interpolation(TILE // cell, TILE), persistent=False)
            self.register_buffer(f"quarter{cell}", interpolation(TILE // cell, TILE // 4), persistent=False)

    def forward(self, x, power):
        s0, l, r0, r = x[:, :1], x[:, 1:3], x[:, 3:4], x[:, 4:6]
        fine, own = s0 - smooth(s0), l - smooth(l)
        pooled = lambda v, cell: F.avg_pool2d(v, cell)
        made, seen, details, asked, rough = [l, own], [], [], [], []
        light, back = pooled(l, 4), pooled(r, 4)
        squares = torch.cat([s0, l, s0 * s0, s0 * l], 1)
        for cell in LEVELS:
            squares = pooled(squares, cell if cell == LEVELS[0] else 2)
            near = smooth(squares)
            slope = (near[:, 4:6] - near[:, :1] * near[:, 1:3]) / (near[:, 3:4] - near[:, :1] ** 2 + FLAT)
            degree = near[:, 1:3] / (near[:, :1] + 0.05)
            large = enlarged(torch.cat([squares[:, :3], slope, degree], 1), getattr(self, f"whole{cell}"))
            quarter = lambda v: v if cell == 4 else enlarged(v, getattr(self, f"quarter{cell}"))
            bright, *coarse = large[:, :1] - 1, quarter(squares[:, :1]) - 1, quarter(degree)
            detail, rest = s0 - large[:, :1], l - large[:, 1:3]
            if cell == LEVELS[0]:
                made += [large[:, 3:5] * fine, large[:, 5:7] * fine]
                first = (detail, rest)
                details.append((fine, bright, large[:, 5:7]))
                asked.append((pooled(fine, 4), pooled(fine.abs(), 4), *coarse))
            made += [rest, large[:, 3:5] * detail, large[:, 5:7] * detail]
            details.append((detail, bright, large[:, 5:7]))
            asked.append((pooled(detail, 4), pooled(detail.abs(), 4), *coarse))
            rough.append(pooled(rest, 4))
            a, d = slope.split(1, 1), degree.split(1, 1)
            both = torch.cat([length(*a), length(*d), a[0] * d[0] + a[1] * d[1], torch.sqrt(near[:, 3:4] - near[:, :1] ** 2 + FLAT)], 1)
            seen.append(3 * quarter(both))
        made.append(0.3 * r)
        rms = lambda v: torch.sqrt(pooled((v * v).sum(1, keepdim=True), 4) + 1e-8)
        seen += [pooled(s0, 4) - 1, 3 * length(light[:, :1], light[:, 1:]), 10 * rms(own), 10 * rms(first[1]), 10 * rms(fine),
                 30 * pooled(r0, 4), 30 * length(back[:, :1], back[:, 1:]),
                 100 * (light * back).sum(1, keepdim=True), F.pixel_unshuffle(5 * first[0], 4)]
        asked = [[degree * detail, degree * size, degree * detail * bright] for detail, size, bright, degree in asked]
        share, told = shares([v for kinds in zip(*asked) for v in kinds], rough, r / 1000, power)
        of = share[:, :, None, None, None].unflatten(1, (KINDS, DETAILS)).unbind(1)
        made.append(sum((of[0][:, k] * detail + of[1][:, k] * detail.abs() + of[2][:, k] * detail * bright) * degree
                        for k, (detail, bright, degree) in enumerate(details)))
        candidates = [torch.cat([v[:, k:k + 1] for v in made], 1) for k in (0, 1)]
        seen = torch.cat([*seen, told[:, :, None, None].expand(-1, -1, *light.shape[2:])], 1)
        return *candidates, seen / (1 + seen.abs())


def shares(asked, rough, back, power):
    """What the readings of a whole tile say of candidates, [B, 2, T/4, T/4] each: with which shares of `asked`, all details of one kind
    after the other, the back-projected residual [B, 2, T, T] would be explained, [B, KINDS · DETAILS]; and what is told of it, [B, TOLD]:
    these shares, how far those of the details are sure by themselves, from 0 to 1, and the same of each of `rough` by itself.

    The readings hide every single detail in their noise, but a whole frame of them tells how much there is of it. With the mask
    taken for an even one ⟨A u, A v⟩ is ⅛ Σ |K|² û* v̂ and ⟨A u, r⟩ is ⟨u, Aᵀ r⟩; coarse pixels will do, for fine detail does not pass. The
    noise is taken from the residual: noise alone would have a mean square of ¼ mean |K|² once it is back-projected. A share s of variance
    v counts s²/(s² + SURE · v) of itself, so that where the readings say little nothing is added.
    """
    noise = (back.square().sum(1).mean((1, 2)) / power.mean((1, 2, 3)) / 4)[:, None]
    back = F.avg_pool2d(back, 4)
    n = back.shape[-1]
    low = torch.cat([power[..., :n // 2], power[..., -(n // 2):]], -1)
    low = torch.cat([low[..., :n // 2, :], low[..., -(n // 2):, :]], -2)
    flat = lambda v: torch.view_as_real(v).flatten(2)
    made = [*asked, *rough]
    spectra = torch.cat([torch.fft.fft2(torch.complex(v[:, 0], v[:, 1]), norm="ortho")[:, None] for v in made], 1)
    spectra = flat(spectra * (low / 8).sqrt())
    along = torch.stack([(v * back).sum((1, 2, 3)) for v in made], 1)
    k = len(asked)
    gram = spectra[:, :k] @ spectra[:, :k].mT
    doubt = torch.tensor(DOUBT, device=power.device).repeat_interleave(DETAILS) * noise + 1e-9
    inverse = torch.linalg.inv((gram + torch.diag_embed(doubt)).double()).float()
    share = (inverse @ along[:, :k, None]).squeeze(2)
    variance = inverse.diagonal(dim1=1, dim2=2) * noise
    share = (share**3 / (share**2 + SURE * variance + 1e-12)).clamp(-2, 2)
    own = gram.diagonal(dim1=1, dim2=2)[:, :DETAILS]
    of_rough = along[:, k:] / (spectra[:, k:].square().sum(2) + doubt[:, :1])
    return share, torch.cat([share, own / (own + doubt[:, :DETAILS]), of_rough.clamp(-2, 2)], 1)


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
        # to begin with, what the readings say is believed
        nn.init.ones_(self.tail.bias[16 * MADE:])

    def believe(self, candidates, share):
        """Keeps a share of what was learned of the weights of some candidates."""
        with torch.no_grad():
            for k in candidates:
                self.tail.weight[16 * k:16 * (k + 1)] *= share
                self.tail.bias[16 * k:16 * (k + 1)] *= share

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

    def forward(self, x, power):
        return self.mixed(x, power, self.weights)

    def mixed(self, x, power, trunk):
        """The answer with `trunk` in place of its own."""
        with torch.autocast(x.device.type, enabled=False):
            one, two, seen = self.candidates(x.float(), power.float())
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
    "default": ((18, 24, 40), (1, 1, 1)),
    "preview": ((12, 16, 24), (1, 1, 1)),
    # Not shipped: what more arithmetic would gain.
    "large": ((32, 48, 64), (1, 1, 2)),
    "largest": ((64, 96, 128), (2, 2, 3)),
}


def in_bytes(network):
    """The same network, its convolutions changed to ByteConv."""
    for module in list(network.modules()):
        for name, layer in module.named_children():
            if type(layer) is nn.Conv2d:
                made = ByteConv(layer.in_channels, layer.out_channels, layer.kernel_size, layer.stride, layer.padding)
                made.weight, made.bias = layer.weight, layer.bias
                setattr(module, name, made)
    return network


def cost(network):
    """Multiply-adds of one tile, interpolation and mixing included, and parameters."""
    total = (7 * len(LEVELS) + 2 * CANDIDATES) * TILE * TILE

    def count(layer, _, out):
        nonlocal total
        total += out.shape[2] * out.shape[3] * layer.weight.numel()

    hooks = [m.register_forward_hook(count) for m in network.modules() if isinstance(m, nn.Conv2d)]
    with torch.no_grad():
        network(torch.zeros(1, len(SCALES), TILE, TILE), torch.ones(1, 1, TILE, TILE))
    for hook in hooks:
        hook.remove()
    return total, sum(p.numel() for p in network.parameters())


if __name__ == "__main__":
    for name, (widths, blocks) in SIZES.items():
        macs, parameters = cost(Mixer(widths, blocks))
        print(f"{name}: {macs / 1e9:.3f} GMAC, {parameters / 1e3:.0f} k parameters")
