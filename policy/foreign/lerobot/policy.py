"""A LeRobot policy as this project's: from the contract's images and states to its actions."""

import torch
from torch import Tensor, nn

from policy.contract import Contract
from policy.foreign.lerobot.act import Act
from policy.foreign.lerobot.config import ActConfig
from policy.foreign.lerobot.diffusion import Diffusion
from policy.foreign.lerobot.plan import Plan
from policy.foreign.lerobot.statistics import Affine


class Normaliser(nn.Module):
    """``Affine`` and its inverse on tensors; the identity where there is none."""

    def __init__(self, affine: Affine | None) -> None:
        super().__init__()
        self.affine = affine
        self.shift: Tensor
        self.divisor: Tensor
        self.span: Tensor
        for name in ("shift", "divisor", "span"):
            array = torch.zeros(1) if affine is None else torch.from_numpy(getattr(affine, name))
            self.register_buffer(name, array, persistent=False)

    def forward(self, value: Tensor) -> Tensor:
        """To the range that the network takes."""
        if self.affine is None:
            return value
        return self.affine.gain * (value - self.shift) / self.divisor - self.affine.bias

    def back(self, value: Tensor) -> Tensor:
        """From the range that the network gives."""
        if self.affine is None:
            return value
        return (value + self.affine.bias) / self.affine.gain * self.span + self.shift


class LeRobotPolicy(nn.Module):
    """An ACT or a DiffusionPolicy; keeps ``policy.protocol.DualRatePolicy``.

    Images are RGB in [0, 1]; LeRobot's own statistics are applied inside, and the state's and
    action's numbers are put into the order, and the actions into the units, of the contract. Past
    actions are not looked at, and ACT ignores ``num_diffusion_steps``.
    """

    def __init__(self, plan: Plan) -> None:
        super().__init__()
        self.contract: Contract = plan.interface.contract
        config, normalisation = plan.config, plan.normalisation
        self.net: Act | Diffusion
        self.net = Act(config) if isinstance(config, ActConfig) else Diffusion(config)
        self._policy_cameras = plan.policy_cameras
        keys = config.features.image_keys
        self._images = nn.ModuleList(Normaliser(normalisation.images[key]) for key in keys)
        self._state, self._action = (
            Normaliser(normalisation.state),
            Normaliser(normalisation.action),
        )
        interface = plan.interface
        self._state_columns = interface.state_columns
        self._action_columns = interface.action_columns
        ones, zeros = (1.0,) * len(self._action_columns), (0.0,) * len(self._action_columns)
        self._scale: Tensor
        self.register_buffer("_scale", torch.tensor(interface.action_scale or ones), False)
        self._offset: Tensor
        self.register_buffer("_offset", torch.tensor(interface.action_offset or zeros), False)

    def encode_visual(self, image: Tensor, camera: int = 0) -> Tensor:
        """Image [B, 3, H, W] of that camera of the contract -> feature [B, feature_dim]."""
        own = self._policy_cameras[camera]
        return self.net.encode(self._images[own](image), own)

    def predict_fast(
        self, feature: Tensor, state: Tensor, action_history: Tensor, num_diffusion_steps: int
    ) -> Tensor:
        """Cached features [B, (T,) cameras * F] and states [B, (T,) S] -> chunk [B, horizon, 4]."""
        del action_history
        steps, cameras = self.contract.observation_steps, len(self._policy_cameras)
        by_camera = feature.reshape(feature.shape[0], steps, cameras, self.contract.feature_dim)
        if self._policy_cameras != tuple(range(cameras)):  # into the policy's order
            by_camera = by_camera[:, :, [self._policy_cameras.index(own) for own in range(cameras)]]
        own_state = state.reshape(state.shape[0], steps, -1)[..., self._state_columns]
        actions = self.net.act(by_camera, self._state(own_state), num_diffusion_steps)
        in_units = self._action.back(actions) * self._scale + self._offset
        return in_units[..., self._action_columns]

    def predict(
        self, image: Tensor, state: Tensor, action_history: Tensor, num_diffusion_steps: int
    ) -> Tensor:
        """Images [B, (T,) (cameras,) 3, H, W]: encode all of them and sample one chunk."""
        contract = self.contract
        batch, steps, cameras = image.shape[0], contract.observation_steps, len(contract.cameras)
        images = image.reshape(batch, steps, cameras, *image.shape[-3:])
        features = [
            self.encode_visual(images[:, step, camera], camera)
            for step in range(steps)
            for camera in range(cameras)
        ]
        feature = torch.cat(features, dim=1).reshape(batch, *contract.feature_shape)
        return self.predict_fast(feature, state, action_history, num_diffusion_steps)
