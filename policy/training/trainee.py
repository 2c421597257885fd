"""The optimised module: a policy, a gate head that is not exported, and their losses."""

from collections.abc import Iterable
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import ACTION_DIM, FloatArray
from policy.nets.diffusion import SIZE_DIMS
from policy.nets.toge import Toge
from policy.training.batches import Batch, StepLoss, normalised
from policy.training.report import PolicyValidation

GATE_LABELS = 10
"""Direction [3] and log distance of the next gate, cos and sin of its passage, direction [3] and
log distance of the gate after it."""
MIN_STICK_STD = 0.1
"""Lower bound of a stick's standard deviation: bounds the weight of a stick that hardly moves."""
DENOISED = 4
"""In training, one sample in this many passes through the denoiser.

The denoiser costs four times as much as the layers before it, which learn the harder part: the
sticks for a feature and a state. All samples teach these layers, through the sticks that the head
reads off the condition.
"""
LEAST_DENOISED = 16
"""Minimum number of samples per step through the denoiser."""
FLOWN_STEPS = 1
"""Denoising steps of taught and compared sticks: as many as our own networks take in flight."""


class Trainee(nn.Module):
    """Policy with its gate head, and the mean and spread of the sticks to imitate."""

    def __init__(self, policy: Toge, gate_weight: float) -> None:
        super().__init__()
        self.policy = policy
        self.gate_head = nn.Linear(SIZE_DIMS[policy.config.size].base_dim, GATE_LABELS)
        self._gate_weight = gate_weight
        self.stick_mean = nn.Buffer(torch.zeros(ACTION_DIM))
        self.stick_std = nn.Buffer(torch.ones(ACTION_DIM))

    def set_sticks(self, sticks: FloatArray) -> None:
        """Store the mean and the spread of all sticks [M, 4]."""
        values = torch.from_numpy(sticks)
        self.stick_mean.copy_(values.mean(dim=0))
        self.stick_std.copy_(values.std(dim=0, correction=0).clamp_min(MIN_STICK_STD))

    def encode(self, batch: Batch) -> Tensor:
        """Return outputs of the backbone [B, D]: the stored ones, or those of the images."""
        if batch.features is not None:
            return batch.features
        features: Tensor = self.policy.backbone(normalised(batch, self.policy.contract))
        return features

    @torch.no_grad()
    def encoded(self, batch: Batch) -> Batch:
        """Return the batch with features in place of its images."""
        return replace(batch, features=self.encode(batch), images=None, grain=None)

    @torch.no_grad()
    def teach(self, batch: Batch) -> Batch:
        """Return the batch with this policy's own chunks where a gate is still to come."""
        own = self.sample(batch, FLOWN_STEPS)
        is_next = ~batch.gate[:, 0].isnan().repeat_interleave(len(own) // len(batch.gate))
        chunk = torch.where(is_next[:, None, None], own, batch.chunk)
        return replace(batch, chunk=chunk, known=batch.known | is_next[:, None])

    def sample(self, batch: Batch, num_diffusion_steps: int) -> Tensor:
        """Sample chunks [S, horizon, 4] for the samples of a batch."""
        visual = self.policy.visual_projection(self.encode(batch))
        return self.policy.head.sample(self.condition(visual, batch), num_diffusion_steps).float()

    def condition(self, visual: Tensor, batch: Batch) -> Tensor:
        """Return conditions [S, C] of projected images [B, C], each used for all of its samples."""
        visual = visual.repeat_interleave(len(batch.state) // len(visual), dim=0)
        state_token = self.policy.state_encoder(batch.state)
        return self.policy.condition(visual, state_token, batch.history)

    def forward(self, batch: Batch) -> StepLoss:
        """Return the losses of a batch.

        ``loss`` and ``direct_loss`` are squared errors, of the denoised sticks and of those read
        off the condition, divided by the variance of the flown ones: the mean stick gives 1.
        ``gate_loss`` is the smooth L1 of the gate labels, 0 if no image has one.
        """
        visual = self.policy.visual_projection(self.encode(batch))
        condition = self.condition(visual, batch)
        direct = self.policy.head.read(condition).float()
        losses = {
            "loss": self._denoising_loss(condition, batch),
            "direct_loss": _squared((direct - batch.chunk) / self.stick_std, batch.known),
            "gate_loss": gate_loss(self.gate_head(visual).float(), batch.gate),
        }
        total = losses["loss"] + losses["direct_loss"] + self._gate_weight * losses["gate_loss"]
        return StepLoss(total=total, metrics=losses)

    def _denoising_loss(self, condition: Tensor, batch: Batch) -> Tensor:
        """Return the denoiser's loss, in training of one sample in ``DENOISED``, else of all."""
        every = max(1, min(DENOISED, len(condition) // LEAST_DENOISED)) if self.training else 1
        chunk, timestep = batch.chunk[::every], batch.timestep[::every]
        noise, schedule = batch.noise[::every], self.policy.config.schedule
        noisy = schedule.add_noise(chunk, noise, timestep)
        made = self.policy.head.denoise(noisy, timestep, condition[::every]).float()
        return _squared((made - chunk) / self.stick_std, batch.known[::every])


def _squared(error: Tensor, known: Tensor) -> Tensor:
    """Return the mean square of errors [S, horizon, 4] over the entries ``known`` [S, horizon]."""
    return error.square().mean(dim=-1)[known].mean()


def gate_labels(gate: Tensor) -> Tensor:
    """Convert [B, 7] in body axes to labels [B, 10] of about 1; NaN if unknown or behind."""

    def place(position: Tensor) -> Tensor:
        position = torch.where(position[:, :1] > 0, position, torch.nan)
        distance = position.norm(dim=1, keepdim=True).clamp_min(0.1)
        return torch.cat([position / distance, (distance / 10.0).log()], dim=1)

    yaw = torch.where(gate[:, :1] > 0, gate[:, 3:4], torch.nan)
    return torch.cat([place(gate[:, :3]), yaw.cos(), yaw.sin(), place(gate[:, 4:])], dim=1)


def gate_loss(made: Tensor, gate: Tensor) -> Tensor:
    """Return the smooth L1 [] of predicted labels [B, 10], over the known ones."""
    labels = gate_labels(gate)
    known = ~labels.isnan()
    error = F.smooth_l1_loss(made, labels.nan_to_num(0.0), reduction="none")
    return (error * known).sum() / known.sum().clamp_min(1)


@torch.no_grad()
def validate(trainee: Trainee, batches: Iterable[Batch]) -> PolicyValidation:
    """Return losses and stick errors over all ``batches`` of features, weighted by their size."""
    totals, weight = torch.zeros(5, dtype=torch.float64), 0
    for batch in batches:
        losses = trainee(batch).metrics
        chunk = trainee.sample(batch, FLOWN_STEPS)
        held = batch.history[:, -1:].expand_as(batch.chunk)
        guesses = (chunk, trainee.stick_mean.expand_as(batch.chunk), held)
        errors = [(guess - batch.chunk).abs()[batch.known].mean() for guess in guesses]
        values = torch.stack([losses["loss"], losses["gate_loss"], *errors]).double().cpu()
        totals += len(batch.state) * values
        weight += len(batch.state)
    loss, gate, sticks, mean, hold = (totals / weight).tolist()
    return PolicyValidation(
        loss=loss,
        gate_loss=gate,
        stick_error=sticks,
        mean_stick_error=mean,
        hold_error=None if trainee.policy.contract.action == "rates" else hold,
    )
