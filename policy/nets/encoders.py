"""Encoders of the state and the action history, and their fusion with the visual feature."""

import torch
from torch import Tensor, nn

from policy.contract import ACTION_DIM, Contract
from policy.errors import ContractError, PolicyError
from policy.nets.attention import Attention, is_tracing
from policy.preprocess import egocentric_columns, egocentric_scale

HEADS = 4


def require_shape(name: str, array: Tensor, *shape: int) -> None:
    """Raise a ``PolicyError`` unless ``array`` is [B, *shape]."""
    if array.ndim != len(shape) + 1 or tuple(array.shape[1:]) != shape:
        wanted = ", ".join(["B", *map(str, shape)])
        raise PolicyError(f"{name} must be [{wanted}], got {list(array.shape)}")


class StateEncoder(nn.Module):
    """State [B, state_dim] in SI units -> token [B, dim]."""

    def __init__(self, dim: int, contract: Contract) -> None:
        super().__init__()
        is_plain = len(contract.cameras) == 1 and contract.observation_steps == 1
        if not is_plain or contract.state_extras or contract.is_depth:
            raise ContractError(
                "the networks of this project take the newest image of one camera in colour and "
                f"the newest state; the contract asks for {contract.image_channels} of cameras "
                f"{list(contract.cameras)}, "
                f"{contract.observation_steps} observations and extras "
                f"{list(contract.state_extras)}: use a policy class of your own"
            )
        scale = egocentric_scale(contract)
        self.mlp = nn.Sequential(nn.Linear(len(scale), dim), nn.SiLU(), nn.Linear(dim, dim))
        self._scale = nn.Buffer(torch.tensor(scale), persistent=False)

    def normalise(self, state: Tensor) -> Tensor:
        """Apply ``preprocess.egocentric`` to tensors."""
        return torch.stack(egocentric_columns(state.unbind(1)), dim=1) / self._scale

    def forward(self, state: Tensor) -> Tensor:
        """Encode a state [B, state_dim] -> token [B, dim]."""
        token: Tensor = self.mlp(self.normalise(state))
        return token


class AttentionBlock(Attention):
    """Self-attention and an MLP, each after a norm, around a shortcut; [B, T, dim] -> same."""

    def __init__(self, dim: int) -> None:
        super().__init__(dim, HEADS)
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, 2 * dim), nn.SiLU(), nn.Linear(2 * dim, dim))

    def transform(self, tokens: Tensor) -> Tensor:
        """Transform tokens [B, T, dim] to the same shape, each informed by all."""
        tokens = tokens + self.among(self.norm1(tokens), plainly=is_tracing())
        out: Tensor = tokens + self.mlp(self.norm2(tokens))
        return out


class HistoryEncoder(nn.Module):
    """Past actions [B, K, 4], oldest first, through self-attention -> [B, out_dim]."""

    def __init__(self, dim: int, history_len: int) -> None:
        super().__init__()
        self.out_dim = history_len * dim
        self.embed = nn.Linear(ACTION_DIM, dim)
        self.position = nn.Parameter(0.02 * torch.randn(1, history_len, dim))
        self.attention = AttentionBlock(dim)

    def forward(self, action_history: Tensor) -> Tensor:
        """Encode past actions [B, K, 4] -> concatenated tokens [B, K * dim]."""
        tokens = self.attention.transform(self.embed(action_history) + self.position)
        return tokens.flatten(1)


class Fusion(nn.Module):
    """Visual token, state token and encoded history -> condition [B, dim].

    The right sticks depend jointly on the view and on the vehicle's motion. That takes depth, and
    depth is cheapest here: a layer costs a hundredth of the denoiser. In equal training time,
    attention among the tokens reached a stick error of 0.091, this network 0.085.
    """

    def __init__(self, dim: int, history_dim: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(2 * dim + history_dim, 2 * dim),
            nn.SiLU(),
            nn.Linear(2 * dim, 2 * dim),
            nn.SiLU(),
            nn.Linear(2 * dim, 2 * dim),
            nn.SiLU(),
            nn.Linear(2 * dim, dim),
        )

    def forward(self, visual: Tensor, state: Tensor, history: Tensor) -> Tensor:
        """Fuse visual and state tokens [B, dim], history [B, history_dim] -> condition [B, dim]."""
        condition: Tensor = self.mlp(torch.cat([visual, state, history], dim=1))
        return condition
