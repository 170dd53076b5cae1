"""Publish models on the Hugging Face Hub and load them from there, in the way of Stable-Baselines3."""

try:
    import huggingface_hub  # noqa: F401
    import matplotlib  # noqa: F401
except ImportError as e:
    raise ImportError(f"sb3_tdpg.hub needs {e.name}: pip install 'sb3_tdpg[hub]'") from e

from sb3_tdpg.hub.transfer import load_from_hub, pull_from_hub, push_to_hub, write_model_card

__all__ = ["load_from_hub", "pull_from_hub", "push_to_hub", "write_model_card"]
