"""LeRobot policies behind the policy protocol: the contract's images and states to its actions."""

from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from policy.adapters.lerobot.act import Act
from policy.adapters.lerobot.config import ActConfig
from policy.adapters.lerobot.diffusion import Diffusion
from policy.adapters.lerobot.plan import WEIGHTS_FILE, Affine, Plan
from policy.checkpoints.tensors import load_fitting, read_tensors
from policy.contract import Contract
from policy.protocol import predict_by_pair


class Normaliser(nn.Module):
    """``Affine`` and its inverse on tensors; the identity without statistics."""

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
    """ACT or DiffusionPolicy behind ``policy.protocol.DualRatePolicy``.

    Images are RGB in [0, 1]. The policy applies LeRobot's statistics inside, reorders the numbers
    of state and action, and scales actions to the contract's units. It ignores past actions; ACT
    also ignores ``num_diffusion_steps``.
    """

    net: Act | Diffusion

    def __init__(self, plan: Plan, net: Act | Diffusion) -> None:
        super().__init__()
        self.net = net
        self.contract: Contract = plan.interface.contract
        normalisation = plan.normalisation
        self._interface, self._policy_cameras = plan.interface, plan.policy_cameras
        keys = plan.config.features.image_keys
        self._images = nn.ModuleList(Normaliser(normalisation.images[key]) for key in keys)
        self._state = Normaliser(normalisation.state)
        self._action = Normaliser(normalisation.action)

    def encode_visual(self, image: Tensor, camera: int = 0) -> Tensor:
        """Encode an image [B, 3, H, W] of one of the contract's cameras -> feature [B, F]."""
        own = self._policy_cameras[camera]
        return self.net.encode(self._images[own](image), own)

    def predict_fast(
        self, feature: Tensor, state: Tensor, action_history: Tensor, num_diffusion_steps: int
    ) -> Tensor:
        """Sample a chunk [B, horizon, 4]; features [B, (T,) cameras * F], states [B, (T,) S]."""
        inputs = self._network_inputs(feature, state)
        return self._in_units(self.net.act(*inputs, num_diffusion_steps))

    predict = predict_by_pair

    def _network_inputs(self, feature: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return features [B, T, cameras, F] and normalised states [B, T, S] in LeRobot's order."""
        steps, cameras = self.contract.observation_steps, len(self._policy_cameras)
        by_camera = feature.reshape(feature.shape[0], steps, cameras, self.contract.feature_dim)
        if self._policy_cameras != tuple(range(cameras)):
            by_camera = by_camera[:, :, [self._policy_cameras.index(own) for own in range(cameras)]]
        own_state = self._interface.to_state(state.reshape(state.shape[0], steps, -1))
        return by_camera, self._state(own_state)

    def _in_units(self, actions: Tensor) -> Tensor:
        return self._interface.to_actions(self._action.back(actions))


class LeRobotDiffusion(LeRobotPolicy):
    """DiffusionPolicy behind ``policy.protocol.StepwisePolicy``."""

    net: Diffusion

    def __init__(self, plan: Plan, net: Diffusion) -> None:
        super().__init__(plan, net)
        self.schedule = net.schedule

    @property
    def initial_noise(self) -> Tensor:
        """[1, predicted, 4]; fixed for a whole flight."""
        return self.net.initial_noise

    def denoise(
        self,
        noisy: Tensor,
        timestep: Tensor,
        feature: Tensor,
        state: Tensor,
        action_history: Tensor,
    ) -> Tensor:
        """Call the network once on noisy actions [B, predicted, 4] at timesteps [B]."""
        of_condition = self.net.film_of_condition(*self._network_inputs(feature, state))
        return self.net.denoise(noisy, timestep, of_condition)

    def to_chunk(self, sample: Tensor) -> Tensor:
        """Convert the end of a solve [B, predicted, 4] to a chunk [B, horizon, 4]."""
        return self._in_units(self.net.from_now(sample))


def load_policy_of(
    plan: Plan, *, seed: int, num_diffusion_steps: int
) -> tuple[LeRobotPolicy, list[str]]:
    """Build a policy, load its weights, draw the initial noise; return notes for the user too."""
    path, advice = plan.folder / WEIGHTS_FILE, "Copy both files again, from one folder"
    policy: LeRobotPolicy
    if isinstance(plan.config, ActConfig):
        act = partial(Act, plan.config)
        policy = LeRobotPolicy(plan, load_fitting(path, act, _read(path, Act), advice))
    else:
        diffusion = partial(Diffusion, plan.config)
        net = load_fitting(path, diffusion, _read(path, Diffusion), advice)
        policy = LeRobotDiffusion(plan, net)
    policy.eval().requires_grad_(False)
    config, kind = plan.config, "ACT" if isinstance(plan.config, ActConfig) else "DiffusionPolicy"
    millions = sum(parameter.numel() for parameter in policy.parameters()) / 1e6
    notes = [*plan.notes, f"LeRobot's {kind} of {plan.folder}, {millions:.1f} M parameters"]
    if isinstance(config, ActConfig):
        if config.temporal_ensemble_coeff is not None:
            notes.append(
                "its temporal ensembling is not computed: the guard smooths from chunk to chunk"
            )
    elif isinstance(policy, LeRobotDiffusion):
        policy.net.seed_noise(seed)
        notes.append(
            f"solved by DDIM in {num_diffusion_steps} steps (--num-diffusion-steps) from noise of "
            f"seed {seed}; its config.json says {config.noise_scheduler_type} in "
            f"{config.num_inference_steps}. More steps come closer to that, and take longer"
        )
    return policy, notes


def _read(path: Path, net: type[Act | Diffusion]) -> dict[str, Tensor]:
    """Return the weights of LeRobot's file under our names."""
    state = {}
    for name, value in read_tensors(path)[1].items():
        ours = net.own_name(name.removeprefix(net.prefix)) if name.startswith(net.prefix) else name
        if ours is not None:
            state[ours] = value
    return state
