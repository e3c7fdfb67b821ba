"""wasp: an experiment orchestrator for safety-aware shared autonomy with world-model constrained
planning.

    import wasp_cli

    results = wasp_cli.results("results")              # tables of a results folder; needs no torch
    model = wasp_cli.load_world_model("results")       # filters, imagines, decodes
    assistant = wasp_cli.load_assistant("results", "goal1 s1 wasp")    # in any loop of yours
    env = wasp_cli.AssistedEnv(env, assistant)         # as a gymnasium environment

docs/results.md and docs/own_loop.md show what they can do.
"""

# nothing is imported here, `typing` neither: `wasp_cli.__main__` first says where modules are
# looked for
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from wasp_cli.notebook import open_results as results
    from wasp_cli.notebook.assistant import load_assistant
    from wasp_cli.notebook.assisted_env import AssistedEnv
    from wasp_cli.notebook.world_model import load_world_model

__version__ = "0.3.0"
__all__ = ["AssistedEnv", "__version__", "load_assistant", "load_world_model", "results"]


def __getattr__(name: str) -> "Any":
    # Imported when they are asked for: importing the package must take no time, and the command
    # line needs neither.
    if name == "results":
        from wasp_cli.notebook import open_results

        return open_results
    if name == "load_world_model":
        from wasp_cli.notebook.world_model import load_world_model

        return load_world_model
    if name == "load_assistant":
        from wasp_cli.notebook.assistant import load_assistant

        return load_assistant
    if name == "AssistedEnv":
        from wasp_cli.notebook.assisted_env import AssistedEnv

        return AssistedEnv
    raise AttributeError(f"module 'wasp_cli' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
