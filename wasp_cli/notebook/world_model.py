"""A trained world model that filters what was seen, imagines what follows, and decodes it.

    model = wasp_cli.load_world_model("f6cb21a6", results="results/published")
    latents = model.filter(images, actions)                # of an episode
    future = model.imagine(latents[10], actions[10:25])    # fifteen steps from its eleventh
    observation on model.decode(future), model.reward(future), model.cost(future)

A model of a task without images reads vectors, the `state` of its observations, instead.

T = observations of an episode, A = action size, K = imagined steps, D, Z = sizes of a latent's
parts, S = size of a vector. `...` are any leading dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from wasp_cli.errors import ArtifactError, TaskError, UsageError
from wasp_cli.models.base import Latent
from wasp_cli.models.world_model import SafetyWorldModel
from wasp_cli.models.world_model import load_world_model as load_weights
from wasp_cli.store.artifact import (
    WHY,
    corruption,
    file_digest,
    listed_files,
    read_manifest,
    stored_keys,
)
from wasp_cli.store.find import find_node
from wasp_cli.store.layout import MANIFEST, Layout, is_key
from wasp_cli.store.records import read_record
from wasp_cli.tasks.declared import declare_from

KIND = "world_model"
IMAGES = (6, 64, 64)  # shape of what the front and the rear camera see: RGB each


@dataclass(frozen=True, eq=False)
class Latents:
    """Latent states with any leading dimensions, which an index selects from; `...` stands for
    all that it does not name.
    """

    h: Tensor  # [..., D] recurrent part
    z: Tensor  # [..., Z] one-hot stochastic part

    def __getitem__(self, index: Any) -> Latents:
        leading = index if isinstance(index, tuple) else (index,)
        leading += () if any(each is ... for each in leading) else (...,)
        # never from the parts themselves
        return Latents(*(part[(*leading, slice(None))] for part in (self.h, self.z)))

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def shape(self) -> tuple[int, ...]:
        """The leading dimensions."""
        return tuple(self.h.shape[:-1])

    @property
    def features(self) -> NDArray[np.float32]:
        """[..., D + Z]: both parts side by side, as the heads read them."""
        return Latent(self.h, self.z).features.numpy()


class LoadedWorldModel:
    """A frozen world model, and the manifest of its artifact. Arrays go in and come out;
    everything is computed on the CPU.
    """

    def __init__(self, module: SafetyWorldModel, manifest: Mapping[str, Any]) -> None:
        self.module, self.manifest = module, manifest
        self.action_size = module.action_size
        if self.task is not None:  # `make_task` finds it under its name
            declare_from(self.task, manifest.get("settings"))

    @property
    def label(self) -> str:
        """As `wasp run` prints it; empty where the folder has no manifest."""
        return str(self.manifest.get("label", ""))

    @property
    def task(self) -> str | None:
        """The task that it was trained on."""
        return self.manifest.get("task")

    @property
    def action_repeat(self) -> int | None:
        """Env steps of one of its steps."""
        settings = self.manifest.get("settings")
        return settings.get("action_repeat") if isinstance(settings, dict) else None

    def __repr__(self) -> str:
        return (
            f"<wasp world model '{self.label}': actions of {self.action_size}, latents of "
            f"{self.module.feature_size}>"
        )

    @torch.inference_mode()
    def filter(self, images: ArrayLike, actions: ArrayLike) -> Latents:
        """Return the latents [T] of an episode: entry t knows the images up to t and the actions
        before t.

        Args:
            images: uint8 [T, 6, 64, 64], an environment's `pixels`; of a model of vectors its
                `state` [T, S].
            actions: [T - 1, A] or more: action t was executed after image t was seen.

        Raises:
            TaskError: the shapes do not fit.
        """
        frames = self._frames(images)
        executed = self._actions(actions)
        if executed.ndim != 2 or len(executed) < len(frames) - 1:
            raise TaskError(
                f"{len(frames)} observations need {len(frames) - 1} actions [T - 1, "
                f"{self.action_size}], not {list(executed.shape)}"
            )
        latent, action = self.module.initial(1), torch.zeros(1, self.action_size)
        latents: list[Latent] = []
        for t, image in enumerate(frames):
            latent = self.module.filter(
                latent,
                action,
                torch.from_numpy(np.ascontiguousarray(image))[None],
                torch.tensor([float(t == 0)]),
            )
            latents.append(latent)
            action = executed[t : t + 1]
        return Latents(
            torch.cat([latent.h for latent in latents]), torch.cat([latent.z for latent in latents])
        )

    @torch.inference_mode()
    def imagine(self, latents: Latents, actions: ArrayLike, seed: int = 0) -> Latents:
        """Imagine K steps from one latent or from many: latents [..., K] with the leading
        dimensions of both arguments.

        Args:
            latents: [...] where it begins; those of one latent are drawn on for every sequence of
                actions.
            actions: [..., K, A]; `np.repeat(actions[None], 8, 0)` imagines the same actions eight
                times.
            seed: of the draws.

        Raises:
            TaskError: the shapes do not fit.
        """
        plans = self._actions(actions)
        if plans.ndim < 2 or plans.shape[-2] < 1:
            raise TaskError(
                f"actions should be [..., K, {self.action_size}] with K of at least 1, not "
                f"{list(plans.shape)}"
            )
        try:
            leading = torch.broadcast_shapes(latents.shape, plans.shape[:-2])
        except RuntimeError as error:
            raise TaskError(
                f"latents {list(latents.shape)} and actions {list(plans.shape)} do not fit "
                "each other"
            ) from error
        h, z = (
            part.expand(*leading, -1).reshape(-1, part.shape[-1]) for part in (latents.h, latents.z)
        )
        steps = plans.expand(*leading, *plans.shape[-2:]).reshape(-1, *plans.shape[-2:])
        draws = torch.Generator().manual_seed(seed)
        latent = Latent(h, z)
        imagined: list[Latent] = []
        for k in range(steps.shape[1]):
            uniform = torch.rand(len(steps), self.module.noise_size, generator=draws).clamp(
                1e-10, 1 - 1e-7
            )
            latent = self.module.imagine(latent, steps[:, k], -torch.log(-torch.log(uniform)))
            imagined.append(latent)
        parts = (torch.stack([latent[i] for latent in imagined], 1) for i in range(2))
        return Latents(*(part.unflatten(0, leading) if leading else part[0] for part in parts))

    @torch.inference_mode()
    def decode(self, latents: Latents) -> NDArray[Any]:
        """Decode the images uint8 [..., 6, 64, 64] that the cameras are expected to see; a model of
        vectors decodes float32 [..., S] in the task's own units.
        """
        flat = Latent(
            latents.h.reshape(-1, latents.h.shape[-1]), latents.z.reshape(-1, latents.z.shape[-1])
        )
        if self.module.reads == "state":
            return self.module.decode(flat).reshape(*latents.shape, -1).numpy()
        images = (self.module.decode(flat) * 255).round().to(torch.uint8)
        return images.reshape(*latents.shape, *IMAGES).numpy()

    @torch.inference_mode()
    def reward(self, latents: Latents) -> NDArray[np.float32]:
        """Predict the reward [...] of the step that arrives at each latent."""
        return self.module.reward(Latent(latents.h, latents.z)).numpy()

    @torch.inference_mode()
    def cost(self, latents: Latents) -> NDArray[np.float32]:
        """Predict the probability [...] that the step which arrives at each latent has cost."""
        return self.module.cost(Latent(latents.h, latents.z)).numpy()

    def _frames(self, seen: ArrayLike) -> NDArray[Any]:
        """What was seen of an episode, [T, ...], checked."""
        frames = np.asarray(seen)
        if self.module.reads == "state":
            size = len(self.module.sizes.state_mean)
            fits = frames.ndim == 2 and frames.shape[1] == size and len(frames) > 0
            if not fits or not np.issubdtype(frames.dtype, np.number):
                raise TaskError(
                    f"vectors should be numbers [T, {size}], not {frames.dtype} "
                    f"{list(frames.shape)}",
                    "this model was trained on a task without images: it reads `state`",
                )
            return frames.astype(np.float64)
        if (
            frames.dtype != np.uint8
            or frames.ndim != 4
            or frames.shape[1:] != IMAGES
            or not len(frames)
        ):
            raise TaskError(
                f"images should be uint8 [T, 6, 64, 64], not {frames.dtype} {list(frames.shape)}"
            )
        return frames

    def _actions(self, actions: ArrayLike) -> Tensor:
        try:
            tensor = torch.from_numpy(np.array(actions, np.float32))
        except ValueError as error:
            raise TaskError(
                f"actions should be finite [..., {self.action_size}], not of several lengths"
            ) from error
        if (
            tensor.ndim < 1
            or tensor.shape[-1] != self.action_size
            or not torch.isfinite(tensor).all()
        ):
            raise TaskError(
                f"actions should be finite [..., {self.action_size}], not {list(tensor.shape)}"
            )
        return tensor


def load_world_model(
    which: str | Path | None = None, results: str | Path = "results"
) -> LoadedWorldModel:
    """Load a trained world model; its files' SHA-256 are checked first.

    Args:
        which: a results folder with one world model, the folder of its artifact, or in `results`
            the label (`goal1 s1 world_model`) or the beginning of the key of one; None: the only
            one of `results`.
        results: where labels and keys are looked up.

    Raises:
        UsageError: the folder has several world models, or none; or the node is of another kind.
        UnknownName: no node has this label or key.
        ArtifactError: a file is missing or damaged.
    """
    folder = Path(results if which is None else which)
    if (folder / "world_model.safetensors").is_file():
        return _of_folder(folder)
    if which is None or folder.is_dir():
        layout = Layout(folder)
        keys = sorted(filter(is_key, stored_keys(layout, KIND)))
        if len(keys) != 1:
            named = [f"  {key}  {read_manifest(layout, KIND, key).get('label')}" for key in keys]
            what = (
                "\n".join([f"'{folder}' has {len(keys)} world models:", *named])
                if keys
                else f"'{folder}' has no world model"
            )
            raise UsageError(what, "load_world_model(LABEL, results=DIR) with a label or a key")
        key = keys[0]
    else:
        layout = Layout(Path(results))
        node = find_node(layout, str(which))
        if node.kind != KIND or node.key is None or not node.manifest:
            raise UsageError(f"'{which}' is no world model", "wasp show NODE says what it is")
        key = node.key
    wrong = corruption(layout, KIND, key)
    if wrong is not None:
        raise ArtifactError(wrong, "run the spec again: what is damaged is computed again")
    return LoadedWorldModel(
        load_weights(layout.artifact(KIND, key)), read_manifest(layout, KIND, key)
    )


def _of_folder(folder: Path) -> LoadedWorldModel:
    """Load from anywhere; a folder without a manifest, and without the sign that it was taken
    out of use, is somebody's own.
    """
    manifest = read_record(folder / MANIFEST)
    try:
        for name in [] if manifest is None else listed_files(manifest, folder / MANIFEST):
            if (manifest or {})["files"][name].get("sha256") != file_digest(folder / name):
                raise ArtifactError(f"'{folder / name}' has other bytes than were stored")
        if manifest is None and (folder / WHY).exists():
            raise ArtifactError(
                f"'{folder}' was taken out of use",
                "run the spec again: what is damaged is computed again",
            )
        return LoadedWorldModel(load_weights(folder), manifest or {})
    except OSError as error:
        raise ArtifactError(f"cannot read the world model in '{folder}': {error}") from error
