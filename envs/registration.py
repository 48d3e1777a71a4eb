"""Environment ids, registered by string so that importing the package stays light."""

from __future__ import annotations


def register_envs() -> None:
    """Register every environment with Gymnasium; called once by `import vid2demo`."""
    try:
        from gymnasium.envs.registration import register, registry
    except ModuleNotFoundError:  # the extract package is usable on its own
        return

    for task, module in (("Pour", "pouring"), ("Track", "tracking")):
        if f"Panda{task}-v0" not in registry:
            register(
                id=f"Panda{task}-v0",
                entry_point=f"vid2demo.envs.{module}:Panda{task}Env",
                vector_entry_point=f"vid2demo.envs.vector:Panda{task}VectorEnv",
            )
