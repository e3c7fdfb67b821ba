"""The RSSM over a sequence as one step of autograd, with its own way back.

What it computes is what `RSSM.recur`, `_mixed` and `sample` compute step by step. Recorded by
autograd, a step is about forty small operations, and every step adds to the gradient of every
weight. Here the way back is as many products as the way there, and the gradients of the weights are
one product over all steps.

Dimension letters as in `models.rssm`; H hidden.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent


class Unrolled(NamedTuple):
    """T steps."""

    latent: Latent  # h [B, T, D], z [B, T, Z] (one-hot, gradients pass to the probabilities)
    log_probs: Tensor  # [B, T, S, C] of which z was drawn


class Weights(NamedTuple):
    """What a step reads: the layer of z and action, the GRU, and the net from h (and what was
    seen) to logits.
    """

    z: Tensor  # [H, Z]; the rest of its layer is in `inputs`
    input_scale: Tensor
    input_shift: Tensor
    cell_input: Tensor
    cell_input_bias: Tensor
    cell_hidden: Tensor
    cell_hidden_bias: Tensor
    h: Tensor  # [H, D]; its bias is in `added`
    scale: Tensor
    shift: Tensor
    logits: Tensor
    logits_bias: Tensor


def weights(
    inputs: nn.Sequential,
    cell: nn.GRUCell,
    h: Tensor,
    norm: nn.LayerNorm,
    logits: nn.Linear,
    flat: int,
) -> Weights:
    """Collect the weights of a step from its layers; `h` [H, D] reads the recurrent part,
    `flat` is Z.
    """
    first, before, _ = inputs
    assert isinstance(first, nn.Linear)
    assert isinstance(before, nn.LayerNorm)
    return Weights(
        first.weight[:, :flat],
        before.weight,
        before.bias,
        cell.weight_ih,
        cell.bias_ih,
        cell.weight_hh,
        cell.bias_hh,
        h,
        norm.weight,
        norm.bias,
        logits.weight,
        logits.bias,
    )


def unroll(
    start: Latent,
    inputs: Tensor,
    keep: Tensor | None,
    added: Tensor,
    noise: Tensor,
    unimix: float,
    weights: Weights,
) -> Unrolled:
    """Run T steps from a latent, in the dtype of the weights whatever the autocast.

    Args:
        start: h [B, D], z [B, Z].
        inputs: what the action and the bias give to the layer of (z, a), [T, B, H].
        keep: [T, B, 1], 0 where h and z are forgotten before the step; None: nowhere.
        added: what the image and the bias give to the layer after h, [T, B, H].
        noise: standard Gumbel draws [T, B, S, C].
        unimix: share of a uniform distribution in every categorical.
        weights: of all layers.
    """
    with torch.autocast(inputs.device.type, enabled=False):
        tensors = (value.to(weights.z.dtype) for value in (start.h, start.z, inputs, added))
        h, z, log_probs = _Unroll.apply(*tensors, keep, noise, unimix, *weights)  # type: ignore[no-untyped-call]
    return Unrolled(Latent(h.transpose(0, 1), z.transpose(0, 1)), log_probs.transpose(0, 1))


class _Unroll(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        h: Tensor,
        z: Tensor,
        inputs: Tensor,
        added: Tensor,
        keep: Tensor | None,
        noise: Tensor,
        unimix: float,
        *given: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        w = Weights(*given)
        (steps, batch, hidden), deter, (variables, classes) = (
            inputs.shape,
            h.shape[1],
            noise.shape[-2:],
        )
        flat = variables * classes
        hs, zs = h.new_empty(steps, batch, deter), h.new_zeros(steps, batch, flat)
        hs_in, zs_in = h.new_empty(steps, batch, deter), h.new_empty(steps, batch, flat)
        soft = h.new_empty(steps, batch, variables, classes)
        log_probs = torch.empty_like(soft)
        saved: list[list[Tensor]] = []
        for t in range(steps):
            h_in, z_in = hs_in[t], zs_in[t]
            if keep is None:
                h_in.copy_(h)
                z_in.copy_(z)
            else:
                torch.mul(h, keep[t], out=h_in)
                torch.mul(z, keep[t], out=z_in)
            x = torch.addmm(inputs[t], z_in, w.z.t())
            x_normed, x_mean, x_rstd = torch.native_layer_norm(
                x, (hidden,), w.input_scale, w.input_shift, 1e-5
            )
            u = F.silu(x_normed)
            gates_u, gates_h = (
                torch.addmm(w.cell_input_bias, u, w.cell_input.t()),
                torch.addmm(w.cell_hidden_bias, h_in, w.cell_hidden.t()),
            )
            # reset and update
            both = (gates_u[:, : 2 * deter] + gates_h[:, : 2 * deter]).sigmoid_()
            reset, update, hidden_new = both[:, :deter], both[:, deter:], gates_h[:, 2 * deter :]
            new = torch.addcmul(gates_u[:, 2 * deter :], reset, hidden_new).tanh_()
            h = torch.lerp(new, h_in, update, out=hs[t])
            y = torch.addmm(added[t], h, w.h.t())
            y_normed, y_mean, y_rstd = torch.native_layer_norm(y, (hidden,), w.scale, w.shift, 1e-5)
            v = F.silu(y_normed)
            logits = torch.addmm(w.logits_bias, v, w.logits.t())
            torch.softmax(logits.view(batch, variables, classes), -1, out=soft[t])
            torch.log(soft[t].mul(1 - unimix).add_(unimix / classes), out=log_probs[t])
            z = zs[t]
            z.view(batch, variables, classes).scatter_(
                -1, (log_probs[t] + noise[t]).argmax(-1, keepdim=True), 1.0
            )
            saved.append(
                [
                    x,
                    x_mean,
                    x_rstd,
                    x_normed,
                    u,
                    reset,
                    update,
                    hidden_new,
                    new,
                    y,
                    y_mean,
                    y_rstd,
                    y_normed,
                    v,
                ]
            )
        stacked = [torch.stack(each) for each in zip(*saved, strict=True)]
        ctx.save_for_backward(hs, hs_in, zs_in, soft, log_probs, keep, *stacked, *given)
        ctx.unimix = unimix
        return hs, zs, log_probs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        hs, hs_in, zs_in, soft, log_probs, keep, *rest = ctx.saved_tensors
        (
            x,
            x_mean,
            x_rstd,
            x_normed,
            u,
            reset,
            update,
            hidden_new,
            new,
            y,
            y_mean,
            y_rstd,
            y_normed,
            v,
        ) = rest[:14]
        w, sharp = Weights(*rest[14:]), 1 - ctx.unimix
        to_h, to_z, to_logs = grads
        (steps, batch, _), (variables, classes) = hs.shape, soft.shape[-2:]
        # Everything that does not depend on later steps, for all steps at once. All six gradients
        # of the GRU's gates are multiples of h's.
        to_mixed = to_logs * torch.exp(-log_probs) * sharp
        to_u, to_v = _silu_slope(x_normed), _silu_slope(y_normed)
        of_new = (1 - update) * (1 - new.square())
        of_reset = of_new * hidden_new * reset * (1 - reset)
        of_update = (hs_in - new) * update * (1 - update)
        of_gates_u = torch.stack((of_reset, of_update, of_new), 2)  # [T, B, 3, D]
        of_gates_h = torch.stack((of_reset, of_update, of_new * reset), 2)
        d_logits, d_gates_u, d_gates_h = (
            torch.empty_like(zs_in),
            torch.empty_like(of_gates_u),
            torch.empty_like(of_gates_h),
        )
        d_x_normed, d_y_normed, d_x, d_y = (torch.empty_like(x) for _ in range(4))
        norm_back = torch.ops.aten.native_layer_norm_backward.default
        only_input, shape = [True, False, False], [x.shape[-1]]
        dh, dz = torch.zeros_like(hs[0]), torch.zeros_like(zs_in[0])
        for t in reversed(range(steps)):
            dz = (dz + to_z[t]).view(batch, variables, classes)
            logits = torch._softmax_backward_data(
                torch.add(to_mixed[t], dz, alpha=sharp), soft[t], -1, soft.dtype
            )
            logits = d_logits[t].copy_(logits.view(batch, -1))
            torch.mul(logits @ w.logits, to_v[t], out=d_y_normed[t])
            d_y[t] = norm_back(
                d_y_normed[t], y[t], shape, y_mean[t], y_rstd[t], w.scale, w.shift, only_input
            )[0]
            dh = torch.addmm(dh + to_h[t], d_y[t], w.h)
            gates_u = torch.mul(dh.unsqueeze(1), of_gates_u[t], out=d_gates_u[t]).view(batch, -1)
            gates_h = torch.mul(dh.unsqueeze(1), of_gates_h[t], out=d_gates_h[t]).view(batch, -1)
            torch.mul(gates_u @ w.cell_input, to_u[t], out=d_x_normed[t])
            d_x[t] = norm_back(
                d_x_normed[t],
                x[t],
                shape,
                x_mean[t],
                x_rstd[t],
                w.input_scale,
                w.input_shift,
                only_input,
            )[0]
            dh, dz = torch.addmm(dh * update[t], gates_h, w.cell_hidden), d_x[t] @ w.z
            if keep is not None:
                dh, dz = dh * keep[t], dz * keep[t]
        only_weights = [False, True, True]
        _, input_scale, input_shift = norm_back(
            d_x_normed, x, shape, x_mean, x_rstd, w.input_scale, w.input_shift, only_weights
        )
        _, scale, shift = norm_back(
            d_y_normed, y, shape, y_mean, y_rstd, w.scale, w.shift, only_weights
        )
        by_gate = (d_gates_u.flatten(0, 1).flatten(1), d_gates_h.flatten(0, 1).flatten(1))
        found = Weights(
            _outer(d_x, zs_in),
            input_scale,
            input_shift,
            _outer(by_gate[0], u),
            by_gate[0].sum(0),
            _outer(by_gate[1], hs_in),
            by_gate[1].sum(0),
            _outer(d_y, hs),
            scale,
            shift,
            _outer(d_logits, v),
            d_logits.sum((0, 1)),
        )
        return dh, dz, d_x, d_y, None, None, None, *found


def _silu_slope(values: Tensor) -> Tensor:
    """The derivative of SiLU."""
    gate = values.sigmoid()
    return gate * (1 + values * (1 - gate))


def _outer(grads: Tensor, values: Tensor) -> Tensor:
    """The gradient of a weight from those of its outputs [..., M] and its inputs [..., N],
    summed over all steps and rows: [M, N].
    """
    return grads.reshape(-1, grads.shape[-1]).t() @ values.reshape(-1, values.shape[-1])
