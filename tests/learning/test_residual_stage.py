"""The limit of the residual, where it follows from the expert."""

import shutil

import pytest

from tests.cells import SETTINGS, short_episodes
from wasp_cli.learning.configs.baselines import ResidualConfig
from wasp_cli.stages.base import Job
from wasp_cli.stages.expert_limit import LIMIT_FILE
from wasp_cli.stages.residual import ResidualStage

CONFIG = ResidualConfig(
    interactions=16,
    envs=2,
    rollout=4,
    batch=4,
    epochs=1,
    hidden=(8,),
    operators={"noisy": (0.4,)},
)


@pytest.mark.parametrize(("written", "told"), [("auto", {"cost_limit": 3.0}), (25.0, {})])
def test_a_limit_that_follows_from_the_expert_is_its_limit(artifacts, tmp_path, written, told):
    expert, out = tmp_path / "expert", tmp_path / "out"
    policies = shutil.copytree(artifacts["policies"], tmp_path / "policies")
    (policies / "evaluation.json").write_text('{"skills": {"1": {"latent": {"return": 2.0}}}}')
    expert.mkdir()
    (expert / LIMIT_FILE).write_text('{"cost_limit": 3.0}')
    out.mkdir()
    config = CONFIG.model_copy(update={"cost_limit": written})
    inputs = {**artifacts, "policies": policies, "expert": expert}
    with short_episodes():
        job = Job("residual", "race1", 0, config, SETTINGS, {}, inputs, out, out)
        summary = ResidualStage().run(job)
    assert {name: summary[name] for name in summary if name == "cost_limit"} == told
    assert summary["interactions"] >= CONFIG.interactions
    assert (out / "residual.safetensors").exists()
