# %% [markdown]
"""What does the published world model expect, and what happens? Run it in the root of a
checkout, where the model is published.
"""

# %%
import gymnasium
import numpy as np

import wasp_cli
import wasp_cli.tasks.gym  # registers the environments

# the beginning of its key
model = wasp_cli.load_world_model("f6cb21a6", results="results/published")
print(model)

# %% 25 decisions nearly straight ahead, in a world where that leads through a hazard.
env = gymnasium.make(
    "wasp/SafetyPointGoal1-v0", observation="pixels", action_repeat=model.action_repeat
)
image, _ = env.reset(seed=5)
seen, done, costs = [image], [], []
for _ in range(25):
    done.append(np.array([0.6, 0.1]))
    image, _, _, _, info = env.step(done[-1])
    seen.append(image)
    costs.append(float(info["cost"] > 0))
images, actions = np.array(seen), np.array(done)

# %% Filter what was seen; from the eleventh image on imagine fifteen decisions, eight times; decode
# the first of these futures.
latents = model.filter(images, actions)
future = model.imagine(latents[10], np.repeat(actions[None, 10:], 8, 0))
decoded, risk = model.decode(future[0]), model.cost(future).mean(0)

# %% What it expects, beside what happened.
error = np.abs(decoded.astype(float) - images[11:]).mean((1, 2, 3))
still = np.abs(images[10].astype(float) - images[11:]).mean((1, 2, 3))
for step in (0, 4, 9, 14):
    said = f"+{step + 1:2d}: probability of cost {risk[step]:.2f}, cost {costs[10 + step]:.0f};"
    print(
        f"{said} decoded image off by {error[step]:.1f} of 255, the last one seen by "
        f"{still[step]:.1f}"
    )
