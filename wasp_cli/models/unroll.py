"""The RSSM over a sequence as one step of autograd, with a backward pass of its own.

It computes what `RSSM.recur`, `_mixed` and `sample` compute step by step. Recorded by autograd, a
step is about forty small operations, and every step adds to the gradient of every weight. Here the
backward pass has as many products as the forward pass, and the gradient of a weight is one product
over all steps.

Dimension letters as in `models.rssm`; H hidden.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from wasp_cli.models.base import Latent


class Unrolled(NamedTuple):
    """T steps of B sequences."""

    latent: Latent  # h [B, T, D], z [B, T, Z] (one-hot, gradients pass to the probabilities)
    log_probs: Tensor  # [B, T, S, C] of which z was drawn


class Weights(NamedTuple):
    """The weights of a step: of the layer of z and action, of the GRU, and of the net from h (and
    what was seen) to logits.
    """

    z: Tensor  # [H, Z]; the rest of its layer is in `inputs`
    input_scale: Tensor  # [H]
    input_shift: Tensor  # [H]
    cell_input: Tensor  # [3 D, H]
    cell_input_bias: Tensor  # [3 D]
    cell_hidden: Tensor  # [3 D, D]
    cell_hidden_bias: Tensor  # [3 D]
    h: Tensor  # [H, D]; its bias is in `added`
    scale: Tensor  # [H]
    shift: Tensor  # [H]
    logits: Tensor  # [Z, H]
    logits_bias: Tensor  # [Z]


def weights(
    inputs: nn.Sequential,
    cell: nn.GRUCell,
    h: Tensor,
    norm: nn.LayerNorm,
    logits: nn.Linear,
    flat: int,
) -> Weights:
    """Collect the weights of a step from its layers.

    Args:
        inputs: the layer of (z, a): linear, normalised, SiLU.
        cell: the GRU.
        h: [H, D] the weight that reads h.
        norm: normalises what it gives.
        logits: to the logits of z.
        flat: Z.
    """
    linear, input_norm, _ = inputs
    assert isinstance(linear, nn.Linear)
    assert isinstance(input_norm, nn.LayerNorm)
    return Weights(
        z=linear.weight[:, :flat],
        input_scale=input_norm.weight,
        input_shift=input_norm.bias,
        cell_input=cell.weight_ih,
        cell_input_bias=cell.bias_ih,
        cell_hidden=cell.weight_hh,
        cell_hidden_bias=cell.bias_hh,
        h=h,
        scale=norm.weight,
        shift=norm.bias,
        logits=logits.weight,
        logits_bias=logits.bias,
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
        start: h [B, D], z [B, Z] before the first step.
        inputs: what the action and the bias give to the layer of (z, a), [T, B, H].
        keep: [T, B, 1], 0 where h and z are forgotten before the step; None: nowhere.
        added: what the image and the bias give to the layer after h, [T, B, H].
        noise: standard Gumbel draws [T, B, S, C].
        unimix: share of a uniform distribution in every categorical.
        weights: of all layers.
    """
    dtype = weights.z.dtype
    with torch.autocast(inputs.device.type, enabled=False):
        h, z, log_probs = _Unroll.apply(  # type: ignore[no-untyped-call]
            start.h.to(dtype),
            start.z.to(dtype),
            inputs.to(dtype),
            added.to(dtype),
            keep,
            noise,
            unimix,
            *weights,
        )
    return Unrolled(Latent(h.transpose(0, 1), z.transpose(0, 1)), log_probs.transpose(0, 1))


class _Steps(NamedTuple):
    """What the way back needs of each step, [B, ...], or of all of them, [T, B, ...]."""

    x: Tensor  # [B, H] the layer of (z, a), before it is normalised
    x_mean: Tensor
    x_rstd: Tensor
    x_normed: Tensor  # [B, H]
    u: Tensor  # [B, H] its output, which the GRU reads
    reset: Tensor  # [B, D] gate of the GRU
    update: Tensor  # [B, D] gate of the GRU
    hidden_new: Tensor  # [B, D] what h gives to the new memory
    new: Tensor  # [B, D] the new memory
    y: Tensor  # [B, H] the layer after h, before it is normalised
    y_mean: Tensor
    y_rstd: Tensor
    y_normed: Tensor  # [B, H]
    v: Tensor  # [B, H] its output, from which the logits come


