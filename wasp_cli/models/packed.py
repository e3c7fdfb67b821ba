"""The world model as a planner runs it: the imagined step of `SafetyWorldModel`, the same function
in fewer and smaller operations.

For frozen weights and inference alone; a test compares it with the model itself. Dimension letters:
R rows, B rows before they are repeated, K steps, D deterministic size, S variables, C classes,
Z = S * C, A actions.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent
from wasp_cli.models.coded import Coded, first_layer, in_place, looked_up
from wasp_cli.models.world_model import SafetyWorldModel


class PackedModel:
    """Imagined steps of a frozen world model. Its weights are laid out once, when it is made."""

    def __init__(self, model: SafetyWorldModel) -> None:
        """Lay out the weights of a model, which must not change afterwards."""
        rssm = model.rssm
        self.rssm = rssm
        self.deter = rssm.deter
        self.flat = rssm.flat

        # The layer of (z, a): the parts of z and of the action.
        linear, self.norm, _ = rssm.inputs
        assert isinstance(linear, nn.Linear)
        inputs = first_layer(linear, rssm.flat)
        self.of_z = inputs.h
        self.of_action = inputs.z
        self.bias = inputs.bias

        # The GRU. Reset and update gate are one sigmoid of x W + h U; of the new memory only h U is
        # gated.
        cell = rssm.cell
        gates = 2 * rssm.deter
        of_x = cell.weight_ih.detach().t()
        of_h = cell.weight_hh.detach().t()
        self.gate_x = of_x[:, :gates].contiguous()
        self.gate_h = of_h[:, :gates].contiguous()
        self.gate_bias = (cell.bias_ih + cell.bias_hh)[:gates]
        # tanh(x) = 2 sigmoid(2 x) - 1, and torch's sigmoid takes a third of the time of its tanh.
        self.new_x = 2 * of_x[:, gates:].contiguous()
        self.new_h = 2 * of_h[:, gates:].contiguous()
        self.new_bias_x = 2 * cell.bias_ih[gates:]
        self.new_bias_h = 2 * cell.bias_hh[gates:]

        # The draw of z. The class is written into the lowest bits of its score, so that the largest
        # score tells its class.
        bits = (rssm.classes - 1).bit_length()
        device = linear.weight.device
        self.lowest = (1 << bits) - 1
        self.classes = torch.arange(rssm.classes, dtype=torch.int32, device=device)
        self.places = rssm.classes * torch.arange(rssm.variables, dtype=torch.int32, device=device)

    def chances(self, noise: Tensor) -> Tensor:
        """Convert standard Gumbel draws g [..., Z] to e^g, which `imagine` reads: the class with
        the largest log p + g is that with the largest p e^g.
        """
        return noise.exp()

    def room(self, steps: int, rows: int) -> Coded:
        """Return memory for the arrived latents of a rollout of K = `steps` steps, [K, R, .]."""
        h = self.gate_bias.new_empty(steps, rows, self.deter)
        return Coded.of(h, self.places.new_empty(steps, rows, len(self.places)), self.flat)

    def imagine(
        self, latent: Latent, action: Tensor, chances: Tensor, arrived: Coded, copies: int = 1
    ) -> Coded:
        """Imagine one prior step, as `SafetyWorldModel.imagine` does, into `arrived` [R, .], and
        return it.

        Args:
            latent: [B, .]; each row stands for `copies` adjacent ones of the R.
            action: [R, A].
            chances: `chances` of the Gumbel draws [R, Z].
            arrived: a step of `room`.
            copies: R / B.
        """
        # What follows from the latent alone, before its rows are repeated.
        h = latent.h
        if isinstance(latent, Coded):
            from_z = looked_up(self.of_z, latent.z)
        else:
            from_z = latent.z @ self.of_z
        gates = torch.addmm(self.gate_bias, h, self.gate_h)
        new = torch.addmm(self.new_bias_h, h, self.new_h)
        if copies > 1:
            h = h.repeat_interleave(copies, 0)
            from_z = from_z.repeat_interleave(copies, 0)
            gates = gates.repeat_interleave(copies, 0)
            new = new.repeat_interleave(copies, 0)

        # The layer of (z, a).
        x = torch.addmm(self.bias, self.rssm.scaled(action), self.of_action).add_(from_z)
        x = F.silu(in_place(self.norm, x), inplace=True)

        # The GRU.
        reset, update = gates.addmm_(x, self.gate_x).sigmoid_().split(self.deter, -1)
        new = new.mul_(reset).addmm_(x, self.new_x).add_(self.new_bias_x).sigmoid_().mul_(2).sub_(1)
        torch.lerp(new, h, update, out=arrived.h)

        # The draw of z.
        self._draw(arrived.h, chances, arrived.z)
        return arrived

    def _draw(self, h: Tensor, chances: Tensor, out: Tensor) -> None:
        """Draw the classes of z at h [R, D] by the Gumbel trick with `chances` [R, Z]: positions
        of the ones, into `out` [R, S].
        """
        rssm = self.rssm
        logits = h
        for layer in rssm.prior_net:
            logits = in_place(layer, logits)
        scores = logits.float().unflatten(-1, (rssm.variables, rssm.classes)).softmax(-1)
        # (1 - u) p + u / C up to a factor that all classes share, where u is `unimix`.
        scores.add_(rssm.unimix / rssm.classes / (1 - rssm.unimix)).mul_(chances.view_as(scores))
        # Of positive floats the larger one has the larger bits.
        named = scores.view(torch.int32).bitwise_and_(~self.lowest).bitwise_or_(self.classes)
        torch.amax(named, -1, out=out)
        out.bitwise_and_(self.lowest).add_(self.places)
