"""The last step of world-model training: heads on imagined latents."""

import numpy as np
import torch

from tests.learning.recordings import TINY, recording
from wasp_cli.learning.encoding import encode
from wasp_cli.learning.sampling import generator, gumbel
from wasp_cli.learning.shards import Recording
from wasp_cli.learning.world_model import build, refit_heads
from wasp_cli.stages.base import no_progress


def test_the_refit_moves_only_the_heads_that_imagination_reads():
    torch.manual_seed(0)
    model, data = build(TINY, 2), recording()
    model.requires_grad_(False)
    latents = encode(model, data, no_progress)
    assert latents.h.shape == (36, 16)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    refit_heads(model, data, latents, data.episode < 2, TINY, 0, no_progress)
    moved = {name.split(".")[0] for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert moved == {"reward_head", "cost_head", "continue_head"}


def test_the_refit_learns_nothing_of_what_lies_behind_the_last_row():
    data = recording()
    longer = Recording(*(np.concatenate([field, field[:12]]) for field in data))
    longer.episode[36:] = 3
    heads = []
    for rows in (data, longer):
        torch.manual_seed(0)
        model = build(TINY, 2).requires_grad_(False)
        refit_heads(model, rows, encode(model, rows, no_progress), rows.episode == 2, TINY, 0, no_progress)
        heads.append({name: value for name, value in model.state_dict().items() if "head" in name})
    for name, value in heads[0].items():
        torch.testing.assert_close(value, heads[1][name], msg=name)


def test_the_refit_teaches_where_episodes_end():
    data = recording((6,) * 40)
    last = np.arange(240) % 6 == 5
    data.terminal[last] = 1.0
    data.action[:] = np.where(last, 1.0, -1.0)[:, None]  # what led there tells it
    torch.manual_seed(0)
    model = build(TINY, 2).requires_grad_(False)
    latents = encode(model, data, no_progress)
    refit_heads(model, data, latents, data.episode < 40, TINY.model_copy(update={"refit_updates": 300}), 0, no_progress)
    with torch.inference_mode():
        rows, noise = np.flatnonzero(~last), gumbel((200, model.noise_size), generator(1))
        arrived = model.imagine(latents.at(torch.from_numpy(rows)), torch.from_numpy(data.action[rows + 1]), noise)
        goes_on = model.continues(arrived).numpy()
    assert goes_on[last[rows + 1]].max() < 0.3
    assert goes_on[~last[rows + 1]].min() > 0.7
