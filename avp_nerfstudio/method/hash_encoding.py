"""nerfstudio's hash encoding as two compiled loops, because a CPU spends most of a reconstruction in it.

The loops run on one thread: a second pool of threads beside torch's, whose idle threads spin, made a step on two busy
cores ten times slower.
"""

from typing import Any

import numpy as np
import torch
from nerfstudio.field_components.encodings import HashEncoding
from numpy.typing import NDArray
from torch import Tensor, nn

from avp_habitat.compiled import njit

# Primes of the spatial hash (Müller et al., Instant Neural Graphics Primitives, 2022, Eq. 4), as nerfstudio has them.
_PRIME_Y = 2654435761
_PRIME_Z = 805459861


@njit(fastmath=True)
def _corners(x, y, z, base, mask):  # pragma: no cover - compiled
    """Table rows of the 8 grid corners around a point, x fastest; written out, since loops cost ten times as much."""
    x0, y0, z0 = np.int64(x), np.int64(y) * _PRIME_Y, np.int64(z) * _PRIME_Z
    x1, y1, z1 = x0 + 1, y0 + _PRIME_Y, z0 + _PRIME_Z
    h00, h10, h01, h11 = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
    return (
        base + ((x0 ^ h00) & mask),
        base + ((x1 ^ h00) & mask),
        base + ((x0 ^ h10) & mask),
        base + ((x1 ^ h10) & mask),
        base + ((x0 ^ h01) & mask),
        base + ((x1 ^ h01) & mask),
        base + ((x0 ^ h11) & mask),
        base + ((x1 ^ h11) & mask),
    )


@njit(fastmath=True)
def _weights(x, y, z):  # pragma: no cover - compiled
    """Trilinear weights of the 8 grid corners around a point, in the order of `_corners`."""
    one = np.float32(1)
    x1, y1, z1 = x - np.float32(np.int64(x)), y - np.float32(np.int64(y)), z - np.float32(np.int64(z))
    x0, y0, z0 = one - x1, one - y1, one - z1
    w00, w10, w01, w11 = y0 * z0, y1 * z0, y0 * z1, y1 * z1
    return x0 * w00, x1 * w00, x0 * w10, x1 * w10, x0 * w01, x1 * w01, x0 * w11, x1 * w11


@njit(fastmath=True, cache=True)
def _encode(positions, scalings, table, mask, encoded):  # pragma: no cover - compiled
    features = table.shape[1]
    for i in range(positions.shape[0]):
        for level in range(scalings.shape[0]):
            scaling = scalings[level]
            x, y, z = positions[i, 0] * scaling, positions[i, 1] * scaling, positions[i, 2] * scaling
            a, b, c, d, e, f, g, h = _corners(x, y, z, level * (mask + 1), mask)
            wa, wb, wc, wd, we, wf, wg, wh = _weights(x, y, z)
            for k in range(features):
                near = wa * table[a, k] + wb * table[b, k] + wc * table[c, k] + wd * table[d, k]
                far = we * table[e, k] + wf * table[f, k] + wg * table[g, k] + wh * table[h, k]
                encoded[i, level * features + k] = near + far


@njit(fastmath=True, cache=True)
def _spread(positions, scalings, mask, gradient, out):  # pragma: no cover - compiled
    features = out.shape[1]
    for level in range(scalings.shape[0]):
        scaling = scalings[level]
        for i in range(positions.shape[0]):
            x, y, z = positions[i, 0] * scaling, positions[i, 1] * scaling, positions[i, 2] * scaling
            a, b, c, d, e, f, g, h = _corners(x, y, z, level * (mask + 1), mask)
            wa, wb, wc, wd, we, wf, wg, wh = _weights(x, y, z)
            for k in range(features):
                value = gradient[i, level * features + k]
                out[a, k] += wa * value
                out[b, k] += wb * value
                out[c, k] += wc * value
                out[d, k] += wd * value
                out[e, k] += we * value
                out[f, k] += wf * value
                out[g, k] += wg * value
                out[h, k] += wh * value


class _Encode(torch.autograd.Function):
    """Features of positions, with the gradient of the table; none of the positions."""

    @staticmethod
    def forward(ctx: Any, positions: Tensor, table: Tensor, scalings: NDArray[np.float32], mask: int) -> Tensor:
        ctx.positions = positions.detach().numpy()
        ctx.scalings, ctx.mask, ctx.shape = scalings, mask, table.shape
        encoded = torch.empty(len(positions), len(scalings) * table.shape[1])
        _encode(ctx.positions, scalings, table.detach().numpy(), mask, encoded.numpy())
        return encoded

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, None, None]:
        table_gradient = torch.zeros(ctx.shape)
        _spread(ctx.positions, ctx.scalings, ctx.mask, gradients[0].contiguous().numpy(), table_gradient.numpy())
        return None, table_gradient, None, None


class CompiledHashEncoding(HashEncoding):
    """`HashEncoding` with the same parameters and values (to float32 rounding), about ten times faster on a CPU.

    It gives positions no gradient, which only predicted normals and camera optimisers ask for. On other devices it is
    nerfstudio's own implementation.
    """

    def __init__(self, like: HashEncoding) -> None:
        """Take over the shape and the table of another hash encoding of the torch implementation."""
        nn.Module.__init__(self)
        # Its settings; parameters and modules are kept elsewhere.
        self.__dict__.update({name: value for name, value in vars(like).items() if not name.startswith("_")})
        self.tcnn_encoding = None
        self.hash_table = like.hash_table
        self._scalings = like.scalings.numpy().astype(np.float32)

    def forward(self, in_tensor: Tensor) -> Tensor:
        """Features, `(..., levels * features)`, of positions in [0, 1], `(..., 3)`."""
        if in_tensor.device.type != "cpu":
            return self.pytorch_fwd(in_tensor)
        flat = in_tensor.reshape(-1, 3).to(torch.float32).contiguous()
        encoded = _Encode.apply(flat, self.hash_table, self._scalings, self.hash_table_size - 1)
        return encoded.view(*in_tensor.shape[:-1], -1)


def compile_hash_encodings(module: nn.Module) -> None:
    """Replace every torch-implemented hash encoding inside a module; parameters and their names stay."""
    for parent in list(module.modules()):
        for name, child in list(parent.named_children()):
            if type(child) is HashEncoding and child.tcnn_encoding is None:
                setattr(parent, name, CompiledHashEncoding(child))


def compile_loops() -> None:
    """Load the compiled loops from numba's cache, or compile them, for the types that trainings call them with."""
    positions, scalings = np.zeros((1, 3), np.float32), np.ones(1, np.float32)
    table, encoded = np.zeros((8, 2), np.float32), np.zeros((1, 2), np.float32)
    _encode(positions, scalings, table, 7, encoded)
    _spread(positions, scalings, 7, encoded, table)