class _Unroll(torch.autograd.Function):
    """T steps forwards and backwards; arguments as in `unroll`."""

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
        *all_weights: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return h [T, B, D], z [T, B, Z], and log-probabilities [T, B, S, C]."""
        w = Weights(*all_weights)
        steps, batch, hidden = inputs.shape
        deter = h.shape[1]
        variables, classes = noise.shape[-2:]
        flat = variables * classes

        # Memory for all steps: h and z as they arrive, and as they enter the step.
        hs = h.new_empty(steps, batch, deter)
        zs = h.new_zeros(steps, batch, flat)
        hs_in = h.new_empty(steps, batch, deter)
        zs_in = h.new_empty(steps, batch, flat)
        soft = h.new_empty(steps, batch, variables, classes)  # probabilities before `unimix`
        log_probs = torch.empty_like(soft)

        saved: list[_Steps] = []
        for t in range(steps):
            # Forget h and z where an episode starts.
            h_in = hs_in[t]
            z_in = zs_in[t]
            if keep is None:
                h_in.copy_(h)
                z_in.copy_(z)
            else:
                torch.mul(h, keep[t], out=h_in)
                torch.mul(z, keep[t], out=z_in)

            # The layer of (z, a).
            x = torch.addmm(inputs[t], z_in, w.z.t())
            x_normed, x_mean, x_rstd = torch.native_layer_norm(
                x, (hidden,), w.input_scale, w.input_shift, 1e-5
            )
            u = F.silu(x_normed)

            # The GRU: h = (1 - update) new + update h_in.
            gates_u = torch.addmm(w.cell_input_bias, u, w.cell_input.t())
            gates_h = torch.addmm(w.cell_hidden_bias, h_in, w.cell_hidden.t())
            reset_update = (gates_u[:, : 2 * deter] + gates_h[:, : 2 * deter]).sigmoid_()
            reset = reset_update[:, :deter]
            update = reset_update[:, deter:]
            hidden_new = gates_h[:, 2 * deter :]
            new = torch.addcmul(gates_u[:, 2 * deter :], reset, hidden_new).tanh_()
            h = torch.lerp(new, h_in, update, out=hs[t])

            # The net from h, and from what was seen, to logits.
            y = torch.addmm(added[t], h, w.h.t())
            y_normed, y_mean, y_rstd = torch.native_layer_norm(y, (hidden,), w.scale, w.shift, 1e-5)
            v = F.silu(y_normed)
            logits = torch.addmm(w.logits_bias, v, w.logits.t())

            # The categoricals, with a share of a uniform distribution; and the draw of z.
            torch.softmax(logits.view(batch, variables, classes), -1, out=soft[t])
            torch.log(soft[t].mul(1 - unimix).add_(unimix / classes), out=log_probs[t])
            drawn = (log_probs[t] + noise[t]).argmax(-1, keepdim=True)  # [B, S, 1]
            z = zs[t]
            z.view(batch, variables, classes).scatter_(-1, drawn, 1.0)

            saved.append(
                _Steps(
                    x=x,
                    x_mean=x_mean,
                    x_rstd=x_rstd,
                    x_normed=x_normed,
                    u=u,
                    reset=reset,
                    update=update,
                    hidden_new=hidden_new,
                    new=new,
                    y=y,
                    y_mean=y_mean,
                    y_rstd=y_rstd,
                    y_normed=y_normed,
                    v=v,
                )
            )
        stacked = [torch.stack(each) for each in zip(*saved, strict=True)]
        ctx.save_for_backward(hs, hs_in, zs_in, soft, log_probs, keep, *stacked, *all_weights)
        ctx.unimix = unimix
        return hs, zs, log_probs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of all arguments of `forward`, from those of what it returned."""
        hs, hs_in, zs_in, soft, log_probs, keep, *others = ctx.saved_tensors
        several = len(_Steps._fields)
        s = _Steps(*others[:several])
        w = Weights(*others[several:])
        grad_hs, grad_zs, grad_log_probs = grads
        steps, batch, _ = hs.shape
        variables, classes = soft.shape[-2:]
        sharp = 1 - ctx.unimix

        # What does not depend on later steps, for all steps at once. All six gradients of the GRU's
        # gates are multiples of that of h.
        grad_mixed = grad_log_probs * torch.exp(-log_probs) * sharp
        slope_u = _silu_slope(s.x_normed)
        slope_v = _silu_slope(s.y_normed)
        of_new = (1 - s.update) * (1 - s.new.square())
        of_reset = of_new * s.hidden_new * s.reset * (1 - s.reset)
        of_update = (hs_in - s.new) * s.update * (1 - s.update)
        of_gates_u = torch.stack((of_reset, of_update, of_new), 2)  # [T, B, 3, D]
        of_gates_h = torch.stack((of_reset, of_update, of_new * s.reset), 2)

        # Memory for the gradients of all steps.
        d_logits = torch.empty_like(zs_in)
        d_gates_u = torch.empty_like(of_gates_u)
        d_gates_h = torch.empty_like(of_gates_h)
        d_x_normed = torch.empty_like(s.x)
        d_y_normed = torch.empty_like(s.x)
        d_x = torch.empty_like(s.x)
        d_y = torch.empty_like(s.x)

        # Backwards through the steps.
        norm_back = torch.ops.aten.native_layer_norm_backward.default
        only_input = [True, False, False]
        shape = [s.x.shape[-1]]
        dh = torch.zeros_like(hs[0])
        dz = torch.zeros_like(zs_in[0])
        for t in reversed(range(steps)):
            # From z and the log-probabilities through the softmax; z passes its gradient to the
            # probabilities.
            dz = (dz + grad_zs[t]).view(batch, variables, classes)
            grad_soft = torch.add(grad_mixed[t], dz, alpha=sharp)
            grad_logits = torch._softmax_backward_data(grad_soft, soft[t], -1, soft.dtype)
            grad_logits = d_logits[t].copy_(grad_logits.view(batch, -1))

            # Through the net from h to logits.
            torch.mul(grad_logits @ w.logits, slope_v[t], out=d_y_normed[t])
            d_y[t] = norm_back(
                d_y_normed[t], s.y[t], shape, s.y_mean[t], s.y_rstd[t], w.scale, w.shift, only_input
            )[0]
            dh = torch.addmm(dh + grad_hs[t], d_y[t], w.h)

            # Through the GRU and the layer of (z, a).
            gates_u = torch.mul(dh.unsqueeze(1), of_gates_u[t], out=d_gates_u[t]).view(batch, -1)
            gates_h = torch.mul(dh.unsqueeze(1), of_gates_h[t], out=d_gates_h[t]).view(batch, -1)
            torch.mul(gates_u @ w.cell_input, slope_u[t], out=d_x_normed[t])
            d_x[t] = norm_back(
                d_x_normed[t],
                s.x[t],
                shape,
                s.x_mean[t],
                s.x_rstd[t],
                w.input_scale,
                w.input_shift,
                only_input,
            )[0]

            # To h and z of the step before.
            dh = torch.addmm(dh * s.update[t], gates_h, w.cell_hidden)
            dz = d_x[t] @ w.z
            if keep is not None:
                dh = dh * keep[t]
                dz = dz * keep[t]

        # The gradients of the weights: one product over all steps for each.
        only_weights = [False, True, True]
        _, input_scale, input_shift = norm_back(
            d_x_normed, s.x, shape, s.x_mean, s.x_rstd, w.input_scale, w.input_shift, only_weights
        )
        _, scale, shift = norm_back(
            d_y_normed, s.y, shape, s.y_mean, s.y_rstd, w.scale, w.shift, only_weights
        )
        all_gates_u = d_gates_u.flatten(0, 1).flatten(1)  # [T * B, 3 * D]
        all_gates_h = d_gates_h.flatten(0, 1).flatten(1)
        of_weights = Weights(
            z=_outer(d_x, zs_in),
            input_scale=input_scale,
            input_shift=input_shift,
            cell_input=_outer(all_gates_u, s.u),
            cell_input_bias=all_gates_u.sum(0),
            cell_hidden=_outer(all_gates_h, hs_in),
            cell_hidden_bias=all_gates_h.sum(0),
            h=_outer(d_y, hs),
            scale=scale,
            shift=shift,
            logits=_outer(d_logits, s.v),
            logits_bias=d_logits.sum((0, 1)),
        )
        return dh, dz, d_x, d_y, None, None, None, *of_weights


def _silu_slope(values: Tensor) -> Tensor:
    """Return the derivative of SiLU, elementwise."""
    gate = values.sigmoid()
    return gate * (1 + values * (1 - gate))


def _outer(grads: Tensor, values: Tensor) -> Tensor:
    """Return the gradient [M, N] of a weight, summed over all steps and rows, from the gradients
    of its outputs [..., M] and its inputs [..., N].
    """
    return grads.reshape(-1, grads.shape[-1]).t() @ values.reshape(-1, values.shape[-1])
