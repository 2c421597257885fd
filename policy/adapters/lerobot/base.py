"""LeRobot policies behind the policy protocol: the contract's images and states to its actions."""

import numpy as np
import torch
from torch import Tensor, nn

from policy.adapters.lerobot.plan import Affine, Plan
from policy.contract import Contract
from policy.protocol import predict_by_pair


class Normaliser(nn.Module):
    """``Affine`` and its inverse on tensors; the identity without statistics."""

    def __init__(self, affine: Affine | None) -> None:
        super().__init__()
        self.affine = affine
        arrays = (affine.shift, affine.divisor, affine.span) if affine else [np.zeros(1, "f4")] * 3
        self.shift, self.divisor, self.span = (
            nn.Buffer(torch.from_numpy(array), persistent=False) for array in arrays
        )

    def forward(self, value: Tensor) -> Tensor:
        """Normalise to the network's input range."""
        if self.affine is None:
            return value
        return self.affine.gain * (value - self.shift) / self.divisor - self.affine.bias

    def back(self, value: Tensor) -> Tensor:
        """Undo the normalisation of the network's output."""
        if self.affine is None:
            return value
        return (value + self.affine.bias) / self.affine.gain * self.span + self.shift


class LeRobotPolicy(nn.Module):
    """Base of ACT and DiffusionPolicy, behind ``policy.protocol.DualRatePolicy``.

    Images are RGB in [0, 1]. The policy applies LeRobot's statistics inside, reorders the numbers
    of state and action, and scales actions to the contract's units. It ignores past actions.
    Parameters have LeRobot's names, or those of ``own_name``.
    """

    prefix: str
    """Prefix of the parameter names in LeRobot's file."""

    def __init__(self, plan: Plan) -> None:
        super().__init__()
        self.contract: Contract = plan.interface.contract
        normalisation = plan.normalisation
        self._interface, self._policy_cameras = plan.interface, plan.policy_cameras
        keys = plan.config.features.image_keys
        self._images = nn.ModuleList(Normaliser(normalisation.images[key]) for key in keys)
        self._state = Normaliser(normalisation.state)
        self._action = Normaliser(normalisation.action)

    @staticmethod
    def own_name(name: str) -> str | None:
        """Return our name of a parameter in LeRobot's file, without the prefix; None: unused."""
        raise NotImplementedError

    def encode(self, image: Tensor, camera: int) -> Tensor:
        """Encode a normalised image [B, 3, H, W] of one of LeRobot's cameras -> feature [B, F]."""
        raise NotImplementedError

    def encode_visual(self, image: Tensor, camera: int = 0) -> Tensor:
        """Encode an image [B, 3, H, W] of one of the contract's cameras -> feature [B, F]."""
        own = self._policy_cameras[camera]
        return self.encode(self._images[own](image), own)

    predict = predict_by_pair

    def network_inputs(self, feature: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return features [B, T, cameras, F] and normalised states [B, T, S] in LeRobot's order."""
        steps, cameras = self.contract.observation_steps, len(self._policy_cameras)
        by_camera = feature.reshape(feature.shape[0], steps, cameras, self.contract.feature_dim)
        if self._policy_cameras != tuple(range(cameras)):
            by_camera = by_camera[:, :, [self._policy_cameras.index(own) for own in range(cameras)]]
        own_state = self._interface.to_state(state.reshape(state.shape[0], steps, -1))
        return by_camera, self._state(own_state)

    def in_units(self, actions: Tensor) -> Tensor:
        """Convert the network's actions [..., 4] to the contract's."""
        return self._interface.to_actions(self._action.back(actions))
