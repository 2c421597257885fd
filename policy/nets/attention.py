"""Multi-head attention, for every network of this project and for LeRobot's ACT."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Attention(nn.Module):
    """Scaled dot-product attention over [B, L, dim]; one layer computes queries, keys and values.

    ``nn.MultiheadAttention`` traces to a torch-specific operation that no other engine supports.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.project = nn.Linear(dim, 3 * dim), nn.Linear(dim, dim)

    def forward(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attend from a query [B, L, dim] to key and value [B, M, dim] -> [B, L, dim]."""
        weights, biases = self.qkv.weight.chunk(3), self.qkv.bias.chunk(3)
        q, k, v = (
            F.linear(x, weight, bias).reshape(*x.shape[:2], self.heads, -1).transpose(1, 2)
            for x, weight, bias in zip((query, key, value), weights, biases, strict=True)
        )
        return self._merged(F.scaled_dot_product_attention(q, k, v))

    def among(self, tokens: Tensor, *, is_causal: bool = False, plainly: bool = False) -> Tensor:
        """Attend from tokens [B, L, dim] to all of them, or to those before each.

        ``plainly`` spells the operation out: OpenVINO's fused one (2026.4) is wrong in float32 over
        a few tokens.
        """
        batch, count, dim = tokens.shape
        qkv = self.qkv(tokens).reshape(batch, count, 3, self.heads, dim // self.heads)
        heads = qkv.permute(2, 0, 3, 1, 4)
        if plainly:
            query, key, value = heads.chunk(3)
            scores = query @ key.transpose(-2, -1) * (dim // self.heads) ** -0.5
            return self._merged((scores.softmax(dim=-1) @ value).squeeze(0))
        query, key, value = heads.unbind(0)
        return self._merged(F.scaled_dot_product_attention(query, key, value, is_causal=is_causal))

    def _merged(self, attended: Tensor) -> Tensor:
        """Merge the heads: [B, heads, L, dim / heads] -> [B, L, dim]."""
        out: Tensor = self.project(attended.transpose(1, 2).flatten(2))
        return out


def is_tracing() -> bool:
    """True while torch traces the computation for another engine."""
    return bool(torch.jit.is_tracing())  # type: ignore[attr-defined, no-untyped-call]
