"""The world model as a planner runs it: the imagined step of `SafetyWorldModel`, the same function
in fewer and smaller operations.

For frozen weights and inference alone; a test holds it against the model itself. Dimension letters:
R rows, B rows before they are repeated, D deterministic size, S variables, C classes, Z = S * C, A
actions.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent
from wasp_cli.models.coded import Coded, first_layer, in_place, looked_up
from wasp_cli.models.world_model import SafetyWorldModel


class PackedModel:
    """Imagined steps of a frozen world model; its weights are laid out once, when it is made."""

    def __init__(self, model: SafetyWorldModel) -> None:
        rssm = model.rssm
        self.rssm, self.deter, self.flat = rssm, rssm.deter, rssm.flat
        linear, self.norm, _ = rssm.inputs
        assert isinstance(linear, nn.Linear)
        inputs = first_layer(linear, rssm.flat)  # of z, then of the action
        self.of_z, self.of_action, self.bias = inputs.h, inputs.z, inputs.bias
        # Reset and update gate are one sigmoid of x W + h U; of the new memory only h U is gated.
        cell, gates = rssm.cell, 2 * rssm.deter
        of_x, of_h = cell.weight_ih.detach().t(), cell.weight_hh.detach().t()
        self.gate_x, self.gate_h = of_x[:, :gates].contiguous(), of_h[:, :gates].contiguous()
        self.gate_bias = (cell.bias_ih + cell.bias_hh)[:gates]
        # tanh(x) = 2 sigmoid(2 x) - 1, and torch's sigmoid takes a third of the time of its tanh.
        self.new_x, self.new_h = 2 * of_x[:, gates:].contiguous(), 2 * of_h[:, gates:].contiguous()
        self.new_bias_x, self.new_bias_h = 2 * cell.bias_ih[gates:], 2 * cell.bias_hh[gates:]
        # The class is written into the lowest bits of its score: the largest score then names its
        # class.
        bits = (rssm.classes - 1).bit_length()
        device = linear.weight.device
        self.lowest = (1 << bits) - 1
        self.classes = torch.arange(rssm.classes, dtype=torch.int32, device=device)
        self.places = rssm.classes * torch.arange(rssm.variables, dtype=torch.int32, device=device)

    def chances(self, noise: Tensor) -> Tensor:
        """Convert standard Gumbel draws [..., Z] to what `imagine` reads: of log p + g and p
        e^g the same class is the largest.
        """
        return noise.exp()

    def room(self, steps: int, rows: int) -> Coded:
        """Return room for the arrived latents of a rollout, [K, R, .]."""
        h = self.gate_bias.new_empty(steps, rows, self.deter)
        return Coded.of(h, self.places.new_empty(steps, rows, len(self.places)), self.flat)

    def imagine(
        self, latent: Latent, action: Tensor, chances: Tensor, arrived: Coded, copies: int = 1
    ) -> Coded:
        """Imagine one prior step, as `SafetyWorldModel.imagine` does, into `arrived` [R, .]; return
        it.

        Args:
            latent: [B, .]; each row stands for `copies` adjacent ones of the R.
            action: [R, A].
            chances: `chances` of the Gumbel draws [R, Z].
            arrived: a step of `room`.
            copies: R / B.
        """
        h = latent.h
        of_z = looked_up(self.of_z, latent.z) if isinstance(latent, Coded) else latent.z @ self.of_z
        gates, new = (
            torch.addmm(self.gate_bias, h, self.gate_h),
            torch.addmm(self.new_bias_h, h, self.new_h),
        )
        if copies > 1:
            h, of_z, gates, new = (
                part.repeat_interleave(copies, 0) for part in (h, of_z, gates, new)
            )
        x = torch.addmm(self.bias, self.rssm.scaled(action), self.of_action).add_(of_z)
        x = F.silu(in_place(self.norm, x), inplace=True)
        reset, update = gates.addmm_(x, self.gate_x).sigmoid_().split(self.deter, -1)
        new = new.mul_(reset).addmm_(x, self.new_x).add_(self.new_bias_x).sigmoid_().mul_(2).sub_(1)
        torch.lerp(new, h, update, out=arrived.h)
        self._draw(arrived.h, chances, arrived.z)
        return arrived

    def _draw(self, h: Tensor, chances: Tensor, out: Tensor) -> None:
        """Draw the classes of z by the Gumbel trick: positions of the ones, into `out` [R, S]."""
        rssm, logits = self.rssm, h
        for layer in rssm.prior_net:
            logits = in_place(layer, logits)
        scores = logits.float().unflatten(-1, (rssm.variables, rssm.classes)).softmax(-1)
        # (1 - u) p + u / C, but for a factor that all classes share.
        scores.add_(rssm.unimix / rssm.classes / (1 - rssm.unimix)).mul_(chances.view_as(scores))
        # Of positive floats the larger one has the larger bits.
        named = scores.view(torch.int32).bitwise_and_(~self.lowest).bitwise_or_(self.classes)
        torch.amax(named, -1, out=out)
        out.bitwise_and_(self.lowest).add_(self.places)
